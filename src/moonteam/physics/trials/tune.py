"""Tunes and measures a controller whose kind says what may be tuned, in C MuJoCo.

    python -m moonteam.physics.trials.tune KIND --search 40      (prints the best numbers found)
    python -m moonteam.physics.trials.tune KIND --evaluate       (prints JSON: falls, speed, tilt)

The search is a cross-entropy method: sample the numbers around a mean, let each sample walk
every lane of an obstacle course, move mean and spread to the best quarter.

Letters: B worlds (walks), N lanes, J joints, K numbers.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from mujoco.batch import Batch

from moonteam.compilation import enable_cache
from moonteam.errors import InputError
from moonteam.physics.scene import FRICTION, Placement, Scene, build_scene, start_pose
from moonteam.robots import KINDS, RobotKind
from moonteam.robots.base import CONTROL_PERIOD, PHYSICS_DT, Command, Tuning
from moonteam.terrain.site import SPACING, Site, make_site, rough_ground
from moonteam.terrain.surface import Surface

ARRIVED = 0.15  # m from the goal
SPEED = 0.5  # m/s asked for
SUBSTEPS = round(CONTROL_PERIOD / PHYSICS_DT)

LANES = ("flat", "rough", "very rough", "up 12", "up 20", "down 12", "down 20", "across 15",
         "craters")  # fmt: skip
LANE_WIDTH = 5.0  # m
LANE_LENGTH = 24.0  # m

class Walks(NamedTuple):
    """What came of B walks."""

    arrived: np.ndarray  # [B] bool
    fallen: np.ndarray  # [B] bool
    seconds: np.ndarray  # [B] s until it arrived or fell, else the time given
    path: np.ndarray  # [B] m from start to goal
    left: np.ndarray  # [B] m to the goal at the end
    tilt: np.ndarray  # [B] rad, most, from the vertical
    energy: np.ndarray  # [B] J of mechanical work
    torque: np.ndarray  # [B] N m, most asked of a joint
    astray: np.ndarray  # [B] m, rms distance from the straight line
    astray95: np.ndarray  # [B] m, its 95th percentile
    rest: np.ndarray  # [B] m/s, speed at the end


def tuning_of(kind: RobotKind) -> Tuning:
    """What the kind lets a search change. Raises InputError if that is nothing."""
    if kind.tuning is None:
        raise InputError(kind.name, "has no numbers to tune: its kind says no `tuning`")
    return kind.tuning


def walk(
    kind: RobotKind, scene: Scene, starts: np.ndarray, goals: np.ndarray, seconds: float,
    numbers: Any = None, threads: int = 1,
) -> Walks:
    """Walks from starts [B, 7+J] (qpos) to goals [B, 2] m; leaves of `numbers` [B] or scalars.

    A walk ends three seconds after it arrives, so that `rest` tells whether the robot stands.
    """  # fmt: skip
    size = len(starts)
    worlds = Batch(scene.model, size, threads)
    qpos, qvel, ctrl = (worlds.bind(name) for name in ("qpos", "qvel", "ctrl"))
    qpos[:] = starts
    held = jnp.asarray(starts, jnp.float32)
    states = jax.vmap(kind.init)(held, jnp.zeros((size, scene.model.nv)))
    numbers = tuning_of(kind).numbers if numbers is None else numbers
    numbers = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, jnp.float32), (size,)), numbers)
    commands = Command(
        jnp.asarray(goals, jnp.float32), jnp.full(size, SPEED), jnp.zeros(size, bool)
    )
    control, upright_least = _control(tuning_of(kind).control), math.cos(kind.fall_tilt)
    way = goals - starts[:, :2]
    path = np.linalg.norm(way, axis=1)
    across = np.stack([-way[:, 1], way[:, 0]], axis=1) / np.maximum(path, 1e-9)[:, None]
    arrived, fallen = np.zeros(size, bool), np.zeros(size, bool)
    energy, tilt, torque = np.zeros(size), np.zeros(size), np.zeros(size)
    ended, spare = np.full(size, seconds), np.full(size, 3.0)
    astray: list[np.ndarray] = []
    for step in range(round((seconds + 3.0) / CONTROL_PERIOD)):
        running = ~fallen & (spare > 0.0) & (arrived | (step * CONTROL_PERIOD < seconds))
        if not running.any():
            break
        asked, states, power = control(
            numbers, states, qpos.astype(np.float32), qvel.astype(np.float32), commands,
            scene.surface,
        )  # fmt: skip
        ctrl[:] = asked
        worlds.step(ids=np.flatnonzero(running), nstep=SUBSTEPS)
        upright = 1.0 - 2.0 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2)
        left = np.linalg.norm(goals - qpos[:, :2], axis=1)
        now = (step + 1) * CONTROL_PERIOD
        fell = running & ~(upright > upright_least)
        there = running & ~fell & ~arrived & (left < ARRIVED)
        ended = np.where((fell & ~arrived) | there, now, ended)
        fallen, arrived = fallen | fell, arrived | there
        spare = np.where(arrived, spare - CONTROL_PERIOD, spare)
        moving = running & ~arrived
        energy += np.where(moving, np.asarray(power) * CONTROL_PERIOD, 0.0)
        torque = np.maximum(torque, np.where(running, np.abs(ctrl).max(axis=1), 0.0))
        tilt = np.maximum(tilt, np.where(running, np.arccos(np.clip(upright, -1, 1)), 0.0))
        aside = np.abs(np.sum((qpos[:, :2] - starts[:, :2]) * across, axis=1))
        astray.append(np.where(moving, aside, np.nan))
    track = np.array(astray)
    return Walks(
        arrived & ~fallen, fallen, ended, path, np.linalg.norm(goals - qpos[:, :2], axis=1),
        tilt, energy, torque, np.sqrt(np.nanmean(track**2, axis=0)),
        np.nanpercentile(track, 95, axis=0), np.linalg.norm(qvel[:, :3], axis=1),
    )  # fmt: skip


@cache
def _control(control: Callable[..., Any]) -> Callable[..., Any]:
    """B controllers at once; returns ctrl [B, nu], states, power [B] W."""

    def one(numbers: Any, state: Any, qpos: jax.Array, qvel: jax.Array, command: Command,
            surface: Surface) -> tuple[jax.Array, Any, jax.Array]:
        asked, state, told = control(numbers, state, jnp.zeros(()), qpos, qvel, command, surface)
        return asked, state, told.power

    return jax.jit(jax.vmap(one, in_axes=(0, 0, 0, 0, 0, None)))


def site_of(heights: np.ndarray, name: str, spacing: float = SPACING) -> Site:
    """Plain ground of one's own elevations [ny, nx] m."""
    return Site(name, 0, heights.astype(np.float32), spacing)


def course(seed: int) -> Site:
    """All lanes side by side, each along x; cliffs may stand between them."""
    shape = (round(len(LANES) * LANE_WIDTH / SPACING) + 1, round(LANE_LENGTH / SPACING) + 1)
    x = (np.arange(shape[1]) - (shape[1] - 1) / 2) * SPACING
    y = (np.arange(shape[0]) - (shape[0] - 1) / 2) * SPACING
    lane = np.clip(((y - y[0]) / LANE_WIDTH).astype(int), 0, len(LANES) - 1)
    middle = y[0] + (lane + 0.5) * LANE_WIDTH
    rng = np.random.default_rng(seed)
    heights = np.zeros(shape)
    for n, name in enumerate(LANES):
        rows = lane == n
        word, _, number = name.partition(" ")
        rms = {"flat": 0.0, "rough": 0.04, "very": 0.07}.get(word, 0.02)
        ground = rough_ground(shape, rms, seed * 100 + n, SPACING) if rms else np.zeros(shape)
        if word in ("up", "down"):
            ramp = math.tan(math.radians(float(number))) * (1 if word == "up" else -1)
            ground = ground + ramp * np.clip(x + 3.0, 0.0, 6.0)[None, :]
        if word == "across":
            ground = ground + math.tan(math.radians(float(number))) * (y - middle)[:, None]
        if word == "craters":
            for at in (-3.0, -1.0, 1.0, 3.0):
                radius = rng.uniform(0.5, 1.0)
                away = np.hypot(x[None, :] - at, (y - middle)[:, None] - rng.uniform(-1, 1))
                bowl = np.minimum(0.17 * ((away / radius) ** 2 - 1), 0.0) * radius
                rim = 0.04 * radius * np.exp(-(((away - radius) / (0.4 * radius)) ** 2))
                ground = ground + bowl + rim
        heights[rows] = ground[rows]
    return site_of(heights, "course")


def lanes(kind: RobotKind, site: Site) -> tuple[np.ndarray, np.ndarray]:
    """Starts [N, 7 + J] (qpos) and goals [N, 2] m of the lanes, each 9 m apart."""
    middles = (np.arange(len(LANES)) + 0.5 - len(LANES) / 2) * LANE_WIDTH
    yaws = {"rough": 2.8, "across 15": -1.5}  # the others face their goal
    starts = [
        start_pose(site, Placement("r", kind, (-4.5, y), yaws.get(name, 0.0)))
        for name, y in zip(LANES, middles, strict=True)
    ]
    return np.array(starts), np.stack([np.full(len(LANES), 4.5), middles], axis=1)


def score(walks: Walks) -> np.ndarray:
    """How good each walk was [B]: progress and speed, less falls, tilt and effort."""
    progress = 1.0 - walks.left / walks.path
    speed = np.where(walks.arrived, walks.path / walks.seconds, 0.0)
    effort = walks.energy / np.maximum(walks.path - walks.left, 1.0)
    return (
        progress + 2.0 * speed - 1.5 * walks.fallen - 0.3 * walks.tilt - 0.004 * effort
        - 0.5 * np.minimum(walks.rest, 0.5)
    )  # fmt: skip


def search(kind: RobotKind, generations: int, size: int, seed: int) -> Any:
    """The best mean numbers after so many generations of `size` samples."""
    begun, spans, _ = tuning_of(kind)
    names = list(spans)
    low, high = (np.array([spans[n][k] for n in names]) for k in (0, 1))
    mean = (np.array([float(getattr(begun, n)) for n in names]) - low) / (high - low)
    spread = np.full(len(names), 0.1)
    rng = np.random.default_rng(seed)
    for generation in range(generations):
        site = course(seed * 1000 + generation)
        scene = build_scene(site, [Placement("r", kind, (-4.5, 0.0))])
        starts, goals = lanes(kind, site)
        draws = np.clip(mean + spread * rng.standard_normal((size, len(names))), 0.0, 1.0)
        draws[0] = mean
        values = low + draws * (high - low)
        numbers = begun._replace(**{
            n: np.repeat(values[:, k], len(starts)) for k, n in enumerate(names)
        })  # fmt: skip
        walks = walk(kind, scene, np.tile(starts, (size, 1)), np.tile(goals, (size, 1)), 28.0,
                     numbers)
        scores = score(walks).reshape(size, -1)
        best = draws[np.argsort(-scores.mean(axis=1))[: size // 4]]
        mean = 0.4 * mean + 0.6 * best.mean(axis=0)
        spread = 0.4 * spread + 0.6 * np.maximum(best.std(axis=0), 0.02)
        found = dict(zip(names, (low + mean * (high - low)).round(4).tolist(), strict=True))
        lane_falls = walks.fallen.reshape(size, -1).mean(axis=0).round(2).tolist()
        print(
            json.dumps({"generation": generation, "mean": round(float(scores[0].mean()), 3),
                        "best": round(float(scores.mean(axis=1).max()), 3),
                        "arrived": round(float(walks.arrived.mean()), 3),
                        "falls": lane_falls, "numbers": found}),
            file=sys.stderr, flush=True,
        )  # fmt: skip
    return begun._replace(**dict(zip(names, (low + mean * (high - low)).tolist(), strict=True)))


def traverses(kind: RobotKind, site: Site, count: int, length: float, rng: np.random.Generator
              ) -> np.ndarray:
    """Ends [count, 4] m of straight walks over ground that the robot may cross."""
    found: list[np.ndarray] = []
    half = np.array(site.extent) - 1.0
    for _ in range(4000):
        if len(found) == count:
            break
        start, turn = rng.uniform(-half, half), rng.uniform(0, 2 * math.pi)
        goal = start + length * np.array([math.cos(turn), math.sin(turn)])
        if (np.abs(goal) < half).all() and _free(kind, site, start, goal):
            found.append(np.concatenate([start, goal]))
    return np.array(found)


def _free(kind: RobotKind, site: Site, start: np.ndarray, goal: np.ndarray) -> bool:
    """Nothing too steep and no boulder within reach of the straight line."""
    points = start + np.linspace(0, 1, 80)[:, None] * (goal - start)
    _, normal = site.surface.plane(jnp.asarray(points, jnp.float32), kind.footprint)
    if float(normal[:, 2].min()) < math.cos(kind.max_slope):
        return False
    grounds = np.asarray(site.surface.height(jnp.asarray(points, jnp.float32)))
    for rock in site.boulders:
        away = np.linalg.norm(points - np.asarray(rock.centre[:2])[None, :], axis=1)
        near = int(np.argmin(away))
        if away[near] < rock.reach(float(grounds[near])) + kind.footprint + 0.1:
            return False
    return True


def evaluate(
    kind: RobotKind, ground: str, seeds: range, per_site: int, friction: float, threads: int
) -> dict[str, object]:
    """Random 20 m traverses of a preset, or of 4 cm rms roughness; what a report wants."""
    parts: list[Walks] = []
    for seed in seeds:
        if ground == "rough":
            site = site_of(rough_ground((161, 161), 0.04, seed, SPACING), "rough")
        else:
            site = make_site(ground, seed, 40.0)
        ends = traverses(kind, site, per_site, 20.0, np.random.default_rng(seed))
        if not len(ends):
            continue
        placements = [
            Placement("r", kind, (e[0], e[1]), math.atan2(e[3] - e[1], e[2] - e[0]))
            for e in ends
        ]
        scene = build_scene(site, placements[:1], friction=friction)
        starts = np.array([start_pose(site, p) for p in placements])
        parts.append(walk(kind, scene, starts, ends[:, 2:], 120.0, threads=threads))
    walks = Walks(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
    return {"ground": ground, "seeds": [seeds.start, seeds.stop - 1], **summary(walks)}


def summary(walks: Walks) -> dict[str, object]:
    """The figures of B walks, for people."""
    there = walks.arrived
    count = len(there)

    def mean(values: np.ndarray, digits: int = 3) -> float | None:
        return round(float(values[there].mean()), digits) if there.any() else None

    return {
        "walks": count,
        "arrived": round(float(there.mean()), 4),
        "falls": int(walks.fallen.sum()),
        "stuck": int((~there & ~walks.fallen).sum()),
        "speed_m_s": mean(walks.path / walks.seconds),
        "tilt_max_deg": round(math.degrees(float(walks.tilt.max())), 1),
        "tilt_mean_of_max_deg": round(math.degrees(float(walks.tilt.mean())), 1),
        "cross_track_rms_m": mean(walks.astray),
        "cross_track_p95_m": mean(walks.astray95),
        "energy_J_per_m": mean(walks.energy / walks.path, 1),
        "torque_max_N_m": round(float(walks.torque.max()), 1),
        "rest_speed_m_s": mean(walks.rest),
        "rest_distance_m": mean(walks.left),
    }


def main(arguments: list[str] | None = None) -> None:
    """Entry point of `python -m moonteam.physics.trials.tune`."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("kind", help="name of a registered kind, or FILE.py:OBJECT")
    parser.add_argument("--search", type=int, default=0, help="generations to search")
    parser.add_argument("--size", type=int, default=16, help="samples a generation")
    parser.add_argument("--seed", type=int, default=1, help="first seed")
    parser.add_argument("--evaluate", action="store_true", help="print figures as JSON")
    parser.add_argument("--grounds", nargs="+", default=["course", "rough", "mare", "highland"])
    parser.add_argument("--sites", type=int, default=5, help="sites of each ground")
    parser.add_argument("--walks", type=int, default=10, help="walks on each site")
    parser.add_argument("--friction", type=float, default=FRICTION, help="of the ground")
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args(arguments)
    enable_cache()
    try:
        kind = KINDS.get(args.kind)
        tuning_of(kind)
    except InputError as error:
        parser.error(str(error))
    if args.search:
        print(search(kind, args.search, args.size, args.seed))
    if args.evaluate:
        seeds = range(args.seed, args.seed + args.sites)
        rows = []
        for ground in args.grounds:
            if ground == "course":
                rows.extend(course_rows(kind, seeds, args.friction))
            else:
                rows.append(evaluate(kind, ground, seeds, args.walks, args.friction, args.threads))
        print(json.dumps(rows, indent=1))


def course_rows(kind: RobotKind, seeds: range, friction: float) -> list[dict[str, object]]:
    """Figures lane by lane."""
    parts: list[Walks] = []
    for seed in seeds:
        site = course(seed)
        scene = build_scene(site, [Placement("r", kind, (-4.5, 0.0))], friction=friction)
        parts.append(walk(kind, scene, *lanes(kind, site), 60.0))
    by_lane = Walks(*(np.stack(columns, axis=1) for columns in zip(*parts, strict=True)))
    return [
        {"ground": name, "seeds": [seeds.start, seeds.stop - 1],
         **summary(Walks(*(column[n] for column in by_lane)))}
        for n, name in enumerate(LANES)
    ]  # fmt: skip


if __name__ == "__main__":
    main()
