"""From routes (which targets each agent visits, in order) to a plan on the grid.

Legend: N agents, M targets, T steps. An agent walks to the next target of its route by a
shortest way and waits there until the others whose routes hold the target have come.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from moonteam.planners.base import IntArray, Objective, Plan, Snapshot, Visit
from moonteam.planners.search.travel import UNREACHABLE, Travel, walk
from moonteam.planners.simulate import STAY, Trace, holding, replay_whole

Routes = Sequence[Sequence[int]]
"""For each agent the targets it visits, in order; indices into the snapshot's targets."""


def meeting_times(travel: Travel, routes: Routes) -> dict[int, int]:
    """Step at which each visited target's team is complete, steps counted from now.

    Raises ValueError if agents wait for each other for ever.
    """
    teams: dict[int, list[int]] = {}
    for a, route in enumerate(routes):
        for target in route:
            teams.setdefault(target, []).append(a)
    done: dict[int, int] = {}
    at = [0] * len(routes)
    free = [0] * len(routes)
    while len(done) < len(teams):
        ready = [t for t, team in teams.items() if t not in done
                 and all(at[a] < len(routes[a]) and routes[a][at[a]] == t for a in team)]
        if not ready:
            raise ValueError("the routes wait for each other")
        for target in ready:
            arrivals = [free[a] + _leg(travel, routes, a, at[a]) for a in teams[target]]
            done[target] = max(arrivals)
            for a in teams[target]:
                at[a] += 1
                free[a] = done[target]
    return done


def _leg(travel: Travel, routes: Routes, agent: int, index: int) -> int:
    """Steps of the agent's way to the target at that place of its route."""
    target = routes[agent][index]
    if index == 0:
        return int(travel.start[agent, target])
    return int(travel.between[travel.kinds[agent], routes[agent][index - 1], target])


def actions_of(snapshot: Snapshot, travel: Travel, routes: Routes) -> IntArray:
    """Joint actions [T, N] that follow the routes; whoever has nothing to do stays."""
    times = meeting_times(travel, routes)
    actions = np.full((max(times.values(), default=0), len(routes)), STAY, np.int32)
    for a, route in enumerate(routes):
        cell, start = snapshot.cells[a], 0
        for target in route:
            goal = snapshot.target_cells[target]
            if travel.fields is None or snapshot.passable is None:
                way = walk(cell, goal)
            else:
                kind = snapshot.agent_kinds[a]
                way = walk(cell, goal, travel.fields[kind, target], snapshot.passable[kind])
            actions[start:start + len(way), a] = way
            cell, start = goal, times[target]
    return actions


@dataclass(frozen=True)
class Certificate:
    """What a planner claims of its routes: the status, and a bound of its objective."""

    planner: str
    objective: Objective
    status: str  # "optimal" or "feasible"
    bound: float | None


def plan_of_trace(snapshot: Snapshot, trace: Trace, claim: Certificate, seconds: float,
                  routes: Routes | None = None) -> Plan:
    """A plan whose makespan, moves and visits are those of its replay.

    Visits name the agents whose routes hold the target if all of them are there at that step,
    else those in its cell that share a skill: a target can be solved earlier than it was
    scheduled, by agents that pass.
    """
    visits = []
    for before, target in np.argwhere(trace.solved[1:] & ~trace.solved[:-1]).tolist():
        here = (trace.cells[before + 1] == snapshot.target_cells[target]).all(-1)
        here &= snapshot.agent_mask
        sent = [a for a, route in enumerate(routes or ()) if target in route]
        if not sent or not here[sent].all():
            shares = snapshot.agent_skills & snapshot.target_skills[target] != 0
            sent = np.flatnonzero(here & shares).tolist()
        visits.append(Visit(target, tuple(sent), before + 1))
    already = np.flatnonzero(holding(snapshot) & ~snapshot.solved).tolist()
    standing = [Visit(t, _standing(snapshot, t), 0) for t in already]
    return Plan(planner=claim.planner, objective=claim.objective,
                status="optimal" if claim.status == "optimal" else "feasible",
                makespan=trace.makespan, moves=trace.moves, bound=claim.bound, seconds=seconds,
                actions=trace.actions, schedule=(*standing, *visits))


def _standing(snapshot: Snapshot, target: int) -> tuple[int, ...]:
    """Agents that meet a target's requirement where they stand."""
    here = (snapshot.cells == snapshot.target_cells[target]).all(-1) & snapshot.agent_mask
    here &= snapshot.agent_skills & snapshot.target_skills[target] != 0
    return tuple(np.flatnonzero(here).tolist())


def plan_of_routes(snapshot: Snapshot, travel: Travel, routes: Routes, claim: Certificate,
                   seconds: float) -> Plan:
    """The plan that follows the routes; raises ValueError if it leaves a target unsolved."""
    trace = replay_whole(snapshot, actions_of(snapshot, travel, routes))
    if not trace.complete:
        raise ValueError(f"targets {np.flatnonzero(~trace.solved[-1]).tolist()} stay unsolved")
    return plan_of_trace(snapshot, trace, claim, seconds, routes)


def infeasible(planner: str, objective: Objective, reason: str, seconds: float,
               agents: int) -> Plan:
    """The answer to a mission that this team cannot do."""
    return Plan(planner=planner, objective=objective, status="infeasible", makespan=None,
                moves=None, bound=None, seconds=seconds,
                actions=np.zeros((0, agents), np.int32), reason=reason)


def obstacles(snapshot: Snapshot, travel: Travel) -> dict[int, str]:
    """Targets that the team cannot solve, whatever the time, each with the reason."""
    found = {}
    for t in np.flatnonzero(~holding(snapshot)).tolist():
        need = int(snapshot.target_skills[t])
        skills = np.where(snapshot.agent_mask, snapshot.agent_skills, 0) & need
        able = int(np.bitwise_or.reduce(skills))
        near = int(np.bitwise_or.reduce(np.where(travel.start[:, t] < UNREACHABLE, skills, 0)))
        enough = need if snapshot.target_and[t] else 0
        where = f"target {t} at {snapshot.target_cells[t].tolist()}"
        if able == 0 or able & enough != enough:
            found[t] = f"{where}: nobody in the team has {_names(snapshot, need & ~able)}"
        elif near == 0 or near & enough != enough:
            found[t] = (f"{where}: cannot be reached by an agent with "
                        f"{_names(snapshot, need & ~near)}")
    return found


def _names(snapshot: Snapshot, mask: int) -> str:
    word = " or " if mask & (mask - 1) else ""
    names = [name for b, name in enumerate(snapshot.skill_names) if mask >> b & 1]
    return "skill " + (word.join(names) if word else names[0])
