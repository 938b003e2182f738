"""Random missions on a site: drawn from seeds, legal on their ground, with events at random."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from moonteam.errors import InputError
from moonteam.planners import simulate
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.problem.mission import Site
from moonteam.robots import OWN
from sim2grid.loop.prepare import prepare
from sim2grid.loop.replan import unsolvable
from sim2grid.study.fleet import Given, Rates, Recipe, make_fleet, parse_team

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


SCOUT = str(Path(__file__).parents[3] / "examples/scout/scout.py:SCOUT")


def test_a_team_is_read_from_its_words():
    team, skills = parse_team(f"drone:AB, wheeled ,{SCOUT}:drill+camera,wheeled:A")
    assert team == (("hopper", "drone"), ("rover", "wheeled"), ("scout", SCOUT),
                    ("rover2", "wheeled"))
    assert skills == (("A", "B"), (), ("drill", "camera"), ("A",))
    assert parse_team("legged,drone") == ((("strider", "legged"), ("hopper", "drone")), ())


@pytest.mark.parametrize(("text", "words"), [
    ("", "--team: : no such robot kind; registered: drone, legged, wheeled"),
    ("wheled:A", "--team: wheled: no such robot kind; did you mean wheeled?"),
    ("drone:A,,wheeled:B", "--team: : no such robot kind"),
    ("drone:", "--team: 'drone:' is not allowed; KIND or KIND:SKILLS"),
    ("drone:AA", "'drone:AA' is not allowed"),
    ("drone:drill+", "'drone:drill+' is not allowed"),
    ("drone:A B", "'drone:A B' is not allowed"),
    ("none.py:ROVER:A", "--team: none.py: no such file"),
    (SCOUT.replace(":SCOUT", ":SCUOT"), "holds no 'SCUOT'; did you mean SCOUT?"),
    ("drone:a+b+c+d+e+f+g+h+i", "--team: too many different skills; at most 8"),
    (",".join(["drone"] * 257), "--team: 257 robots; at most 256"),
])
def test_what_is_no_team_is_one_line(text, words):
    with pytest.raises(InputError) as refused:
        parse_team(text)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def outside(tmp_path_factory):
    """Missions of a team of one's own, with all that can happen, on ground of one's own."""
    folder = tmp_path_factory.mktemp("moon")
    heights = 0.02 * np.arange(14.0)[None, :] + np.zeros((14, 14))
    heights[:, :4] += 3.0 * (4 - np.arange(4.0))  # a wall in the west, for flying robots alone
    np.save(folder / "wall.npy", heights)
    team, skills = parse_team(f"{SCOUT}:drill,drone:camera+drill")
    site = Site(dem=str(folder / "wall.npy"), pixel=1.0, detail=False)
    return Recipe("wall", 5, 7, 3, 12, 1.0, 64, Rates(new_targets=1, impassable=1), team,
                  skills=skills, ground=site)


def test_missions_of_an_outside_team_stand_on_outside_ground(outside):
    fleet = make_fleet(outside, 3)
    assert fleet.place_of(0) == ("wall", 0)
    assert set(fleet.passable) == {"scout", "drone"}
    assert fleet.passable["drone"].all()
    assert not fleet.passable["scout"][:, :2].any()  # the wall
    assert fleet.passable["scout"][:, 5:].all()
    for number, mission in enumerate(fleet.missions):
        assert mission.name == f"wall-5-{number}"
        assert [(r.name, r.kind, r.skills) for r in mission.robots] == [
            ("scout", "scout", ("drill",)), ("hopper", "drone", ("camera", "drill"))]
        assert {s for target in mission.targets for s in target.skills} <= {"camera", "drill"}
        assert mission.robots[0].start[0] >= 2
        (closed,) = [event.impassable for event in mission.events if event.impassable]
        assert closed.kind == "scout"
        written = fleet.entry(number)
        assert written.robots[0].kind == SCOUT
        assert [e.impassable.kind for e in written.events if e.impassable] == [SCOUT]
        alone = prepare(written, "test")
        assert alone.mission == mission
        assert alone.scenario == fleet.scenarios[number]
        np.testing.assert_array_equal(alone.scene.qpos0, fleet.starts[number])


def test_skills_that_are_given_are_kept_and_others_are_drawn():
    team, skills = parse_team("drone:A,wheeled,legged:C")
    fleet = make_fleet(Recipe("flat", 0, 1, 2, 8, team=team, skills=skills), 6)
    drawn = {mission.robots[1].skills for mission in fleet.missions}
    assert len(drawn) > 1
    assert {s for its in drawn for s in its} == {"A", "C"}
    assert {mission.robots[0].skills for mission in fleet.missions} == {("A",)}


def test_the_default_team_draws_as_before(fleet):
    team, _ = parse_team(",".join(OWN))
    again = make_fleet(msgspec_replace(RECIPE, team=team), 2)
    assert again.missions == fleet.missions[:2]


def test_ground_that_no_robot_can_stand_on_is_said(tmp_path):
    np.save(tmp_path / "steep.npy", 0.8 * np.arange(20.0)[None, :] + np.zeros((20, 20)))
    ground = Site(dem=str(tmp_path / "steep.npy"), pixel=1.0, detail=False)
    recipe = Recipe("steep", 2, 0, 1, 6, team=parse_team("drone,wheeled")[0], ground=ground)
    with pytest.raises(InputError, match="site steep 2: no cell of it is open to a wheeled robot"):
        make_fleet(recipe, 1)


def test_a_mission_that_is_given_is_a_fleet_of_one():
    fleet = make_fleet(Given("demo"), 1)
    alone = prepare(fleet.entry(0), "demo")
    assert fleet.missions == (alone.mission,)
    assert (fleet.place_of(0), fleet.draws) == (("missions", 0), (0,))
    np.testing.assert_array_equal(fleet.starts, alone.scene.qpos0[None])


def test_missions_go_round_sites_as_each_site_alone_has_them():
    mixed = make_fleet(msgspec_replace(RECIPE, sites=2), 4)
    assert mixed.grounds == (0, 1, 0, 1)
    assert [mixed.place_of(k) for k in range(4)] == [("highland", 3), ("highland", 4)] * 2
    for seed in (3, 4):
        alone = make_fleet(msgspec_replace(RECIPE, site_seed=seed), 2)
        rows = [k for k in range(4) if mixed.place_of(k)[1] == seed]
        assert tuple(mixed.missions[k] for k in rows) == alone.missions
        assert tuple(mixed.scenarios[k] for k in rows) == alone.scenarios
        np.testing.assert_array_equal(mixed.starts[rows], alone.starts)
        assert all((mixed.site_of(k).heights == alone.site.heights).all() for k in rows)


@pytest.mark.parametrize("unfold", ["following", "arrivals", "lapsing", "hidden", "losses"])
def test_missions_that_unfold_say_what_will_happen_and_what_may_be_expected(unfold):
    recipe = replace(RECIPE, unfold=unfold)
    first, second = (make_fleet(recipe, 4).missions for _ in range(2))
    assert first == second
    assert first != make_fleet(replace(recipe, seed=8), 4).missions
    for mission in first:
        assert mission.clock == "seconds"
        assert mission.unfolds
        assert mission.expects is not None
        come = [event for event in mission.events if event.target is not None]
        if unfold == "hidden":
            assert mission.targets == ()
            assert len(come) == 3
            assert all(event.on_sight for event in come)
            assert all(robot.sensor_m == 6.0 for robot in mission.robots)
        elif unfold == "losses":
            assert not come
            assert len(mission.events) <= 1
        else:
            assert len(mission.targets) == 3
            assert len(come) == 5
            assert len({event.target.at for event in come} | {t.at for t in mission.targets}) == 8
        if unfold == "following":
            assert [event.at_solved for event in come] == [1, 2, 3, 4, 5]
        if unfold == "lapsing":
            assert all(1 <= event.target.worth <= 5 for event in come)
            assert all(15 <= event.target.lapses - event.at_s <= 40 for event in come)
            assert not any(target.worth for target in mission.targets)
            assert mission.expects.worth == (1.0, 5.0)
        if unfold == "arrivals":
            times = [event.at_s for event in come]
            assert times == sorted(times)
            assert mission.expects.every == 10.0
