"""The arrays of the program: what is compiled in, where missions stand, what happened.

Legend: B missions (worlds), R robots, M targets, D decisions, T looks (of Rules.chunk_steps
control steps each), K kinds, H rows and W columns of the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from moonteam.grid.travel import UNREACHABLE, distances, problem_fields
from moonteam.grid.types import Problem
from moonteam.physics.backends import Log
from sim2grid.frame import Frame
from sim2grid.loop import rules as law
from sim2grid.loop.rules import Rules
from sim2grid.waypoints import kept, waypoints

UNDER_WAY, SUCCESS, MAX_STEPS, UNSOLVABLE, ENGINE = range(5)  # how a mission stands
GOING, ARRIVED, TIMEOUT, LOST = range(4)  # how a leg stands


@dataclass(frozen=True)
class Setup:
    """What is compiled in."""

    frame: Frame
    rules: Rules
    bases: tuple[int, ...]  # [R] index of each free joint in qpos
    speeds: tuple[float, ...]  # [R] m/s
    flies: tuple[bool, ...]  # [R]
    fall_tilts: tuple[float, ...]  # [R] rad
    max_steps: int  # D
    looks: int  # T

    @property
    def grounded(self) -> npt.NDArray[np.bool_]:
        """[R] False for a flyer."""
        return ~np.array(self.flies)

    def seconds(self, look: Array) -> Array:
        """Mission second of a look."""
        return look.astype(jnp.float32) * self.rules.chunk_s


class Ground(NamedTuple):
    """Where each kind can go; [B, ...] in a batch."""

    passable: Array  # [K, H, W] bool
    fields: Array  # [K, M, H, W] int32 steps to each target


class Progress(NamedTuple):
    """Where a mission stands; [B, ...] in a batch."""

    cells: Array  # [R, 2] as the last decision found them
    xy: Array  # [R, 2] m
    mask: Array  # [R] bool, still in the team
    solved: Array  # [M] bool
    solved_at: Array  # [M] int32 decision, -1: not solved
    solved_s: Array  # [M] s
    ground: Ground  # with what was learned on the way
    sources: Array  # [R, 2] cells from which the last legs set out
    goals: Array  # [R, 2] cells to which they led
    start_xy: Array  # [R, 2] m
    waypoint: Array  # [R, 2] m, of the last legs
    limit_s: Array  # [R] s at which a leg times out
    ended: Array  # [R] int32, GOING to LOST
    end_s: Array  # [R] s
    points: Array  # [R, 2] m where the robots are sent
    laid: Array  # [R, 2] cells for which these were laid out
    tilted_s: Array  # [R] s
    stalls: Array  # [R] int32
    lost: Array  # [R] int32, why, see `rules`
    lost_s: Array  # [R] s
    lost_at: Array  # [R] int32 decision
    decision: Array  # [] int32, decisions made
    settled: Array  # [] int32, decisions come to: one more than made if it ended at one
    look: Array  # [] int32
    asking: Array  # [] bool, all legs have ended
    status: Array  # [] int32, UNDER_WAY to ENGINE

    @property
    def going(self) -> Array:
        """[R] on a leg that has not ended."""
        return self.ended == GOING

    @property
    def moving(self) -> Array:
        """[R] sent to another cell by the last leg, in a batch too."""
        return jnp.any(self.goals != self.sources, axis=-1)


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
    learned: Array  # [D, R] bool, this leg closed its goal to the robot's kind


class Outcome(NamedTuple):
    """Where the missions ended and how they came there; everything [B, ...]."""

    start: Array  # [nq] qpos
    progress: Progress
    trace: Trace


def ground_of(problem: Problem) -> Ground:
    """The ground of one mission as charted."""
    fields = problem_fields(problem)
    assert problem.passable is not None
    assert fields is not None
    return Ground(problem.passable, fields)


def begin(setup: Setup, problem: Problem, qpos: Array) -> tuple[Progress, Trace]:
    """One mission at its start: qpos [nq]."""
    robots, targets, steps = len(setup.bases), problem.target_mask.shape[0], setup.max_steps
    xy = jnp.stack([qpos[b:b + 2] for b in setup.bases])
    cells = setup.frame.cell(xy)
    real, whole = jnp.zeros(robots), jnp.zeros(robots, jnp.int32)
    zero = jnp.zeros((), jnp.int32)
    progress = Progress(
        cells=cells, xy=xy, mask=problem.agent_mask, solved=~problem.target_mask,
        solved_at=jnp.full(targets, -1), solved_s=jnp.zeros(targets), ground=ground_of(problem),
        sources=cells, goals=cells, start_xy=xy, waypoint=xy, limit_s=real,
        ended=jnp.full(robots, ARRIVED), end_s=real, points=xy, laid=jnp.full_like(cells, -1),
        tilted_s=real, stalls=whole, lost=whole, lost_s=real, lost_at=whole, decision=zero,
        settled=zero, look=zero, asking=jnp.ones((), bool), status=zero)
    pairs = jnp.zeros((steps, robots, 2), jnp.int32)
    trace = Trace(
        qpos=jnp.zeros((setup.looks, qpos.shape[0])), power=jnp.zeros((setup.looks, robots)),
        propellant=jnp.zeros((setup.looks, robots)), time_s=jnp.zeros(steps), cells=pairs,
        actions=pairs[..., 0], solved=jnp.zeros((steps, targets), bool), goals=pairs,
        start_xy=jnp.zeros(pairs.shape), limit_s=jnp.zeros((steps, robots)),
        waypoint=jnp.zeros(pairs.shape), end_s=jnp.zeros((steps, robots)), ended=pairs[..., 0],
        learned=jnp.zeros((steps, robots), bool))
    return progress, trace


def unsolvable(problem: Problem, ground: Ground, now: Progress) -> Array:
    """Whether the robots left can never solve what is open over this ground."""
    reach = distances(problem, ground.fields, now.cells) < UNREACHABLE
    return jnp.any(law.unsolvable(reach, now.mask, problem.agent_skills, problem.target_skills,
                                  problem.target_and, now.solved))


def check_solvable(problem: Problem, charted: Ground, now: Progress) -> Progress:
    """Ends a mission that can never be solved. What was learned may be wrong: it is forgotten
    first.
    """
    doubt = unsolvable(problem, now.ground, now)
    ground = Ground(*(jnp.where(doubt, a, b) for a, b in zip(charted, now.ground, strict=True)))
    over = doubt & unsolvable(problem, charted, now) & (now.status == UNDER_WAY)
    return now._replace(ground=ground, status=jnp.where(over, UNSOLVABLE, now.status))


def lay_out(setup: Setup, now: Progress) -> Progress:
    """Lays out everybody's waypoint; a lost robot keeps its place."""
    goals = jnp.where(now.mask[:, None], now.goals, now.cells)
    grounded = jnp.asarray(setup.grounded)
    fresh = waypoints(setup.frame, goals, grounded, now.xy)
    stays = kept(goals, now.laid, grounded, ~now.moving)
    points = jnp.where(stays[:, None], now.points, fresh)
    going = now.going & now.mask
    return now._replace(points=points, laid=goals,
                        waypoint=jnp.where(going[:, None], points, now.waypoint))


def believed(problem: Problem, now: Progress) -> Problem:
    """The problem with the team and the ground of the moment."""
    return replace(problem, agent_mask=now.mask, passable=now.ground.passable)


def keep_decision(deciding: Array, now: Progress, sent: Progress, actions: Array,
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


def keep_learned(now: Progress, learned: Array, trace: Trace) -> Trace:
    """Writes which of the legs that have ended closed their goals: learned [R]."""
    row = jnp.where(learned.any(), now.decision - 1, trace.time_s.shape[0])
    return trace._replace(learned=trace.learned.at[row].set(learned, mode="drop"))


def keep_look(active: Array, look: Array, after: Progress, log: Log, trace: Trace) -> Trace:
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
