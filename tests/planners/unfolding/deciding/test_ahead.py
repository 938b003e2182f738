"""A policy that looks ahead, and places to look from."""

from dataclasses import replace

import jax
import msgspec
import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.grid.macro import world as macro_world
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.greedy import GreedyPlanner
from moonteam.planners.seconds.keeper import choices, order_of
from moonteam.planners.seconds.local import LocalSearchPlanner
from moonteam.planners.seconds.macro import problem_of
from moonteam.planners.unfolding.deciding.ahead import (
    LookingAhead,
    of_the_known,
    raced,
    sure,
)
from moonteam.planners.unfolding.deciding.deciders import Replanning, play, play_together
from moonteam.planners.unfolding.deciding.imagined import imagined
from moonteam.planners.unfolding.deciding.pointing import Pointing, problem_in
from moonteam.planners.unfolding.deciding.search import with_looks, with_posts, without_posts
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.world import World
from moonteam.policies.pointer import grafted
from moonteam.policies.policy import Policy
from moonteam.problem import timed
from moonteam.problem.timed import Agent, Loss, Prospect, Target, Timed

POLICY = Policy.load(paths.find("unfolding", "policies", ".safetensors"))


def missions(name, count):
    return loading.load_set(paths.find(f"unfolding/{name}", "testsets", ".jsonl"))[:count]


def later(problem, events):
    """The mission after so many events, played by exact replanning."""
    world, decider = World(problem), Replanning(ExactPlanner())
    for _ in range(events):
        world.step(decider.act(world.view()))
    return world.view()


def test_the_best_try_is_done_if_it_gains_more_than_its_error_and_the_worse_drop_out():
    rng = np.random.default_rng(0)
    luck = rng.normal(50.0, 20.0, 64)
    costs = np.stack([luck, luck - 3.0 + rng.normal(0, 1, 64), luck + 5.0 + rng.normal(0, 1, 64)])
    best, stays = raced(costs, usual=True)
    assert best == 1
    assert stays.tolist() == [False, True, False]
    near = np.stack([luck, luck - 0.05 + rng.normal(0, 4, 64)])
    assert raced(near, usual=True)[0] == 0
    best, stays = raced(near, usual=False)
    assert best == int(near.mean(1).argmin())
    assert stays.all()


@pytest.mark.parametrize(("name", "events"), [("following", 3), ("arrivals", 2), ("arrivals", 6),
                                            ("lapsing", 5)])
def test_an_imagined_mission_is_the_one_in_which_that_future_was_known(name, events):
    view = later(missions(name, 3)[2], events)
    drawn = [future(view, np.random.default_rng(k)) for k in range(3)]
    size = 14
    problems = imagined(view, drawn, size)
    left = np.flatnonzero(~view.moment.solved)
    for row, one in enumerate(drawn):
        whole = problem_of(one.world(view).revealed().view().moment)
        rows = np.concatenate([left, len(view.targets) + np.arange(view.coming)])
        own = jax.tree.map(lambda x, row=row: x[row], problems)
        count = len(rows)
        assert own.target_mask.tolist() == [k < count for k in range(size)]
        near = {"rtol": 0, "atol": 1.1e-3}  # those are whole milliseconds
        np.testing.assert_allclose(own.start[:, :count], whole.start[:, rows], **near)
        np.testing.assert_allclose(own.between[:, :count, :count],
                                   whole.between[:, rows][:, :, rows], **near)
        for key in ("need", "either", "service", "worth"):
            np.testing.assert_array_equal(getattr(own, key)[:count], getattr(whole, key)[rows])
        np.testing.assert_allclose(own.lapses[:count], whole.lapses[rows], **near)
        np.testing.assert_array_equal(own.has, whole.has)
        assert own.unit == pytest.approx(float(whole.unit), rel=1e-3)
        timed_ = name != "following"
        late = (own.shown if timed_ else own.following)[len(left):count]
        expected = [t.appears - view.now / 1000 for t in one.coming] if timed_ else (
            np.arange(view.coming) + 1)
        np.testing.assert_allclose(late, expected, atol=1e-3)


def test_what_is_done_does_not_depend_on_who_plays_beside():
    views = [later(one, 3) for one in missions("following", 2)]
    choose = LookingAhead(POLICY, 32).choose
    together = choose(views)
    for view, chosen in zip(views, together, strict=True):
        assert choose([view])[0].tolist() == chosen.tolist()
    assert choose([views[1], views[0], views[1]])[2].tolist() == together[1].tolist()


def test_where_nothing_more_may_come_the_plan_of_what_is_known_is_done():
    problem = missions("following", 1)[0]
    view = later(problem, 9)
    assert sure(view)
    assert not sure(World(problem).view())
    plan = of_the_known(view.moment)
    assert plan is not None
    assert LookingAhead(POLICY, 2).choose([view])[0].tolist() == plan.tolist()
    exact = ExactPlanner().plan(view.moment)
    assert plan.tolist() == choices(view.moment, order_of(exact)).tolist()
    assert of_the_known(replace(view.moment, limit=1)) is None
    # Over no future nothing else is changed of the policy alone.
    first = World(problem).view()
    alone, planned = LookingAhead(POLICY, 0).choose([first, view])
    assert alone.tolist() == Pointing(POLICY).choose([first])[0].tolist()
    assert planned.tolist() == plan.tolist()


@pytest.mark.parametrize(("goal", "place"), [("makespan", 0), ("waiting", 1)])
def test_the_plan_stands_among_what_is_tried_and_is_the_usual_where_it_is_for_what_counts(
        goal, place):
    view = later(missions("following", 3)[1], 1)
    plan = np.flatnonzero(~view.moment.solved)[[1, 2, 0]]
    (asked,) = LookingAhead(POLICY, 2, goal)._ask([view], 1, [plan])
    count = len(asked.open_)
    wanted = [int(np.flatnonzero(asked.open_ == j)[0]) if free == 0 and held < 0 else tried
              for j, free, held, tried in zip(plan, view.moment.free, asked.bound,
                                              asked.tries[0], strict=True)]
    assert [min(int(j), count) for j in asked.tries[place]] == wanted
    assert len(np.unique(asked.tries, axis=0)) == len(asked.tries)


def test_no_place_to_wait_at_waits_for_anybody():
    view = with_posts(World(missions("arrivals", 1)[0]).view())
    assert len(view.looks) == 5
    ahead = LookingAhead(POLICY, 2, "waiting")
    (asked,) = ahead._ask([view], 1, [None])
    first = len(view.targets) + len(view.looks)
    served = np.zeros((1, 24))
    served[0, :len(view.targets)], served[0, len(view.targets):first] = 3.0, 1000.0
    served[0, first:first + view.coming] = 5.0
    total = 3.0 * len(view.targets) + 5.0 * view.coming
    assert ahead._cost(asked, np.ones(1), served, np.zeros(1)).tolist() == [total]


@pytest.mark.soak
def test_looking_ahead_for_what_waits_lets_targets_wait_less():
    problems = missions("arrivals", 40)

    def waits(choose):
        worlds = [World(one) for one in problems]
        play_together(worlds, choose, [Replanning(ExactPlanner()) for _ in problems])
        assert all(world.outcome.success for world in worlds)
        return np.mean([world.outcome.waited for world in worlds])

    assert waits(LookingAhead(POLICY, 32, "waiting").choose) < 0.99 * waits(
        Pointing(POLICY).choose)


def test_from_the_places_to_look_from_all_that_is_unseen_can_be_seen():
    world = World(missions("hidden", 1)[0])
    view = with_looks(world.view())
    sensor = view.agents[0].sensor
    assert len(view.looks) >= 10
    for look in view.looks:
        assert np.hypot(*(look.unseen - look.at).T).max() <= sensor
        there = np.array(look.from_afar(view.places[0], sensor))
        assert np.hypot(*(look.unseen - there).T).max() <= sensor + 1e-9
        assert np.hypot(*(there - view.places[0])) <= np.hypot(*(look.at - view.places[0])) + 1e-9
    seen = np.concatenate([look.unseen for look in view.looks])
    assert sorted(map(tuple, seen)) == sorted(map(tuple, world.state.ground.unseen))
    # A column each, which needs one robot with eyes.
    count, now = len(view.targets), view.moment
    assert now.need[count:, -1].tolist() == [1] * len(view.looks)
    assert not now.need[count:, :-1].any()
    assert now.start[0, count:] == pytest.approx(
        1000 * np.hypot(*(np.array([look.at for look in view.looks]) - view.places[0]).T)
        / view.agents[0].speed, abs=1)


@pytest.mark.parametrize("planner", [GreedyPlanner(), LocalSearchPlanner(iterations=500)])
def test_hidden_targets_are_found_by_planning_where_to_look(planner):
    for problem in missions("hidden", 3):
        world = World(problem)
        play(world, Replanning(planner, places=True))
        assert world.outcome.success
        assert world.outcome.seconds >= problem.optimal.bound - 0.02


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_who_may_be_lost_does_first_what_nobody_else_can(side):
    """Two targets as far to either side: the one that any can serve may wait for the slow one."""
    alone = Target((10.0 * side, 0.0), ("B",))
    anybody = Target((-10.0 * side, 0.0), ("A", "B"), "OR")
    problem = timed.check(Timed(
        "seconds", (Agent((0.0, 0.0), ("B",)), Agent((0.0, 12.0), ("A",), 0.25)),
        (anybody, alone), max_seconds=200.0,
        expects=Prospect(area=(-10.0, 0.0, 10.0, 12.0), loss=Loss(0.9, 40.0))), "test")
    view = World(problem).view()
    (chosen,) = LookingAhead(POLICY, 64).choose([view])
    assert chosen[0] == 1


def test_ways_to_places_are_each_robots_own_whatever_the_classes():
    """On the ground every robot is a class of its own, also two of the same speed."""
    problem = missions("hidden", 1)[0]
    agents = tuple(msgspec.structs.replace(a, speed=v)
                   for a, v in zip(problem.agents, (1.5, 0.36, 1.5), strict=True))
    view = World(msgspec.structs.replace(problem, agents=agents)).view()
    usual, own = view.moment, np.arange(3)
    ground = replace(usual, classes=own, between=usual.between[usual.classes])
    by_speed, by_robot = (with_looks(replace(view, moment=m)).moment for m in (usual, ground))
    np.testing.assert_array_equal(by_robot.between, by_speed.between[by_speed.classes])
    assert by_robot.between[0].max() < by_robot.between[1].max()


def test_who_has_nothing_to_do_may_be_sent_to_a_place_to_wait_at():
    """Shown beside the targets; not planned for, and turned into a place."""
    world = World(missions("lapsing", 1)[0])
    deciding = Replanning(ExactPlanner(), posts=True)
    view = deciding.shown(world.view())
    count = len(view.targets)
    assert [look.at for look in view.looks] == [
        (15.5, 15.5), (7.75, 7.75), (23.25, 7.75), (7.75, 23.25), (23.25, 23.25)]
    assert not view.moment.need[count:].any()
    bare = without_posts(view)
    assert bare.solved[count:].all()
    plan, known = of_the_known(bare), of_the_known(world.view().moment)
    assert plan.tolist() == known.tolist()
    problem = problem_in(view)
    assert np.asarray(macro_world.posts(problem)).tolist() == [False] * count + [True] * 5
    orders = deciding.settled(view, np.array([count, count + 2, -1]))
    assert orders[:2] == [(15.5, 15.5), (23.25, 7.75)]
    world.step(orders)
    assert world.state.bodies[0].phase in ("going", "there")
    # Nothing is shown once nothing more comes.
    while world.view().coming:
        world.step([-1] * 3)
    assert not deciding.shown(world.view()).looks


def test_a_policy_that_waits_somewhere_looks_ahead_from_there():
    spec = replace(POLICY.brain.spec, unfolds=True, worths=True, posts=True)
    policy = replace(POLICY, params=grafted(spec, POLICY.params),
                     brain=replace(POLICY.brain, spec=spec))
    deciding = Replanning(ExactPlanner(), posts=True)
    view = deciding.shown(later(missions("lapsing", 1)[0], 2))
    (chosen,) = LookingAhead(policy, 4).choose([view])
    assert ((chosen == -1) | ((chosen >= 0) & (chosen < len(view.moment.solved)))).all()
    again = LookingAhead(policy, 4).choose([view])[0]
    assert chosen.tolist() == again.tolist()
