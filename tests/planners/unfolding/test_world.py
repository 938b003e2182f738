"""A mission that unfolds: what happens when, and who is told."""

import itertools

import msgspec
import numpy as np
import pytest

from moonteam import loading, paths
from moonteam.planners.seconds.exact import ExactPlanner
from moonteam.planners.seconds.greedy import GreedyPlanner
from moonteam.planners.unfolding import draw
from moonteam.planners.unfolding.deciding.deciders import Decider, OverFutures, Replanning
from moonteam.planners.unfolding.deciding.search import Middle, NearestUnseen, Sweep
from moonteam.planners.unfolding.future import future
from moonteam.planners.unfolding.world import World
from moonteam.problem import timed
from moonteam.problem.timed import Agent, Loss, Prospect, Target, Timed

SETS = ("following", "arrivals", "hidden", "losses", "scatter", "lapsing")


def missions(name, count):
    return loading.load_set(paths.find(f"unfolding/{name}", "testsets", ".jsonl"))[:count]


def mission(agents, targets, **more):
    return timed.check(Timed("seconds", tuple(agents), tuple(targets), **more), "test")


def played(problem, decider: Decider):
    """The world at its end, and (now, orders) of every event."""
    world, told = World(problem), []
    while not world.over:
        orders = decider.act(world.view())
        told.append((world.state.now, list(orders)))
        world.step(orders)
    return world, told


@pytest.mark.parametrize("number", range(12))
def test_where_all_is_known_the_exact_planner_needs_its_optimum(number):
    problem = loading.load_set(paths.find("seconds/3x5-7", "testsets", ".jsonl"))[number]
    world, _ = played(problem, Replanning(ExactPlanner()))
    assert world.outcome.success
    # Ways are whole milliseconds, and turning on one's way rounds them again.
    assert world.outcome.seconds == pytest.approx(problem.optimal.makespan, abs=0.02)


@pytest.mark.parametrize("name", SETS)
def test_nobody_is_faster_than_hindsight(name):
    for problem in missions(name, 6 if name == "hidden" else 25):
        for planner in (ExactPlanner(), GreedyPlanner()):
            world, _ = played(problem, Replanning(planner, NearestUnseen()))
            if problem.optimal.worth is not None:
                assert world.outcome.worth <= problem.optimal.worth + 1e-6, problem.id
                continue
            assert not world.outcome.success or (
                world.outcome.seconds >= problem.optimal.bound - 0.02), problem.id


@pytest.mark.parametrize("name", SETS)
@pytest.mark.parametrize("decider", [
    lambda: Replanning(ExactPlanner(), NearestUnseen()),
    lambda: Replanning(GreedyPlanner(), Sweep()),
    lambda: OverFutures(GreedyPlanner(), 2, 7, Sweep())],
    ids=["exact", "greedy", "futures"])
def test_what_is_not_known_yet_changes_nothing(name, decider):
    """Missions that differ in what nobody knows: until something happens all is told alike."""
    alike = 0
    for one in missions(name, 1 if name == "hidden" else 3):  # these have many decisions
        played_two = [played(problem, decider()) for problem in (one, otherwise(one, name))]
        happened = min(first_news(*two) for two in played_two)
        before = [[event for event in told if event[0] < happened] for _, told in played_two]
        assert before[0] == before[1]
        alike += len(before[0])
    assert alike >= 1


def otherwise(one, name):
    """The mission with another future."""
    world, targets, agents = World(one), list(one.targets), list(one.agents)
    for j, target in enumerate(targets):
        if j in world.state.numbers:
            continue
        x, y = target.at
        if target.hidden:
            x, y = (31.0 - value for value in world.state.ground.unseen[j])
        targets[j] = msgspec.structs.replace(
            target, at=(31.0 - x, 31.0 - y), skills=agents[j % len(agents)].skills, type="OR",
            appears=target.appears and target.appears + 1.0)
    if name == "losses":
        agents[0] = msgspec.structs.replace(agents[0], lost=17.0, pace=())
    if name == "scatter":
        agents = [msgspec.structs.replace(a, pace=a.pace[::-1]) for a in agents]
    other = msgspec.structs.replace(one, targets=tuple(targets), agents=tuple(agents))
    return timed.check(other, "other")


def first_news(world, told):
    """ms at which something that was not known from the start came to be known."""
    news = [at for at in world.state.known_at if at > 0]
    lost = [int(1000 * at) for at in world._lost if at is not None]
    came = [told[1][0]] if world.state.problem.expects.scatter else []  # the first who arrives
    return min([*news, *lost, *came, told[-1][0] + 1])


def test_a_way_takes_what_it_takes_and_that_is_known_when_it_ends():
    problem = mission(
        [Agent((0.0, 0.0), ("A",), 2.0, pace=(1.5, 0.5))],
        [Target((10.0, 0.0), ("A",), service=1.0), Target((10.0, 8.0), ("A",))],
        expects=Prospect(scatter=0.3))
    world, told = played(problem, Replanning(ExactPlanner()))
    assert world.outcome.solves == [8.5, 10.5]  # 5 s times 1.5, a service, 4 s times 0.5
    assert [now for now, _ in told] == [0, 7500, 8500]
    assert World(problem).view().moment.start.tolist() == [[5000, round(500 * np.hypot(10, 8))]]
    now = draw.in_hindsight(problem)
    assert now.start.tolist() == [[7500, round(500 * np.hypot(10, 8) / 2)]]
    assert now.between[0].tolist() == [[0, 2000], [6000, 0]]
    assert ExactPlanner().plan(now).makespan == 10202  # the other way round, had it been known


def test_our_own_ways_scatter_as_the_set_says():
    found = missions("scatter", 200)
    logs = np.log([agent.pace for one in found for agent in one.agents])
    assert np.std(logs) == pytest.approx(draw.SCATTER, rel=0.05)
    assert all(one.expects == Prospect(scatter=draw.SCATTER) for one in found)


def test_a_hidden_target_is_found_where_the_sensor_reaches_it_and_no_earlier():
    problem = mission(
        [Agent((0.0, 0.0), ("A",), 2.0, sensor=3.0)],
        [Target((20.0, 1.0), ("A",)), Target((10.0, 2.0), ("A",), hidden=True)],
        expects=Prospect(more=1, area=(0.0, 0.0, 30.0, 30.0)))
    world = World(problem)
    view = world.view()
    assert [t.at for t in view.targets] == [(20.0, 1.0)]
    assert view.coming == 1
    world.step([0])
    # On the way from (0, 0) to (20, 1): within 3 m of (10, 2).
    along = (10 * 20 + 2 * 1) / np.hypot(20, 1)
    off = abs(10 * 1 - 2 * 20) / np.hypot(20, 1)
    assert world.state.now == pytest.approx(1000 * (along - np.sqrt(9 - off**2)) / 2.0, abs=1)
    assert [t.at for t in world.view().targets] == [(20.0, 1.0), (10.0, 2.0)]


def test_one_follows_when_so_many_are_solved_and_one_appears_by_the_clock():
    problem = mission(
        [Agent((0.0, 0.0), ("A",))],
        [Target((4.0, 0.0), ("A",), service=2.0), Target((8.0, 0.0), ("A",), following=1),
         Target((8.0, 3.0), ("A",), appears=1.5)], expects=Prospect(more=2))
    world, told = played(problem, Replanning(ExactPlanner()))
    assert world.state.known_at == [0, 1500, 6000]
    assert world.outcome.solves == [6.0, 10.0, 13.0]
    assert [now for now, _ in told] == [0, 1500, 6000, 10000]
    assert world.outcome.waited == pytest.approx((4.0 + 4.0 + 11.5) / 3)


def test_what_lapses_is_missed_and_who_was_on_the_way_is_free():
    problem = mission(
        [Agent((0.0, 0.0), ("A",)), Agent((0.0, 9.0), ("B",))],
        [Target((10.0, 0.0), ("A",), lapses=4.0, worth=2.0),
         Target((0.0, 5.0), ("A", "B"), service=1.0, lapses=9.0, worth=3.0)])
    world = World(problem)
    assert world.view().optional
    world.step([0, 1])  # the first is 10 s away from what lapses after 4
    assert world.state.now == 4001
    assert world.view().moment.solved.tolist() == [True, False]
    assert world.state.bodies[0].phase == "free"
    assert world.state.place(0) == pytest.approx((4.001, 0.0))
    assert world.view().ended == 0
    world.step([1, 1])  # the other waits; too far: 6.4 s from there
    assert world.state.now == 9001
    out = world.outcome
    assert world.over
    assert (out.success, out.solved, out.worth, out.missed) == (True, 0, 0.0, 5.0)
    assert out.waited == pytest.approx((4.0 + 9.0) / 2)
    world = World(problem)
    while not world.over:
        world.step([1, 1])
    assert (world.outcome.worth, world.outcome.missed, world.outcome.seconds) == (3.0, 2.0, 6.0)


def test_a_target_without_worth_ends_the_mission_when_it_lapses():
    problem = mission([Agent((0.0, 0.0), ("A",))], [Target((3.0, 0.0), ("A",), lapses=4.0)])
    world = World(problem)
    world.step([-1])
    assert world.over
    assert world.outcome.reason == "target 0 lapsed"


def test_who_is_lost_in_service_leaves_its_target_to_others():
    team = [Agent((0.0, 0.0), ("A",), lost=5.0), Agent((9.0, 0.0), ("A",), 0.5)]
    problem = mission(team, [Target((1.0, 0.0), ("A",), service=10.0)])
    world, _ = played(problem, Replanning(ExactPlanner()))
    assert world.outcome.success
    assert world.outcome.lost == 1
    # The other sets out when the first is lost: 8 m at 0.5 m/s, and the service begins anew.
    assert world.outcome.seconds == pytest.approx(5.0 + 16.0 + 10.0)
    alone = mission(team[:1], problem.targets)
    world, _ = played(alone, Replanning(ExactPlanner()))
    assert world.outcome.reason == "the robots that are left cannot serve target 0"


def test_ways_take_their_pace_and_nobody_is_told():
    problem = mission([Agent((0.0, 0.0), ("A",), pace=(1.5, 1.0)), Agent((0.0, 5.0), ("B",))],
                      [Target((10.0, 0.0), ("A",)), Target((0.0, 7.0), ("B",), service=1.0)],
                      expects=Prospect(scatter=0.3))
    world = World(problem)
    assert world.view().agents[0].pace == ()
    world.step([0, 1])
    assert world.state.now == 2000
    world.step([0, 1])
    assert world.state.now == 3000  # the other's service has ended; a third of the way is left
    assert world.view().moment.start[0, 0] == 8000
    world.step([0, -1])
    assert world.outcome.seconds == 15.0


@pytest.mark.parametrize("pattern", [NearestUnseen, Sweep])
def test_either_pattern_finds_everything(pattern):
    for problem in missions("hidden", 8):
        world, _ = played(problem, Replanning(ExactPlanner(), pattern()))
        out = world.outcome
        assert out.success
        assert [share for _, share in out.seen] == sorted(share for _, share in out.seen)
    # Where there is nothing to be found, all of the ground is seen in the end.
    agents = tuple(msgspec.structs.replace(a, skills=("A",)) for a in problem.agents)
    empty = mission(agents, [Target((31.0, 31.0), ("A",), hidden=True),
                             Target((0.0, 0.0), ("A",), appears=500.0)],
                    max_seconds=600.0, expects=problem.expects)
    world = World(empty)
    look = pattern()
    for _ in range(2000):
        if world.over or world.state.ground.share == 1.0:
            break
        view = world.view()
        found = look.look(view, range(3))
        world.step([found.get(i, -1) for i in range(3)])
    assert world.state.ground.share == 1.0


def test_futures_are_of_what_is_expected_and_of_what_is_not_seen():
    rng = np.random.default_rng(0)
    hidden = World(missions("hidden", 1)[0])
    view = hidden.view()
    seen = {tuple(p) for p in view.ground.points[view.ground.seen].tolist()}
    drawn = [future(view, rng) for _ in range(40)]
    assert all(len(one.coming) == view.coming and all(t.hidden for t in one.coming)
               for one in drawn)
    assert not seen & {t.at for one in drawn for t in one.coming}
    arrivals = World(missions("arrivals", 1)[0]).view()
    gaps = [b.appears - a.appears for _ in range(300) for a, b in itertools.pairwise(
        future(arrivals, rng).coming)]
    assert np.mean(gaps) == pytest.approx(arrivals.expects.every, rel=0.15)
    losses = World(missions("losses", 1)[0]).view()
    times = [[t for t in future(losses, rng).lost if t is not None] for _ in range(600)]
    assert np.mean([bool(t) for t in times]) == pytest.approx(losses.expects.loss.share, abs=0.06)
    assert all(len(t) <= 1 and t[0] <= losses.expects.loss.until for t in times if t)


def test_after_a_time_without_a_loss_one_is_less_likely():
    problem = mission([Agent((0.0, 0.0), ("A",)), Agent((0.0, 0.0), ("A",))],
                      [Target((30.0, 0.0), ("A",)), Target((1.0, 0.0), ("A",), appears=30.0)],
                      expects=Prospect(more=1, every=30.0, loss=Loss(0.5, 40.0)))
    world = World(problem)
    world.step([0, -1])
    view, rng = world.view(), np.random.default_rng(1)
    assert view.now == 30_000
    lost = [any(t is not None for t in future(view, rng).lost) for _ in range(2000)]
    # 0.5 * 10/40 of all missions are lost later, 0.5 never.
    assert np.mean(lost) == pytest.approx(0.125 / 0.625, abs=0.03)


def test_choosing_over_futures_is_the_same_with_the_same_seed():
    problem = missions("following", 3)[2]
    played_twice = [played(problem, OverFutures(GreedyPlanner(), 4, 5))[1] for _ in range(2)]
    assert played_twice[0] == played_twice[1]


def test_what_is_imagined_does_not_move_the_sweep_on():
    pattern = Sweep()
    decider = OverFutures(GreedyPlanner(), 2, 5, pattern)
    view = World(missions("hidden", 1)[0]).view()
    before = pattern.look(view, range(3))
    decider.act(view)
    assert pattern.look(view, range(3)) == before


def test_choosing_over_futures_waits_for_what_is_sure_to_come():
    """A robot without a target goes to where one has to appear, replanning stands still."""
    problem = mission(
        [Agent((0.0, 0.0), ("A",))],
        [Target((1.0, 0.0), ("A",)), Target((20.0, 0.0), ("A",), appears=21.0)],
        expects=Prospect(more=1, every=20.0, area=(20.0, 0.0, 20.0, 0.0)))
    waits, _ = played(problem, Replanning(ExactPlanner()))
    goes, _ = played(problem, OverFutures(ExactPlanner(), 8))
    assert waits.outcome.seconds == pytest.approx(40.0)
    assert goes.outcome.seconds == pytest.approx(21.0)


def test_who_waits_until_another_is_there_is_asked_again_then():
    """The second goes only once the first has come, which is no news to anybody else."""
    problem = mission([Agent((0.0, 0.0), ("A",)), Agent((9.0, 0.0), ("B",))],
                      [Target((3.0, 0.0), ("A", "B"))])
    world = World(problem)
    world.step([0, -1])
    assert (world.state.now, world.over) == (3000, False)
    world.step([0, 0])
    assert world.outcome.success
    assert world.outcome.seconds == 9.0
    world = World(problem)
    world.step([0, -1])
    world.step([0, -1])
    assert world.over
    assert world.outcome.reason == "nothing can happen any more"


def test_who_has_nothing_to_do_goes_to_where_the_next_target_is_soonest_reached():
    """Of two of the same skill the second goes elsewhere, of other skills to the middle too."""
    area = (0.0, 0.0, 40.0, 40.0)
    problem = mission(
        [Agent((0.0, 0.0), ("A",), 2.0), Agent((1.0, 0.0), ("A",)), Agent((2.0, 0.0), ("B",))],
        [Target((0.0, 1.0), ("A",)), Target((38.0, 20.0), ("B",), appears=60.0)],
        expects=Prospect(more=1, every=30.0, area=area))
    view = World(problem).view()
    found = Middle().look(view, [0, 1, 2])
    assert np.hypot(*(np.array(found[0]) - 20.0)) < 5.0
    assert np.hypot(*(np.array(found[2]) - 20.0)) < 5.0
    assert found[1] != found[0]
    stays, _ = played(problem, Replanning(ExactPlanner()))
    goes, _ = played(problem, Replanning(ExactPlanner(), Middle()))
    assert goes.outcome.seconds < stays.outcome.seconds - 10.0
