"""Whole missions as one jitted program on MJX: decisions, waypoints, controllers, physics, cells.

What `execute` does in barrier mode, written for arrays: any number of missions of one scene
run side by side without coming back to Python, on a CPU or an accelerator. It differs from
`execute` in that

- there are no events, and ground is not learned from time-outs;
- a policy takes its likeliest action; nothing watches for circles;
- time is single precision, so a leg may time out, or a fall be noticed, one look apart;
- a mission that lasts longer than `seconds` is cut off.

Legend: B missions (worlds), R robots, M targets, D decisions, T looks (of Rules.chunk_steps
control steps each), S samples of a look.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.grid import env, scenarios
from moonteam.grid.travel import UNREACHABLE, distances, first_step, problem_fields
from moonteam.grid.types import Problem, State
from moonteam.physics.backends import Log, MjxBackend, WorldState
from moonteam.policies.brain import Brain
from moonteam.problem.scenario import Scenario
from moonteam.robots.base import Command
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.rules import Rules
from sim2grid.waypoints import SLOTS

UNDER_WAY, SUCCESS, MAX_STEPS, UNSOLVABLE, ENGINE = range(5)  # how a mission stands
GOING, ARRIVED, TIMEOUT, LOST = range(4)  # how a leg stands
PRESENT, FALLEN, STUCK, NOT_A_NUMBER, OFF_THE_MAP = range(5)  # why a robot left


class Decider(Protocol):
    """Who decides: a pure function, hashable, for it is static under jit."""

    def begin(self, missions: int, robots: int) -> Any:
        """Empty memory; every array in it begins with the axis B."""
        ...

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """(memory, joint actions [B, R]); `states`, `fields` and `horizon` have the axis B."""
        ...


@dataclass(frozen=True)
class PolicyDecider:
    """The likeliest actions of a policy's network; its `params` are given to `Fused.run`."""

    brain: Brain

    def begin(self, missions: int, robots: int) -> Any:
        """See `Decider`."""
        return self.brain.begin(missions, robots)

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """See `Decider`. Moves that the ground would turn back are never chosen."""
        memory, logits = self.brain.logits(params, memory, states, fields, horizon,
                                           jnp.zeros(horizon.shape))
        if states.problem.passable is not None:
            logits = jnp.where(jax.vmap(env.available)(states), logits, -1e9)
        return memory, jnp.argmax(logits, axis=-1)


@dataclass(frozen=True)
class FirstOpen:
    """All robots that can help with the first open target go to it; the others stay."""

    def begin(self, missions: int, robots: int) -> Any:
        """Nothing."""
        del missions, robots
        return ()

    def decide(self, params: Any, memory: Any, states: State, fields: Array | None,
               horizon: Array) -> tuple[Any, Array]:
        """See `Decider`."""
        del params, horizon
        if fields is None:
            return memory, jax.vmap(lambda s: self._one(s, None))(states)
        return memory, jax.vmap(self._one)(states, fields)

    def _one(self, state: State, fields: Array | None) -> Array:
        problem = state.problem
        target = jnp.argmax(problem.target_mask & ~state.solved)
        toward = first_step(problem, fields, state.cells)[:, target]  # [R, 4]
        able = (problem.agent_skills & problem.target_skills[target]) != 0
        return jnp.where(able & jnp.any(toward, axis=1), jnp.argmax(toward, axis=1), env.STAY)


@dataclass(frozen=True)
class Setup:
    """What is compiled in."""

    frame: Frame
    rules: Rules
    bases: tuple[int, ...]  # [R] index of each free joint in qpos
    speeds: tuple[float, ...]  # [R] m/s
    flies: tuple[bool, ...]  # [R]
    max_steps: int  # D
    looks: int  # T

    @property
    def tolerance(self) -> float:
        """Distance m from the waypoint that counts as there."""
        return self.rules.arrive_cells * self.frame.cell_m


class Progress(NamedTuple):
    """Where a mission stands; [B, ...] in a batch."""

    cells: Array  # [R, 2] as the last decision found them
    xy: Array  # [R, 2] m
    mask: Array  # [R] bool, still in the team
    solved: Array  # [M] bool
    solved_at: Array  # [M] int32 decision, -1: not solved
    solved_s: Array  # [M] s
    goals: Array  # [R, 2] cells of the legs under way
    start_xy: Array  # [R, 2] m
    waypoint: Array  # [R, 2] m
    limit_s: Array  # [R] s at which a leg times out
    ended: Array  # [R] int32, GOING to LOST
    end_s: Array  # [R] s
    tilted_s: Array  # [R] s
    stalls: Array  # [R] int32
    lost: Array  # [R] int32, PRESENT to OFF_THE_MAP
    lost_s: Array  # [R] s
    lost_at: Array  # [R] int32 decision
    decision: Array  # [] int32, decisions made
    look: Array  # [] int32
    asking: Array  # [] bool, all legs have ended
    status: Array  # [] int32, UNDER_WAY to ENGINE


class Trace(NamedTuple):
    """What happened; [B, ...] in a batch. Rows past the mission's end are zero."""

    qpos: Array  # [T, nq] at the end of each look
    power: Array  # [T, R] W, mean over the look
    propellant: Array  # [T, R] kg/s, likewise
    time_s: Array  # [D] of each decision, s
    cells: Array  # [D, R, 2]
    actions: Array  # [D, R]
    solved: Array  # [D, M] bool
    goals: Array  # [D, R, 2]
    start_xy: Array  # [D, R, 2] m
    limit_s: Array  # [D, R] s
    waypoint: Array  # [D, R, 2] m
    end_s: Array  # [D, R] s
    ended: Array  # [D, R] int32


class Outcome(NamedTuple):
    """Where the missions ended and how they came there; everything [B, ...]."""

    start: Array  # [nq] qpos
    progress: Progress
    trace: Trace


class _Carry(NamedTuple):
    worlds: WorldState
    progress: Progress
    trace: Trace
    memory: Any


class Fused:
    """Missions of one scene in one program.

    Args:
      backend: MJX with the scene of all missions.
      frame: the map on the ground.
      bodies: the scene's robots.
      decider: who decides.
      max_steps: D, decisions after which a mission has failed.
      rules: as in `execute`.
      seconds: mission seconds after which a mission is cut off.
    """

    def __init__(self, backend: MjxBackend, frame: Frame, bodies: Sequence[Body],
                 decider: Decider, *, max_steps: int = 128, rules: Rules | None = None,
                 seconds: float = 600.0):
        self.backend, self.decider = backend, decider
        rules = rules or Rules()
        self.setup = Setup(
            frame, rules, tuple(b.base for b in bodies), tuple(b.speed for b in bodies),
            tuple(b.flies for b in bodies), max_steps, round(seconds / rules.chunk_s))
        self._programs: dict[Any, jax.stages.Compiled] = {}

    def run(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any = None
            ) -> Outcome:
        """Runs missions from qpos `starts` [nq] or [B, nq] to their ends."""
        arguments = self._arguments(missions, starts, params)
        return self._program(arguments)(*arguments)

    def compile(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any = None
                ) -> float:
        """Compiles for missions of that size; returns the seconds it took."""
        begun = time.perf_counter()
        self._program(self._arguments(missions, starts, params))
        return time.perf_counter() - begun

    def _arguments(self, missions: Sequence[Scenario], starts: npt.ArrayLike, params: Any
                   ) -> tuple[Any, ...]:
        problems, _ = scenarios.stack([scenarios.to_problem(mission) for mission in missions])
        poses = np.asarray(starts, np.float32)
        poses = np.broadcast_to(poses, (len(missions), poses.shape[-1]))
        return (self.backend.model, self.backend.scene.surface, params, problems,
                self.backend.reset(poses))

    def _program(self, arguments: tuple[Any, ...]) -> jax.stages.Compiled:
        shapes = jax.tree.map(lambda a: (jnp.shape(a), jnp.result_type(a)), arguments[2:])
        leaves, treedef = jax.tree.flatten(shapes)
        key = (tuple(leaves), treedef)
        if key not in self._programs:
            program = jax.jit(partial(_run, self.setup, self.decider, self.backend.traced))
            self._programs[key] = program.lower(*arguments).compile()
        return self._programs[key]


def _run(setup: Setup, decider: Decider, advance: Any, model: Any, surface: Any, params: Any,
         problems: Problem, worlds: WorldState) -> Outcome:
    """The loop over looks; all arrays have the leading axis B."""
    fields = None if problems.passable is None else jax.vmap(problem_fields)(problems)
    batch, robots = problems.agent_mask.shape
    begin = jax.vmap(partial(_begin, setup))
    progress, trace = begin(problems, worlds.qpos)

    def under_way(carry: _Carry) -> Array:
        now = carry.progress
        return jnp.any((now.status == UNDER_WAY) & (now.look < setup.looks))

    def look(carry: _Carry) -> _Carry:
        # A true branch: the network is only asked at looks where some mission decides.
        carry = jax.lax.cond(
            jnp.any(carry.progress.asking),
            partial(_decide, setup, decider, params, problems, fields), lambda c: c, carry)
        gone = carry.worlds.diverged & (carry.progress.status == UNDER_WAY)
        progress = carry.progress._replace(
            status=jnp.where(gone, ENGINE, carry.progress.status))
        progress, commands = jax.vmap(partial(_command, setup))(progress)
        worlds, log = advance(model, surface, carry.worlds, commands, setup.rules.chunk_steps)
        observe = partial(_observe, setup)
        if fields is None:
            observed = jax.vmap(lambda p, now, s: observe(p, None, now, s))
            after = observed(problems, progress, log.qpos)
        else:
            after = jax.vmap(observe)(problems, fields, progress, log.qpos)
        active = progress.status == UNDER_WAY
        trace = jax.vmap(_keep_look)(active, progress.look, after, log, carry.trace)
        return _Carry(worlds, _pick(active, after, progress), trace, carry.memory)

    carry = jax.lax.while_loop(
        under_way, look, _Carry(worlds, progress, trace, decider.begin(batch, robots)))
    return Outcome(worlds.qpos, carry.progress, carry.trace)


def _pick(chosen: Array, new: Any, old: Any) -> Any:
    """`new` where chosen [B] or [], else `old`, leaf by leaf."""
    def one(a: Array, b: Array) -> Array:
        return jnp.where(chosen.reshape(chosen.shape + (1,) * (a.ndim - chosen.ndim)), a, b)
    return jax.tree.map(one, new, old)


def _begin(setup: Setup, problem: Problem, qpos: Array) -> tuple[Progress, Trace]:
    """One mission at its start: qpos [nq]."""
    robots, targets, steps = len(setup.bases), problem.target_mask.shape[0], setup.max_steps
    xy = jnp.stack([qpos[b:b + 2] for b in setup.bases])
    cells = setup.frame.cell(xy)
    real, whole = jnp.zeros(robots), jnp.zeros(robots, jnp.int32)
    zero = jnp.zeros((), jnp.int32)
    progress = Progress(
        cells=cells, xy=xy, mask=problem.agent_mask, solved=~problem.target_mask,
        solved_at=jnp.full(targets, -1), solved_s=jnp.zeros(targets), goals=cells, start_xy=xy,
        waypoint=xy, limit_s=real, ended=jnp.full(robots, ARRIVED), end_s=real, tilted_s=real,
        stalls=whole, lost=whole, lost_s=real, lost_at=whole, decision=zero, look=zero,
        asking=jnp.ones((), bool), status=zero)
    pairs = jnp.zeros((steps, robots, 2), jnp.int32)
    trace = Trace(
        qpos=jnp.zeros((setup.looks, qpos.shape[0])), power=jnp.zeros((setup.looks, robots)),
        propellant=jnp.zeros((setup.looks, robots)), time_s=jnp.zeros(steps), cells=pairs,
        actions=pairs[..., 0], solved=jnp.zeros((steps, targets), bool), goals=pairs,
        start_xy=jnp.zeros(pairs.shape), limit_s=jnp.zeros((steps, robots)),
        waypoint=jnp.zeros(pairs.shape), end_s=jnp.zeros((steps, robots)), ended=pairs[..., 0])
    return progress, trace


def _seconds(setup: Setup, look: Array) -> Array:
    return look.astype(jnp.float32) * setup.rules.chunk_s


def _decide(setup: Setup, decider: Decider, params: Any, problems: Problem,
            fields: Array | None, carry: _Carry) -> _Carry:
    """The decision of every mission whose legs have all ended; the others keep what they have."""
    if fields is None:
        found = jax.vmap(lambda p, now: _settle(setup, p, None, now))(problems, carry.progress)
    else:
        found = jax.vmap(partial(_settle, setup))(problems, fields, carry.progress)
    asking = carry.progress.asking & (carry.progress.status == UNDER_WAY)
    now = _pick(asking, found, carry.progress)
    deciding = asking & (now.status == UNDER_WAY)
    states = State(replace(problems, agent_mask=now.mask), now.cells, now.solved, now.decision)
    horizon = jnp.full(deciding.shape, setup.max_steps)
    memory, actions = decider.decide(params, carry.memory, states, fields, horizon)
    sent = jax.vmap(partial(_send, setup))(problems, now, actions.astype(jnp.int32))
    joint = jnp.where(now.mask, actions.astype(jnp.int32), env.STAY)
    trace = jax.vmap(_keep_decision)(deciding, now, sent, joint,
                                     jax.vmap(partial(_seconds, setup))(now.look), carry.trace)
    return _Carry(carry.worlds, _pick(deciding, sent, now)._replace(
        asking=jnp.zeros_like(asking)), trace, _pick(deciding, memory, carry.memory))


def _settle(setup: Setup, problem: Problem, fields: Array | None, now: Progress) -> Progress:
    """Positions to cells, targets solved, and whether the mission is over."""
    cells = setup.frame.settle(now.xy, now.cells)
    inside = setup.frame.inside(now.xy, cells)
    here = jnp.where(inside[:, None], cells, -1)  # on a border it keeps its cell but solves nothing
    newly = env.meets(replace(problem, agent_mask=now.mask), here) & ~now.solved
    now = now._replace(
        cells=cells, solved=now.solved | newly,
        solved_at=jnp.where(newly, now.decision, now.solved_at),
        solved_s=jnp.where(newly, _seconds(setup, now.look), now.solved_s))
    spent = jnp.where(now.decision >= setup.max_steps, MAX_STEPS, UNDER_WAY)
    failed = jnp.where(_unsolvable(problem, fields, now), UNSOLVABLE, spent)
    return now._replace(status=jnp.where(jnp.all(now.solved), SUCCESS, failed))


def _unsolvable(problem: Problem, fields: Array | None, now: Progress) -> Array:
    """Whether the robots left can never solve what is open."""
    reach = (distances(problem, fields, now.cells) < UNREACHABLE) & now.mask[:, None]
    have = jnp.zeros_like(problem.target_skills)
    for i in range(reach.shape[0]):
        have = have | jnp.where(reach[i], problem.agent_skills[i], 0)
    have = have & problem.target_skills
    met = jnp.where(problem.target_and, have == problem.target_skills, have != 0)
    return jnp.any(~met & ~now.solved)


def _send(setup: Setup, problem: Problem, now: Progress, actions: Array) -> Progress:
    """Starts a leg for every robot of the team: actions [R]."""
    speeds = jnp.array(setup.speeds)
    goals = env.moved(replace(problem, agent_mask=now.mask), now.cells, actions)
    way = jnp.linalg.norm(setup.frame.centre(goals.astype(jnp.float32)) - now.xy, axis=1)
    patience = setup.rules.timeout_base_s + setup.rules.timeout_factor * way / speeds
    return now._replace(
        goals=goals, start_xy=now.xy, limit_s=_seconds(setup, now.look) + patience,
        ended=jnp.where(now.mask, GOING, LOST), decision=now.decision + 1)


def _command(setup: Setup, now: Progress) -> tuple[Progress, tuple[Command, ...]]:
    """Waypoints of the legs under way and a command for each robot."""
    goals = jnp.where(now.mask[:, None], now.goals, now.cells)
    points = _waypoints(setup, goals)
    going = (now.ended == GOING) & now.mask
    now = now._replace(waypoint=jnp.where(going[:, None], points, now.waypoint))
    there = jnp.linalg.norm(points - now.xy, axis=1) <= setup.tolerance
    speed = jnp.where(there & ~going, 0.0, jnp.array(setup.speeds))
    return now, tuple(Command(points[i], speed[i], ~now.mask[i])
                      for i in range(len(setup.speeds)))


def _waypoints(setup: Setup, goals: Array) -> Array:
    """`waypoints.waypoints` for arrays: goals [R, 2] cells, points [R, 2] m."""
    ground = ~np.array(setup.flies)
    before = np.tri(len(ground), k=-1, dtype=bool)
    same = jnp.all(goals[:, None, :] == goals[None, :, :], axis=2) & ground[None, :]
    place = jnp.sum(same & before, axis=1) % len(SLOTS)
    shared = (jnp.sum(same, axis=1) > 1) & ground
    aside = jnp.asarray(SLOTS, jnp.float32)[place] * setup.frame.cell_m
    return setup.frame.centre(goals.astype(jnp.float32)) + jnp.where(shared[:, None], aside, 0.0)


def _observe(setup: Setup, problem: Problem, fields: Array | None, now: Progress, qpos: Array
             ) -> Progress:
    """Takes a look's samples qpos [S, nq]: losses, arrivals, time-outs, and whether to decide."""
    rules = setup.rules
    poses = jnp.stack([qpos[:, b:b + 7] for b in setup.bases], axis=1)  # [S, R, 7]
    seconds = _seconds(setup, now.look + 1)
    finite = jnp.all(jnp.isfinite(poses), axis=(0, 2))
    over = jnp.min(_tilt(poses[..., 3:7]), axis=0) > np.radians(60.0)
    tilted = jnp.where(over, now.tilted_s + rules.chunk_s, 0.0)
    xy = jnp.where(finite[:, None], poses[-1, :, :2], now.xy)
    cause = jnp.where(setup.frame.off_map(xy), OFF_THE_MAP, PRESENT)
    cause = jnp.where(tilted >= rules.fall_s - 1e-3, FALLEN, cause)
    cause = jnp.where(finite, cause, NOT_A_NUMBER)
    speed = jnp.linalg.norm(xy - now.xy, axis=1) / rules.chunk_s
    now = _lose(now._replace(xy=xy, tilted_s=tilted, look=now.look + 1), cause, seconds)

    going = now.ended == GOING
    near = jnp.linalg.norm(xy - now.waypoint, axis=1) <= setup.tolerance
    there = near & setup.frame.inside(xy, now.goals) & (tilted == 0.0) & (
        speed <= rules.arrive_speed * jnp.array(setup.speeds))
    moving = jnp.any(now.goals != now.cells, axis=1)
    arrived = going & (~moving | there)
    late = going & ~arrived & (seconds >= now.limit_s)
    length = jnp.linalg.norm(now.waypoint - now.start_xy, axis=1)
    left = jnp.linalg.norm(now.waypoint - xy, axis=1)
    stalled = length - left < rules.stuck_progress * length
    stalls = jnp.where(late, jnp.where(stalled, now.stalls + 1, 0), now.stalls)
    stalls = jnp.where(arrived & moving, 0, stalls)
    now = now._replace(
        stalls=stalls, end_s=jnp.where(arrived | late, seconds, now.end_s),
        ended=jnp.where(arrived, ARRIVED, jnp.where(late, TIMEOUT, now.ended)))
    now = _lose(now, jnp.where(late & (stalls >= rules.stuck_after), STUCK, PRESENT), seconds)

    lost_now = jnp.any((now.lost != PRESENT) & (now.lost_s == seconds))
    over = lost_now & _unsolvable(problem, fields, now)
    return now._replace(asking=jnp.all(now.ended != GOING),
                        status=jnp.where(over, UNSOLVABLE, now.status))


def _lose(now: Progress, cause: Array, seconds: Array) -> Progress:
    """Takes robots with a cause [R] other than PRESENT out of the team."""
    gone = now.mask & (cause != PRESENT)
    cut = gone & (now.ended == GOING)
    return now._replace(
        mask=now.mask & ~gone, lost=jnp.where(gone, cause, now.lost),
        lost_s=jnp.where(gone, seconds, now.lost_s),
        lost_at=jnp.where(gone, now.decision, now.lost_at),
        ended=jnp.where(cut, LOST, now.ended), end_s=jnp.where(cut, seconds, now.end_s))


def _tilt(quat: Array) -> Array:
    """Angle [...] rad between a body's z axis and up: quat [..., 4] wxyz."""
    x, y = quat[..., 1], quat[..., 2]
    size = jnp.maximum(jnp.sum(quat**2, axis=-1), 1e-12)
    return jnp.arccos(jnp.clip(1.0 - 2.0 * (x * x + y * y) / size, -1.0, 1.0))


def _keep_decision(deciding: Array, now: Progress, sent: Progress, actions: Array,
                   seconds: Array, trace: Trace) -> Trace:
    """Writes a decision into its row; nowhere if the mission did not decide."""
    row = jnp.where(deciding, now.decision, trace.time_s.shape[0])

    def put(rows: Array, value: Array) -> Array:
        return rows.at[row].set(value, mode="drop")

    return trace._replace(
        time_s=put(trace.time_s, seconds), cells=put(trace.cells, now.cells),
        actions=put(trace.actions, actions), solved=put(trace.solved, now.solved),
        goals=put(trace.goals, sent.goals), start_xy=put(trace.start_xy, sent.start_xy),
        limit_s=put(trace.limit_s, sent.limit_s))


def _keep_look(active: Array, look: Array, after: Progress, log: Log, trace: Trace) -> Trace:
    """Writes a look and the legs as it left them; nowhere if the mission was over before."""
    row = jnp.where(active, look, trace.qpos.shape[0])
    leg = jnp.where(active, after.decision - 1, trace.time_s.shape[0])
    return trace._replace(
        qpos=trace.qpos.at[row].set(log.qpos[-1], mode="drop"),
        power=trace.power.at[row].set(log.power.mean(axis=0), mode="drop"),
        propellant=trace.propellant.at[row].set(log.propellant_rate.mean(axis=0), mode="drop"),
        waypoint=trace.waypoint.at[leg].set(after.waypoint, mode="drop"),
        end_s=trace.end_s.at[leg].set(after.end_s, mode="drop"),
        ended=trace.ended.at[leg].set(after.ended, mode="drop"))
