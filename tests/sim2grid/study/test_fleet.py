"""Random missions on a site: drawn from seeds, legal on their ground, with events at random."""

import msgspec
import numpy as np
import pytest

from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from sim2grid.loop.prepare import prepare
from sim2grid.loop.replan import unsolvable
from sim2grid.study.fleet import Rates, Recipe, make_fleet

RECIPE = Recipe("highland", 3, 7, num_targets=3, side=10, max_steps=64)


@pytest.fixture(scope="module")
def fleet():
    return make_fleet(RECIPE, 4)


def test_missions_are_legal_on_their_ground(fleet):
    assert len({mission.name for mission in fleet.missions}) == 4
    for mission, problem in zip(fleet.missions, fleet.scenarios, strict=True):
        assert [robot.kind for robot in mission.robots] == ["drone", "legged", "wheeled"]
        assert len(mission.targets) == 3
        for robot in mission.robots:
            assert fleet.passable[robot.kind][robot.start[1], robot.start[0]]
            assert robot.start not in [target.at for target in mission.targets]
        start = Snapshot.start(problem)
        assert unsolvable(start) == []
        assert ExactPlanner().plan(start).status == "optimal"
    assert all(draws >= 1 for draws in fleet.draws)


def test_the_same_recipe_gives_the_same_missions_however_many(fleet):
    again = make_fleet(RECIPE, 2)
    assert again.missions == fleet.missions[:2]
    np.testing.assert_array_equal(again.starts, fleet.starts[:2])
    other = make_fleet(msgspec_replace(RECIPE, seed=8), 1)
    assert other.missions[0].targets != fleet.missions[0].targets


def msgspec_replace(recipe, **changes):
    return Recipe(**{key: changes.get(key, getattr(recipe, key)) for key in vars(recipe)})


def test_a_mission_of_a_fleet_starts_as_it_does_alone(fleet):
    alone = prepare(fleet.missions[2], "test")
    np.testing.assert_array_equal(alone.scene.qpos0, fleet.starts[2])
    assert alone.scenario == fleet.scenarios[2]
    assert alone.bodies == fleet.bodies


def test_events_come_by_their_rates_in_the_middle_half_and_change_nothing_else(fleet):
    rates = Rates(lose=1.0, slow=1.0, silent=0.0, new_targets=2)
    eventful = make_fleet(msgspec_replace(RECIPE, rates=rates), 4)
    for calm, mission, problem in zip(fleet.missions, eventful.missions, fleet.scenarios,
                                      strict=True):
        assert msgspec.structs.replace(mission, events=()) == calm
        length = ExactPlanner().plan(Snapshot.start(problem)).makespan
        whens = [event.at_decision for event in mission.events]
        assert whens == sorted(whens)
        assert max(1, length // 4) <= whens[0]
        assert whens[-1] <= max(1, 3 * length // 4)
        assert sum(event.lost is not None for event in mission.events) == 1
        assert sum(event.slow is not None for event in mission.events) == 1
        assert sum(event.silent is not None for event in mission.events) == 0
        new = [event.target.at for event in mission.events if event.target]
        assert len({*new, *(target.at for target in mission.targets)}) == 5


def test_ground_turns_out_closed_where_the_plan_leads():
    flat = Recipe("flat", 0, 1, num_targets=2, side=6)
    calm = make_fleet(flat, 3)
    fleet = make_fleet(msgspec_replace(flat, rates=Rates(impassable=2)), 3)
    for mission, problem in zip(fleet.missions, calm.scenarios, strict=True):
        start = Snapshot.start(problem)
        cells = simulate.replay(start, ExactPlanner().plan(start).actions).cells
        kinds = [robot.kind for robot in mission.robots]
        assert len(mission.events) == 2
        for event in mission.events:
            assert event.impassable.kind in ("legged", "wheeled")
            ahead = cells[event.at_decision:, kinds.index(event.impassable.kind)]
            assert list(event.impassable.at) in ahead.tolist()


def test_a_rate_of_one_event_does_not_move_another():
    flat = Recipe("flat", 0, 1, num_targets=2, side=6)
    one = make_fleet(msgspec_replace(flat, rates=Rates(lose=1.0)), 2)
    both = make_fleet(msgspec_replace(flat, rates=Rates(lose=1.0, silent=1.0)), 2)
    for few, many in zip(one.missions, both.missions, strict=True):
        assert set(few.events) < set(many.events)
