"""The fused program against the step-by-step executor, on a small mission of two drones."""

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest

from moonteam.physics.backends import MjxBackend
from moonteam.planners.base import Snapshot
from moonteam.planners.learned import state_of
from moonteam.policies import entity
from moonteam.policies.brain import EntityBrain
from sim2grid.loop import fused, fused_record
from sim2grid.loop.drive import run
from sim2grid.loop.execution import Execution
from sim2grid.loop.prepare import prepare
from sim2grid.measure.metrics import make_report
from sim2grid.study.bench import DeciderPlanner
from sim2grid.waypoints import waypoints

SECONDS = 40.0


@pytest.fixture(scope="module")
def prepared(mission):
    return prepare(mission(["one drone A 0 0", "two drone B 3 1"],
                           ["A OR 1 0", "B OR 2 1", "A OR 3 0"], (4, 2), cell_m=2.0,
                           site={"preset": "flat"}, max_steps=12), "test")


@pytest.fixture(scope="module")
def backend(prepared):
    return MjxBackend(prepared.scene)


def make(prepared, backend, decider):
    return fused.Fused(backend, prepared.frame, prepared.bodies, decider,
                       max_steps=prepared.mission.max_steps, seconds=SECONDS)


def test_the_fused_program_does_what_the_executor_does(prepared, backend):
    program = make(prepared, backend, fused.FirstOpen())
    targets = prepared.scenario.targets
    other = msgspec.structs.replace(prepared.scenario, targets=targets[::-1])
    outcome = program.run([prepared.scenario, other], prepared.scene.qpos0)
    planner = DeciderPlanner(fused.FirstOpen())
    execution = Execution(prepared.mission, prepared.scenario, planner, prepared.bodies,
                          prepared.frame)
    run([execution], backend, prepared.scene.qpos0)
    record = fused_record.record_of(program.setup, outcome, 0, prepared.mission,
                                    prepared.scenario)
    assert outcome.progress.status[1] == fused.SUCCESS
    assert outcome.progress.solved_at[1].tolist() != outcome.progress.solved_at[0].tolist()
    told = execution.record
    assert told.success
    assert record.success
    assert [(s.target, s.decision, s.robots) for s in record.solves] == [
        (s.target, s.decision, s.robots) for s in told.solves]
    assert len(record.decisions) == len(told.decisions)
    for ours, theirs in zip(record.decisions, told.decisions, strict=True):
        assert ours.time_s == pytest.approx(theirs.time_s, abs=0.21)
        assert (ours.cells == theirs.cells).all()
        assert (ours.actions == theirs.actions).all()
        assert (ours.solved == theirs.solved).all()
    for ours, theirs in zip(record.legs, told.legs, strict=True):
        assert (ours.robot, ours.goal_cell, ours.ended) == (
            theirs.robot, theirs.goal_cell, theirs.ended)
    report = make_report(record, prepared.mission, prepared.frame, prepared.bases,
                         planner="first", objective=None, mode="barrier", backend="mjx", seed=0,
                         grid_plan=None, kinds=prepared.kinds)
    theirs = make_report(told, prepared.mission, prepared.frame, prepared.bases,
                         planner="first", objective=None, mode="barrier", backend="mjx", seed=0,
                         grid_plan=None, kinds=prepared.kinds)
    assert report.seconds == pytest.approx(theirs.seconds, abs=0.21)
    for ours, other in zip(report.robots, theirs.robots, strict=True):
        assert ours.distance_m == pytest.approx(other.distance_m, rel=0.05)


def test_waypoints_of_robots_that_share_a_cell(prepared):
    setup = fused.Setup(prepared.frame, fused.Rules(), (0,) * 5, (1.0,) * 5,
                        (False, True, False, False, False), 1, 1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        goals = rng.integers(0, 2, (5, 2))
        wanted = waypoints(prepared.frame, goals, ~np.array(setup.flies))
        assert np.allclose(fused._waypoints(setup, jnp.asarray(goals)), wanted, atol=1e-6)


def test_a_network_decides_for_missions_side_by_side(prepared):
    spec = entity.EntitySpec(width=16, layers=1, heads=2)
    decider = fused.PolicyDecider(EntityBrain(spec))
    params = entity.init(spec, jax.random.key(0))
    start = state_of(Snapshot.start(prepared.scenario))
    states = jax.tree.map(lambda a: np.stack([a, a]), start)
    _, actions = jax.jit(decider.decide)(params, decider.begin(2, 2), states, None,
                                         jnp.full(2, 12))
    assert actions.shape == (2, 2)
    assert ((actions >= 0) & (actions < 5)).all()
    assert actions[0].tolist() == actions[1].tolist()
