"""Where a robot on its way is sent next: a point ahead on it, past whoever stands or comes.

Legend: R robots; points are [2] m. On the ground everybody keeps to the right of who comes, passes
who stands, and of two whose ways cross the one with the higher index waits.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]

AHEAD = 1.5
"""m on its way that a robot is sent ahead of where it is, so that it need not slow down."""

TURN = 0.4
"""m before a corner at which it is sent round it; earlier it would cut it."""

LOOK = 2.2
"""m within which robots mind each other."""

GAP = 0.15
"""m kept between two footprints."""

HEAD_ON, SAME_WAY = -0.3, 0.6
"""Cosines between two headings: below, they meet; above, one follows the other."""


def along(points: Floats, xy: Floats) -> tuple[int, float]:
    """The piece of a way [P, 2] that is nearest to xy [2], and the share of it that is done."""
    starts, ends = points[:-1], points[1:]
    runs = ends - starts
    length = np.maximum((runs ** 2).sum(-1), 1e-12)
    share = np.clip(((xy - starts) * runs).sum(-1) / length, 0.0, 1.0)
    away = np.linalg.norm(starts + share[:, None] * runs - xy, axis=-1)
    piece = int(np.argmin(np.round(away, 6)[::-1]))
    piece = len(runs) - 1 - piece  # of equally near pieces the later one
    return piece, float(share[piece])


def carrot(points: Floats, xy: Floats, ahead: float = AHEAD) -> Floats:
    """The point [2] that lies `ahead` m farther on a way [P, 2] than xy [2] has come."""
    piece, share = along(points, xy)
    at = points[piece] + share * (points[piece + 1] - points[piece])
    to_corner = float(np.linalg.norm(points[piece + 1] - at))
    if to_corner > TURN:
        return at + (min(ahead, to_corner) / to_corner) * (points[piece + 1] - at)
    for end in points[piece + 1:]:
        step = float(np.linalg.norm(end - at))
        if step >= ahead:
            return at + (ahead / step) * (end - at)
        ahead -= step
        at = end
    return at


def mind(xy: Floats, aims: Floats, goals: Floats, moving: Bools, grounded: Bools, radii: Floats,
         passable: Callable[[int, Floats], bool]) -> tuple[Floats, Bools]:
    """Points [R, 2] to go to, and who has to stand still [R].

    Args:
      xy: [R, 2] where everybody is, lost robots included.
      aims: [R, 2] where each would go next.
      goals: [R, 2] the end of each way.
      moving: [R] on its way.
      grounded: [R] False for a flyer, which is in nobody's way.
      radii: [R] m, of footprints.
      passable: whether a robot (its index) can be at a point.
    """
    points, holds = aims.copy(), np.zeros(len(xy), bool)
    headings = _unit(aims - xy)
    for i in np.flatnonzero(moving & grounded).tolist():
        others = [k for k in np.flatnonzero(grounded).tolist() if k != i]
        nearest = sorted(others, key=lambda k: float(np.linalg.norm(xy[k] - xy[i])))
        for k in nearest:
            found = _pass(i, k, xy, headings, goals, bool(moving[k]), radii)
            if found is None:
                continue
            free = [point for point in found if passable(i, point)]
            if free:
                points[i] = free[0]
            else:
                holds[i] = True
            break
    return points, holds


def _pass(i: int, k: int, xy: Floats, headings: Floats, goals: Floats, moves: bool,
          radii: Floats) -> list[Floats] | None:
    """Points by which robot i gets past robot k, best first; none: it waits. None: k is nowhere
    in the way.
    """
    away = xy[k] - xy[i]
    ahead = headings[i]
    left = np.array([-ahead[1], ahead[0]])
    front, side = float(away @ ahead), float(away @ left)
    gap = radii[i] + radii[k] + GAP
    left_to_go = float(np.linalg.norm(goals[i] - xy[i]))
    if np.linalg.norm(goals[i] - xy[k]) < gap:  # they are bound for places side by side
        gap = 0.8 * (radii[i] + radii[k])
    if not 0.0 < front < min(LOOK, left_to_go + gap) or abs(side) >= gap:
        return None
    facing = float(headings[i] @ headings[k]) if moves else 0.0
    beside = xy[i] + max(front, 0.6) * ahead
    right, other = beside + (side - gap) * left, beside + (side + gap) * left
    if moves and facing > SAME_WAY:
        first = i < k and float(-away @ headings[k]) > 0.0  # each has the other before it
        return None if first or front > gap + 0.4 else []
    if moves and facing > HEAD_ON:
        return [] if k < i and front < gap + 1.0 else None
    if moves:
        return [right]
    return [right, other] if side >= 0 else [other, right]


def _unit(vectors: Floats) -> Floats:
    """Vectors [R, 2] of length 1; zero where they are."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-9)
