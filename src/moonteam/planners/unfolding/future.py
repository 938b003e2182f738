"""What may still happen in a mission, drawn from what everybody expects of it.

New targets are as `grid.sampling` draws them: skills even over all sets of them that somebody of
the team has, either any or all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import msgspec
import numpy as np

from moonteam.planners.seconds.base import MS
from moonteam.planners.unfolding.world import View, World
from moonteam.problem.timed import Place, Prospect, Target

Rng = np.random.Generator


@dataclass(frozen=True)
class Future:
    """One of them. Seconds count from the mission's start."""

    coming: tuple[Target, ...]
    lost: tuple[float | None, ...]  # [N] s
    pace: np.ndarray | None  # [N, M + coming]

    def world(self, view: View) -> World:
        """A world in which it comes to pass."""
        return view.imagine(self.coming, self.lost, self.pace)


def future(view: View, rng: Rng) -> Future:
    """A future drawn from `view.expects`, given all that is known."""
    expects, now = view.expects, view.now / MS
    solved = view.ended
    coming = []
    for k in range(view.coming):
        skills, kind = asked(view.state.names, tuple(a.skills for a in view.agents), rng)
        target = Target(somewhere(view, rng), skills, kind)
        if view.ground is not None:
            target = msgspec.structs.replace(target, hidden=True)
        elif expects.every is not None:
            now += float(rng.exponential(expects.every))
            target = msgspec.structs.replace(target, appears=now, **lapsing(expects, now, rng))
        else:
            target = msgspec.structs.replace(target, following=solved + k + 1)
        coming.append(target)
    return Future(tuple(coming), _lost(view, rng), _pace(expects, (
        len(view.agents), len(view.targets) + len(coming)), rng))


def lapsing(expects: Prospect, appears: float, rng: Rng) -> dict[str, float]:
    """What a target that appears counts, and when it lapses, by the names of its fields."""
    found = {}
    if expects.worth is not None:
        found["worth"] = round(float(rng.uniform(*expects.worth)), 1)
    if expects.stays is not None:
        found["lapses"] = round(appears + float(rng.uniform(*expects.stays)), 3)
    return found


def asked(names: tuple[str, ...], team: tuple[tuple[str, ...], ...], rng: Rng
          ) -> tuple[tuple[str, ...], Literal["AND", "OR"]]:
    """Skills that a new target needs, and whether all or any of them."""
    have = {skill for skills in team for skill in skills}
    while True:
        bits = int(rng.integers(1, 2**len(names)))
        skills = tuple(name for k, name in enumerate(names) if bits >> k & 1)
        if have.issuperset(skills):
            return skills, "AND" if len(skills) > 1 and rng.random() < 0.5 else "OR"


def somewhere(view: View, rng: Rng) -> Place:
    """Where a target may be: on unseen ground where that matters."""
    if view.ground is not None:
        unseen = view.ground.unseen
        points = unseen if len(unseen) else view.ground.points.reshape(-1, 2)
        x, y = points[int(rng.integers(len(points)))]
        return float(x), float(y)
    west, south, east, north = view.expects.area or _box(view)
    if all(float(v).is_integer() for v in (west, south, east, north)):
        return (float(rng.integers(int(west), int(east) + 1)),
                float(rng.integers(int(south), int(north) + 1)))
    return float(rng.uniform(west, east)), float(rng.uniform(south, north))


def _box(view: View) -> tuple[float, float, float, float]:
    """Of all places that are known."""
    spots = np.array([*(t.at for t in view.targets), *view.places.tolist()], float)
    (west, south), (east, north) = spots.min(0), spots.max(0)
    return float(west), float(south), float(east), float(north)


def may_lose(view: View) -> bool:
    """Whether a robot may still be lost."""
    loss = view.expects.loss
    return loss is not None and bool(view.moment.present.all()) and view.now / MS < loss.until


def _lost(view: View, rng: Rng) -> tuple[float | None, ...]:
    loss = view.expects.loss
    none: list[float | None] = [None] * len(view.agents)
    now = view.now / MS
    if loss is not None and may_lose(view):
        later = loss.share * (1 - now / loss.until)
        if rng.random() < later / (1 - loss.share + later):
            none[int(rng.integers(len(none)))] = float(rng.uniform(now, loss.until))
    return tuple(none)


def _pace(expects: Prospect, shape: tuple[int, int], rng: Rng) -> np.ndarray | None:
    return np.exp(expects.scatter * rng.standard_normal(shape)) if expects.scatter else None
