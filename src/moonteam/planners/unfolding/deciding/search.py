"""How robots with eyes look for hidden targets: two patterns, and places as if they were targets.

Legend: N robots, U points not seen yet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from moonteam.grid.macro.draw import places, post_places
from moonteam.grid.macro.sight import INSIDE
from moonteam.planners.seconds.base import NEVER, Int64, Moment
from moonteam.planners.unfolding.ground import Look, Post
from moonteam.planners.unfolding.state import distances, ms
from moonteam.planners.unfolding.world import View
from moonteam.problem.timed import Place


class Pattern(Protocol):
    """Says where robots go that have nothing else to do, while targets are still to come."""

    eyes: bool
    """Whether it is for robots that see, where something is hidden; else for all."""

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """A place for each robot that has nothing else to do."""
        ...


class Middle:
    """Everybody to where the next target is soonest reached in the mean.

    Robots of the same skills share the area: each goes where the mean, over places, of the time of
    whoever of them is there first falls most.
    """

    eyes = False

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """See `Pattern`."""
        area = view.expects.area
        if area is None:
            return {}
        spread = places(np.array(area[:2]), np.array(area[2:]))
        far = distances(spread, spread, view.state.problem.metric)
        found: dict[int, Place] = {}
        first: dict[tuple[str, ...], np.ndarray] = {}
        for i in sorted(idle, key=lambda i: -view.agents[i].speed):
            skills, took = view.agents[i].skills, far / view.agents[i].speed
            others = first.get(skills, np.full(len(spread), np.inf))
            means = np.minimum(took, others).mean(1)
            best = int(means.argmin())
            first[skills] = np.minimum(took[best], others)
            x, y = spread[best]
            found[i] = float(x), float(y)
        return found


class NearestUnseen:
    """Everybody to the point not seen yet that it can look at soonest and nobody else looks at.

    Who is soonest chooses first; what it will see from there is left out for the others.
    """

    eyes = True

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """See `Pattern`."""
        if view.ground is None or not idle:
            return {}
        left = view.ground.unseen
        found: dict[int, Place] = {}
        todo = list(idle)
        while todo and len(left):
            here = view.places[todo]
            reach = np.array([INSIDE * (view.agents[i].sensor or 0.0) for i in todo])
            speed = np.array([view.agents[i].speed for i in todo])
            gap = np.maximum(distances(here, left, "straight") - reach[:, None], 0.0)
            cost = gap / speed[:, None]
            row, column = np.unravel_index(int(cost.argmin()), cost.shape)
            i, point = todo.pop(int(row)), left[int(column)]
            place = from_afar(view.places[i], point, float(reach[row]))
            found[i] = place
            left = left[np.hypot(*(left - place).T) > reach[row]]
        return found


class Sweep:
    """Boustrophedon: the area is cut into strips from west to east, a robot each, as wide as it is
    fast; each goes up and down its own in lanes as wide as it sees, then looks where it is nearest.
    """

    eyes = True

    def __init__(self, near: float = 1e-6) -> None:
        self._near = near  # m, at which the end of a lane has been reached
        self._lanes: dict[int, list[Place]] = {}
        self._rest = NearestUnseen()
        self._cut = False

    def look(self, view: View, idle: Sequence[int]) -> dict[int, Place]:
        """See `Pattern`."""
        if view.ground is None:
            return {}
        if not self._cut:
            self._strips(view)
        found, free = {}, []
        for i in idle:
            lanes = self._lanes.get(i, [])
            while lanes and np.hypot(*(view.places[i] - lanes[0])) <= self._near:
                lanes.pop(0)
            if lanes:
                found[i] = lanes[0]
            else:
                free.append(i)
        return found | self._rest.look(view, free)

    def _strips(self, view: View) -> None:
        """Lanes of everybody who has eyes, the westernmost robot the westernmost strip."""
        assert view.ground is not None
        self._cut = True
        (west, south), (east, north) = view.ground.points[0, 0], view.ground.points[-1, -1]
        eyes = [i for i in np.flatnonzero(view.moment.present).tolist()
                if view.agents[i].sensor is not None]
        eyes.sort(key=lambda i: float(view.places[i, 0]))
        speeds = np.array([view.agents[i].speed for i in eyes])
        edges = west + (east - west) * np.concatenate([[0.0], np.cumsum(speeds) / speeds.sum()])
        for k, i in enumerate(eyes):
            reach = INSIDE * (view.agents[i].sensor or 0.0)
            width = edges[k + 1] - edges[k]
            count = max(1, int(np.ceil(width / (2 * reach))))
            middles = edges[k] + width * (np.arange(count) + 0.5) / count
            # The ends of a lane are seen from as far inside as half a lane allows.
            inset = min(np.sqrt(max(reach**2 - (width / count / 2)**2, 0.0)), (north - south) / 2)
            low, high = float(south + inset), float(north - inset)
            up = abs(view.places[i, 1] - low) <= abs(view.places[i, 1] - high)
            if abs(view.places[i, 0] - middles[0]) > abs(view.places[i, 0] - middles[-1]):
                middles = middles[::-1]
            lanes: list[Place] = []
            for x in middles.tolist():
                lanes += [(x, low), (x, high)] if up else [(x, high), (x, low)]
                up = not up
            self._lanes[i] = lanes


def with_looks(view: View) -> View:
    """What is known, with a column in `moment` for each place to look from, the last ones: as if
    it were a target that needs somebody with eyes, and no time.

    Without any where nothing is hidden any more.
    """
    reach = [INSIDE * agent.sensor for agent in view.agents if agent.sensor is not None]
    if view.ground is None or not view.coming or not reach:
        return view
    eyes = np.array([agent.sensor is not None for agent in view.agents])
    return _with_columns(view, view.ground.looks(min(reach)), eyes)


def with_posts(view: View) -> View:
    """What is known, with a column in `moment` for each place to wait at, the last ones: as if it
    were a target that needs nobody.

    Without any where nothing is to come, nobody knows where, or there are places to look from.
    """
    area = view.expects.area
    if not view.coming or area is None or view.looks:
        return view
    spots = post_places(np.array(area[:2]), np.array(area[2:])).tolist()
    nobody = np.zeros(len(view.agents), bool)
    return _with_columns(view, [Post((x, y), np.zeros((0, 2))) for x, y in spots], nobody)


def posts(view: View) -> Int64:
    """The columns of `moment` that are places to wait at."""
    return np.array([k for k, look in enumerate(view.looks, len(view.targets))
                     if isinstance(look, Post)], np.int64)


def without_posts(view: View) -> Moment:
    """What there is to plan for: `moment`, its posts neither open nor of use."""
    return view.moment.without(posts(view))


def _with_columns(view: View, looks: Sequence[Look], able: np.ndarray) -> View:
    """The view with these places, each of which needs one of those who are `able` [N] bool, if any
    are.
    """
    now, count = view.moment, len(looks)
    moment = replace(now, has=np.concatenate([now.has, able[:, None]], 1),
                     need=np.pad(now.need, ((0, 0), (0, 1))))
    need = np.zeros((count, moment.need.shape[1]), np.int64)
    need[:, -1] = able.any()
    spots = np.array([look.at for look in looks], float).reshape(-1, 2)
    shown = with_more(replace(view, moment=moment), spots, need, np.zeros(count, bool),
                      np.zeros((count, len(now.solved)), bool))
    return replace(view, moment=shown, looks=tuple(looks))


def with_more(view: View, more: np.ndarray, need: np.ndarray, either: np.ndarray,
              after: np.ndarray) -> Moment:
    """The view's moment with columns for P targets more, the last ones, without services.

    Args:
      view: of M columns: its targets, then its places to look from.
      more: [P, 2] m, where they are.
      need: [P, S] how many with each skill they need.
      either: [P] bool, whether anybody with one of these skills will do.
      after: [P, M] bool, which of the columns have to be solved before.
    """
    now, metric, count = view.moment, view.state.problem.metric, len(more)
    known = [*(t.at for t in view.targets), *(look.at for look in view.looks)]
    spots = np.concatenate([np.array(known, float).reshape(-1, 2), more])
    speeds = np.array([agent.speed for agent in view.agents])
    far = distances(spots, spots, metric)
    of_class = [speeds[now.classes == c][0] for c in range(len(now.between))]
    between = np.stack([ms(far, speed) for speed in of_class])
    between[:, :len(known), :len(known)] = now.between
    waits = np.pad(now.after, ((0, count), (0, count)))
    waits[len(known):, :len(known)] = after

    def longer(column: np.ndarray, value: int = 0) -> np.ndarray:
        return np.concatenate([column, np.full(count, value, column.dtype)])

    start = ms(distances(view.places, more, metric), speeds[:, None])
    return replace(
        now, start=np.concatenate([now.start, start], 1), between=between,
        home=np.concatenate([now.home, np.zeros_like(start)], 1),
        need=np.concatenate([now.need, need]), either=np.concatenate([now.either, either]),
        service=longer(now.service), after=waits, appears=longer(now.appears),
        lapses=longer(now.lapses, NEVER), solved=longer(now.solved), ends=longer(now.ends),
        middle=view.state.middle(spots), worth=None if now.worth is None else longer(now.worth))


def from_afar(here: np.ndarray, point: np.ndarray, reach: float) -> Place:
    """The place on the straight way to a point from which it is within reach."""
    gap = float(np.hypot(*(point - here)))
    share = max(gap - reach, 0.0) / gap if gap > 0 else 0.0
    x, y = here + share * (point - here)
    return float(x), float(y)
