"""A mission under way by the clock: the moment that it has come to, and where robots stand.

Legend: R robots, M targets.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from moonteam.onground import Floats, OnGround
from moonteam.planners.seconds.base import NEVER, Bools, Moment, enough
from moonteam.problem.mission import Mission
from sim2grid.clock.errand import Errand
from sim2grid.clock.roads import Roads
from sim2grid.frame import Frame
from sim2grid.loop.asked import Body
from sim2grid.loop.rules import metres
from sim2grid.waypoints import SLOTS

FARTHER = 1.9
"""Times as far out as the quarters are four more places, for when those are taken or closed."""

CLOSE = 0.75
"""Of two footprints: places that are nearer to each other are not for both. Opposite quarters of a
cell of a metre are for any two of our kinds, neighbouring ones for none.
"""


class Task(OnGround):
    """The mission with its bodies and what they are about."""

    def __init__(self, mission: Mission, bodies: Sequence[Body], frame: Frame):
        super().__init__(mission, [body.speed for body in bodies],
                         [body.settle for body in bodies])
        self._frame = frame
        self._footprints = np.array([body.footprint for body in bodies])
        self._grounded = np.array([not body.flies for body in bodies])

    def as_it_stands(self, roads: Roads, xy: Floats, speeds: Floats, errands: Sequence[Errand],
                     present: Bools, solved: Bools, now: float) -> Moment:
        """The moment at second `now`, with robots at `xy` [R, 2] m as fast as `speeds` [R] m/s.

        Everybody who is in no service can be sent elsewhere.
        """
        at, free = self._frame.on_map(xy), np.zeros(len(xy))
        taken, ends = solved.copy(), np.zeros(len(self.targets))
        points = self.points
        for i, errand in enumerate(errands):
            if errand.phase == "serving" and present[i]:
                free[i], at[i] = max(0.0, errand.until - now), points[errand.choice]
                taken[errand.choice], ends[errand.choice] = True, free[i]
        moment = self.moment(roads, at, speeds, present, taken, free, ends, now)
        for i, errand in enumerate(errands):
            if errand.phase == "there" and errand.choice >= 0:
                moment.start[i, errand.choice] = 0
            goal = self.homes[i]
            if errand.at_home and goal is not None and not roads.passable(self.kinds[i], goal):
                moment.start[i] = NEVER  # it could not come back
        return moment

    def spot(self, roads: Roads, robot: int, target: int, present: Bools, xy: Floats,
             errands: Sequence[Errand]) -> Floats:
        """Where a robot stands at a target [2] m: in its middle, or in a quarter of its own.

        Who needs nobody's help, or has none of its like, those on the ground or those that fly,
        keeps to the middle; else the nearest is its own, for between those that stand already there
        is no way. Nobody is sent where another of its like stands or lies (`xy` [R, 2] m, lost
        where not `present` [R]) or is bound at this target, unless nothing about it is free.
        """
        centre = self.place(self.targets[target].at)
        alike = self._grounded == self._grounded[robot]
        together = bool((self.helpers(present, target, robot) & alike).any())
        quarters = self._frame.cell_m * SLOTS
        nearest = [] if together else [centre]
        for ring in (quarters, FARTHER * quarters):
            nearest += sorted(centre + ring, key=lambda p: float(metres(p - xy[robot])))
        places = [p for p in nearest if not bool(self._frame.off_map(p, 0.0))
                  and roads.passable(self.kinds[robot], p)]
        others = [(k, errands[k].place if present[k] else xy[k])
                  for k in np.flatnonzero(alike).tolist() if k != robot
                  and (errands[k].phase != "going" or errands[k].choice == target)]
        widths = CLOSE * (self._footprints + self._footprints[robot])
        free = [p for p in places if all(metres(p - at) >= widths[k] for k, at in others)]
        return next(iter(free or places), centre)

    def helpers(self, present: Bools, target: int, robot: int) -> Bools:
        """[R] those `present` [R] beside this one that may have to stand at a target with it."""
        if self.either[target] or enough((robot,), target, self):
            return np.zeros(len(self.kinds), bool)
        useful = (self.has & (self.need[target] > 0)).any(1) & present
        useful[robot] = False
        return useful
