"""The fused program against the step-by-step executor: mixed teams, decision by decision."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import files, paths
from moonteam.errors import InputError
from moonteam.physics.backends import MjxBackend, NativeBackend
from moonteam.planners import registry
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.planners.kind import PlannerOptions
from moonteam.planners.learned import LearnedPlanner, state_of
from moonteam.policies import entity
from moonteam.policies.brain import EntityBrain
from moonteam.policies.policy import Policy
from moonteam.problem.scenario import ACTIONS
from moonteam.terrain.site import for_mission
from sim2grid.loop.drive import run
from sim2grid.loop.execution import Execution
from sim2grid.loop.fused.deciders import PolicyDecider, decider_of
from sim2grid.loop.fused.program import Fused
from sim2grid.loop.fused.told import record_of
from sim2grid.loop.rules import Rules
from sim2grid.study.bench import DeciderPlanner
from sim2grid.study.fleet import fleet_of

LOOK = 0.2 + 1e-3  # seconds, single precision among them
TEAM = (("hopper", "drone"), ("strider", "legged"), ("rover", "wheeled"))
OVER = (0.0, 1.0, 0.0, 0.0)  # quaternion of a robot on its back


@dataclass(frozen=True)
class Script:
    """Joint actions read from `params` [B, D, R]; the last one goes on."""

    def begin(self, missions, robots):
        return jnp.arange(missions)

    def decide(self, params, memory, states, fields, horizon):
        row = jnp.minimum(states.step, params.shape[1] - 1)
        return memory, params[memory, row]


def actions(*steps):
    """[D, R] of strings such as "right stay up"."""
    return np.array([[ACTIONS.index(word) for word in step.split()] for step in steps], np.int32)


def team(mission, starts, targets, size, cell_m=1.0, max_steps=6):
    """A mission of drone (A), legged (B) and wheeled (C) at three starts "x y"."""
    robots = [f"{name} {kind} {skill} {start}" for (name, kind), skill, start
              in zip(TEAM, "ABC", starts, strict=True)]
    return mission(robots, targets, size, cell_m=cell_m, site={"preset": "flat"},
                   max_steps=max_steps)


def fleet(missions):
    """Missions of one team on flat, open ground."""
    width, height = missions[0].map.size
    free = {kind: np.ones((height, width), bool) for _, kind in TEAM}
    return fleet_of(missions, [1] * len(missions), for_mission(missions[0]), free)


def fused(crew, backend, decider, rules, max_steps):
    """The program of a fleet."""
    return Fused(backend, crew.frame, crew.bodies, decider, max_steps=max_steps, rules=rules,
                 seconds=None)


def records(crew, program, outcome):
    """Of all missions of a fleet."""
    return [record_of(program.setup, outcome, k, m, s)
            for k, (m, s) in enumerate(zip(crew.missions, crew.scenarios, strict=True))]


def stepped(crew, backend, decider, params, rules):
    """Records of all missions of a fleet, step by step."""
    executions = [
        Execution(m, s, DeciderPlanner(decider, params[k:k + 1]), crew.bodies, crew.frame,
                  rules=rules)
        for k, (m, s) in enumerate(zip(crew.missions, crew.scenarios, strict=True))]
    run(executions, backend, crew.starts)
    return [execution.record for execution in executions]


def both(crew, backend, decider, params, rules, max_steps):
    """Records of all missions of a fleet: (fused, step by step), in pairs; and the program."""
    program = fused(crew, backend, decider, rules, max_steps)
    ours = records(crew, program, program.run(crew.scenarios, crew.starts, params))
    return list(zip(ours, stepped(crew, backend, decider, params, rules), strict=True)), program


def check_same(ours, theirs):
    """Cells, actions, solved sets, arrivals and causes decision by decision."""
    assert (ours.success, ours.failure, ours.detail) == (
        theirs.success, theirs.failure, theirs.detail)
    assert len(ours.decisions) == len(theirs.decisions)
    for one, other in zip(ours.decisions, theirs.decisions, strict=True):
        assert one.cells.tolist() == other.cells.tolist()
        assert one.actions.tolist() == other.actions.tolist()
        assert one.solved.tolist() == other.solved.tolist()
        assert one.time_s == pytest.approx(other.time_s, abs=LOOK * (1 + one.decision))
    for one, other in zip(ours.legs, theirs.legs, strict=True):
        assert (one.robot, one.decision, one.from_cell, one.goal_cell, one.end_cell,
                one.ended) == (other.robot, other.decision, other.from_cell, other.goal_cell,
                               other.end_cell, other.ended)
        assert one.end_s - one.start_s == pytest.approx(other.end_s - other.start_s, abs=LOOK)
        np.testing.assert_allclose(one.waypoint, other.waypoint, atol=1e-4)
    assert [(x.robot, x.cause, x.decision) for x in ours.losses] == [
        (x.robot, x.cause, x.decision) for x in theirs.losses]
    assert ours.replans == theirs.replans
    assert [(s.target, s.decision, s.robots) for s in ours.solves] == [
        (s.target, s.decision, s.robots) for s in theirs.solves]


MEETING, APART = ("3 1", "0 0", "1 0"), ("3 1", "3 0", "1 0")  # drone, legged, wheeled
SIZE = (4, 2)
STEPS = 7


@pytest.fixture(scope="module")
def crew(mission):
    """Head-on and one behind the other; one on its back that is not needed; one that is."""
    def of(starts, *targets):
        return team(mission, starts, targets, SIZE, max_steps=STEPS)

    made = fleet([of(MEETING, "A OR 3 0", "BC AND 1 0", "C OR 0 0"),
                  of(APART, "A OR 2 1", "B OR 3 1"), of(APART, "A OR 2 1", "C OR 1 1")])
    rover = made.bodies[2].base
    made.starts[1:, rover + 3:rover + 7] = OVER
    return made


@pytest.fixture(scope="module")
def backend(crew):
    return MjxBackend(crew.scene)


def scripts(*each):
    """[B, D, R]; whoever has no word left stays."""
    rows = [actions(*steps, *["stay stay stay"] * (STEPS - len(steps))) for steps in each]
    return np.stack(rows)


JOINT = scripts(["down right left", "stay stay left"],
                ["left up right", "stay stay right"], ["left up right", "stay stay up"])


@pytest.fixture(scope="module")
def played(crew, backend):
    return both(crew, backend, Script(), JOINT, Rules(), STEPS)


def test_a_mixed_team_swaps_falls_and_is_lost_alike(played):
    pairs, _ = played
    for ours, theirs in pairs:
        check_same(ours, theirs)
    calm, fallen, needed = (theirs for _, theirs in pairs)
    assert calm.success
    first = [leg for leg in calm.legs if leg.decision == 0]
    assert [leg.goal_cell for leg in first] == [(3, 0), (1, 0), (1, 0)]  # the rover waits
    assert (1, 1, (1, 2)) in [(s.target, s.decision, s.robots) for s in calm.solves]
    assert fallen.success
    assert [(loss.robot, loss.cause) for loss in fallen.losses] == [(2, "fallen")]
    assert needed.failure == "unsolvable"


def spoiled(state, row):
    """The state with one velocity of one world that is not a number."""
    return state._replace(qvel=jnp.asarray(state.qvel).at[row, 3].set(jnp.nan))


@dataclass
class Spoiling:
    """A backend in which a number of one world is none from some look on."""

    backend: object
    row: int
    look: int

    @property
    def log_every(self):
        return self.backend.log_every

    def reset(self, qpos=None, batch=1):
        return self.backend.reset(qpos, batch)

    def advance(self, state, commands, steps):
        self.look -= 1
        return self.backend.advance(spoiled(state, self.row) if self.look == 0 else state,
                                    commands, steps)


def check_contained(before, after, row, decisions):
    """The mission of that row ends by its cause; all others are as before, to the bit."""
    for k, (one, other) in enumerate(zip(before, after, strict=True)):
        if k == row:
            assert (other.success, other.failure) == (False, "engine")
            assert other.detail == "the physics diverged (not a number, or far too fast)"
            assert len(other.decisions) == decisions
            continue
        assert (other.success, other.failure, other.detail) == (
            one.success, one.failure, one.detail)
        assert np.concatenate(other.qpos).tobytes() == np.concatenate(one.qpos).tobytes()
        assert files.dump_json(other.legs) == files.dump_json(one.legs)
        assert other.solves == one.solves


def test_what_is_no_number_ends_its_own_mission_alone(crew, backend, played):
    """In C MuJoCo, in MJX step by step, and in the fused program."""
    pairs, program = played
    native = NativeBackend(crew.scene)
    calm = stepped(crew, native, Script(), JOINT, Rules())
    for engine, before in ((native, calm), (backend, [theirs for _, theirs in pairs])):
        after = stepped(crew, Spoiling(engine, 1, 3), Script(), JOINT, Rules())
        check_contained(before, after, 1, 1)
    *given, worlds = program._arguments(crew.scenarios, crew.starts, JOINT)
    arguments = (*given, spoiled(worlds, 0))
    outcome = program._program(arguments)(*arguments)
    check_contained([ours for ours, _ in pairs], records(crew, program, outcome), 0, 1)


@pytest.mark.soak
def test_a_mixed_team_is_late_and_stuck_alike(crew, backend):
    """The robot on its back is only late, three times; what it could not enter is closed."""
    hurried = Rules(timeout_base_s=6.0, timeout_factor=1.5, fall_s=60.0)
    waits = ["stay stay right", "stay stay up", "stay stay left"]
    joint = scripts(["down right left", "stay stay left"],
                    [*waits, "left up stay"], waits)
    pairs, _ = both(crew, backend, Script(), joint, hurried, STEPS)
    for ours, theirs in pairs:
        check_same(ours, theirs)
    _, late, needed = (theirs for _, theirs in pairs)
    assert [leg.ended for leg in late.legs if leg.robot == 2][:2] == ["timeout"] * 2
    assert [(loss.robot, loss.cause) for loss in late.losses] == [(2, "stuck")]
    assert {"timeout", "impassable"} <= {cause for _, cause in late.replans}
    assert late.success
    assert needed.failure == "unsolvable"


def test_what_cannot_be_fused_says_what_can():
    with pytest.raises(InputError, match="allowed: --planner policy"):
        decider_of(ExactPlanner())
    policy = Policy.load(paths.find("any_team", "policies", ".safetensors"))
    with pytest.raises(InputError, match="allowed: --decode argmax"):
        decider_of(LearnedPlanner(policy, "sample"))
    decider, params = decider_of(LearnedPlanner(policy))
    assert isinstance(decider, PolicyDecider)
    assert params is policy.params


def test_a_network_decides_for_missions_side_by_side(crew):
    spec = entity.EntitySpec(width=16, layers=1, heads=2)
    decider = PolicyDecider(EntityBrain(spec))
    params = entity.init(spec, jax.random.key(0))
    start = state_of(Snapshot.start(crew.scenarios[0]))
    states = jax.tree.map(lambda a: np.stack([a, a]), start)
    _, joint = jax.jit(decider.decide)(params, decider.begin(2, 3), states, None,
                                       jnp.full(2, 12))
    assert joint.shape == (2, 3)
    assert ((joint >= 0) & (joint < 5)).all()
    assert joint[0].tolist() == joint[1].tolist()


def test_a_pointing_policy_decides_inside_the_program(crew, pointing):
    made = [registry.make("policy", PlannerOptions(policy=pointing, decode=how))
            for how in ("argmax", "sample")]
    with pytest.raises(InputError, match="allowed: --decode argmax"):
        decider_of(made[1])
    decider, params = decider_of(made[0])
    start = state_of(Snapshot.start(crew.scenarios[0]))
    states = jax.tree.map(lambda a: np.stack([a, a]), start)
    _, joint = jax.jit(decider.decide)(params, decider.begin(2, 3), states, None,
                                       jnp.full(2, 12))
    assert joint.shape == (2, 3)
    assert (joint[0] < 4).any()
    assert joint[0].tolist() == joint[1].tolist()
