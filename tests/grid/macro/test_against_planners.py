"""The macro world, driven by plans, against the planners' world in milliseconds."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.planners.macro import stacked
from moonteam.planners.seconds.base import (
    MS,
    NEVER,
    effort,
    in_order,
    makespan,
    problems,
    timed_again,
)
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.greedy import GreedyPlanner
from moonteam.planners.seconds.macro import problem_of

AGENTS, TARGETS = 3, 6
reset, step = jax.jit(world.reset), jax.jit(world.step)


@pytest.fixture(scope="module")
def room(instances):
    return instances.large(0, 3, 5, skills=3)


def whole(now, room):
    """The problem padded to the shape of the largest, so that all are compiled once."""
    return jax.tree.map(lambda x: x[0], stacked([problem_of(now), problem_of(room)]))


def driven(now, services, room):
    """Ends of the services (ms), makespan and effort as the macro world has them."""
    state = reset(whole(now, room))
    routes = [[one.target for one in in_order(services, a)] for a in range(len(now.present))]
    routes += [[]] * (AGENTS - len(routes))
    team = {one.target: one.agents[0] for one in services}
    clock, way, ends = float(state.now), 0.0, {}
    for _ in range(4 * TARGETS):
        free = np.asarray(world.free(state))
        choice = [routes[a].pop(0) if free[a] and routes[a] else TARGETS for a in range(AGENTS)]
        result = step(state, np.array(choice, np.int32))
        state = result.state
        clock, way = clock + float(result.seconds), way + float(result.effort)
        solved, since = np.asarray(state.solved), np.asarray(state.since)
        for j, a in team.items():
            if solved[j] and j not in ends:
                ends[j] = MS * float(since[a])
        if result.terminated or result.truncated:
            break
    return bool(result.terminated), ends, MS * clock, MS * way


def same(now, plan, room):
    """Checks one plan; whether there was one."""
    if plan.status == "infeasible" or not plan.services:
        return False
    assert problems(now, plan.services) == []
    services = timed_again(now, [(one.target, one.agents) for one in plan.services])
    done, ends, span, way = driven(now, services, room)
    assert done
    for one in services:
        assert ends[one.target] == pytest.approx(one.end, abs=0.6), one
    assert max(span, now.ends.max()) == pytest.approx(makespan(now, services), abs=0.6)
    assert way == pytest.approx(effort(now, services), abs=1.0)
    return True


@pytest.mark.parametrize("planner", [ExactPlanner(), ExactPlanner("effort"), GreedyPlanner()],
                         ids=["makespan", "effort", "greedy"])
def test_a_plan_takes_as_long_in_both_worlds(planner, instances, room):
    """Unlike speeds, tables with closed ways, services, coalitions, windows, chains, homes."""
    count = 0
    for seed in range(250):
        now = instances.instance(seed)
        count += same(now, planner.plan(now), room)
    assert count > 100


def test_a_limit_and_a_window_can_be_met_to_the_millisecond(instances, room):
    count = 0
    for seed in range(60):
        now = instances.instance(seed)
        plan = ExactPlanner().plan(replace(now, limit=NEVER))
        if plan.status == "infeasible" or not plan.services:
            continue
        lapses = now.lapses.copy()
        for one in plan.services:
            lapses[one.target] = one.start
        last = max(one.end for one in plan.services)
        # The limit holds until everybody is home, in the macro world until all is served.
        done, ends, _, _ = driven(replace(now, lapses=lapses, limit=last), plan.services, room)
        assert done
        assert ends == {one.target: pytest.approx(one.end, abs=0.6) for one in plan.services}
        done, *_ = driven(replace(now, limit=last - 1), plan.services, room)
        assert not done
        count += 1
    assert count > 20
