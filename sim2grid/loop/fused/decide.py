"""A decision inside the program: positions to cells, what was learned, solved, where all go.

The rules are those of `sim2grid.loop.rules` and `sim2grid.waypoints`. Legend as in `state`.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from moonteam.grid import env
from moonteam.grid.travel import distance_fields
from moonteam.grid.types import Problem, State
from moonteam.trees import where
from sim2grid.loop import rules as law
from sim2grid.loop.fused.deciders import Decider
from sim2grid.loop.fused.state import (
    GOING,
    LOST,
    MAX_STEPS,
    SUCCESS,
    TIMEOUT,
    UNDER_WAY,
    Ground,
    Progress,
    Setup,
    Trace,
    believed,
    check_solvable,
    keep_decision,
    keep_learned,
    lay_out,
    unsolvable,
)
from sim2grid.waypoints import yielding


def decide(setup: Setup, decider: Decider, params: Any, problems: Problem, charted: Ground,
           progress: Progress, trace: Trace, memory: Any) -> tuple[Progress, Trace, Any]:
    """The decision of every mission whose legs have all ended; the others keep what they have."""
    asking = progress.asking & (progress.status == UNDER_WAY)
    at = jax.vmap(partial(_settle, setup))(progress)
    at, learned = _learn(setup, problems, at, asking)
    found = jax.vmap(partial(_solve, setup))(problems, charted, at)
    now = where(asking, found, progress)
    trace = jax.vmap(keep_learned)(progress, learned, trace)
    deciding = asking & (now.status == UNDER_WAY)
    states = State(jax.vmap(believed)(problems, now), now.cells, now.solved, now.decision)
    horizon = jnp.full(deciding.shape, setup.max_steps)
    after, actions = decider.decide(params, memory, states, now.ground.fields, horizon)
    joint = jnp.where(now.mask, actions.astype(jnp.int32), env.STAY)
    sent = jax.vmap(partial(_send, setup))(problems, now, joint)
    trace = jax.vmap(keep_decision)(deciding, now, sent, joint,
                                    jax.vmap(setup.seconds)(now.look), trace)
    progress = where(deciding, sent, now)._replace(asking=jnp.zeros_like(asking))
    return progress, trace, where(deciding, after, memory)


def _settle(setup: Setup, now: Progress) -> Progress:
    """Positions to cells."""
    return now._replace(cells=setup.frame.settle(now.xy, now.cells), settled=now.decision + 1)


def _learn(setup: Setup, problems: Problem, now: Progress, asking: Array
           ) -> tuple[Progress, Array]:
    """Closes the goals of legs that timed out though nobody was in the way: learned [B, R].

    Searching the travel fields again costs time, so it is only done where some mission needs it.
    """
    crowded = jax.vmap(partial(law.crowded, setup.rules, setup.frame,
                               grounded=jnp.asarray(setup.grounded)))(now.xy, now.cells, now.goals)
    astray = jnp.any(now.goals != now.cells, axis=-1)
    doubts = ((now.ended == TIMEOUT) & now.mask & now.moving & astray & ~crowded
              & asking[:, None])

    def learn() -> tuple[Ground, Array]:
        return jax.vmap(_learn_one)(problems, now, doubts)

    ground, learned = jax.lax.cond(
        jnp.any(doubts), learn, lambda: (now.ground, jnp.zeros_like(doubts)))
    return now._replace(ground=ground), learned


def _learn_one(problem: Problem, now: Progress, doubts: Array) -> tuple[Ground, Array]:
    """The ground of a mission after doubts [R], one robot after the other."""
    ground, learned = now.ground, []
    for i in range(doubts.shape[0]):
        kind, (x, y) = problem.agent_kinds[i], now.goals[i]
        closed = ground.passable.at[kind, y, x].set(False)
        fields = distance_fields(closed, problem.target_cells, problem.size)
        news = doubts[i] & ground.passable[kind, y, x] & ~unsolvable(
            problem, Ground(closed, fields), now)
        ground = where(news, Ground(closed, fields), ground)
        learned.append(news)
    return ground, jnp.stack(learned)


def _solve(setup: Setup, problem: Problem, charted: Ground, now: Progress) -> Progress:
    """Targets solved, and whether the mission is over."""
    here = law.present(setup.frame, now.xy, now.cells, problem.target_cells)
    newly = law.met(here & now.mask[:, None], problem.agent_skills, problem.target_skills,
                    problem.target_and) & ~now.solved
    seconds = setup.seconds(now.look)
    now = now._replace(
        solved=now.solved | newly, solved_at=jnp.where(newly, now.decision, now.solved_at),
        solved_s=jnp.where(newly, seconds, now.solved_s))
    done = jnp.where(jnp.all(now.solved), SUCCESS, UNDER_WAY)
    now = check_solvable(problem, charted, now._replace(status=done))
    spent = (now.status == UNDER_WAY) & (now.decision >= setup.max_steps)
    return now._replace(status=jnp.where(spent, MAX_STEPS, now.status))


def _send(setup: Setup, problem: Problem, now: Progress, actions: Array) -> Progress:
    """Starts a leg for every robot of the team: actions [R]."""
    goals = env.moved(believed(problem, now), now.cells, actions)
    waits = yielding(goals, now.cells, now.mask, jnp.asarray(setup.grounded))
    goals = jnp.where(waits[:, None], now.cells, goals)
    way = law.metres(setup.frame.centre(goals.astype(jnp.float32)) - now.xy)
    limit = setup.seconds(now.look) + law.patience(setup.rules, way, jnp.array(setup.speeds))
    team = now.mask[:, None]
    sent = now._replace(
        sources=jnp.where(team, now.cells, now.sources), goals=jnp.where(team, goals, now.goals),
        start_xy=now.xy, limit_s=limit, ended=jnp.where(now.mask, GOING, LOST),
        decision=now.decision + 1)
    return lay_out(setup, sent)
