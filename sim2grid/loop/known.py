"""What is known in an execution: where the robots are, how they do, what the ground lets through.

Legend: R robots, M targets, T samples of a look.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from moonteam.planners.base import Snapshot
from sim2grid.loop import rules
from sim2grid.loop.asked import Asked
from sim2grid.loop.replan import unsolvable, without_cell

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]


class Known:
    """The grid as physics left it. `snapshot` holds cells and solved targets as last decided on."""

    def __init__(self, asked: Asked):
        robots = len(asked.bodies)
        self._asked = asked
        self.snapshot = asked.snapshot()
        self.xy: Floats = np.zeros((robots, 2))
        self.speeds: Floats = np.array([body.speed for body in asked.bodies])
        self.tilted_s: Floats = np.zeros(robots)
        self.stalls = np.zeros(robots, int)
        self.silent_until = np.zeros(robots, int)  # decision from which it is heard again
        self._fall_tilts = np.array([body.fall_tilt for body in asked.bodies])
        self._charted = self.snapshot.passable  # without what was learned on the way

    @property
    def mask(self) -> Bools:
        """[R] still in the team."""
        return self.snapshot.agent_mask

    def silent(self, decision: int) -> Bools:
        """[R] robots of which nothing is heard at a decision."""
        return self.silent_until > decision

    def start(self, xy: Floats) -> None:
        """Takes the robots' first places [R, 2]."""
        self.xy = xy
        self.snapshot = replace(self.snapshot, cells=self._asked.frame.cell(xy))

    def look(self, poses: Floats, seconds: float) -> npt.NDArray[np.int32]:
        """Takes a look's poses [T, R, 7]; why robots of the team are gone, [R], see `rules`."""
        asked = self._asked
        self.tilted_s = np.where(self.mask, rules.tilted(
            poses[:, :, 3:7], self._fall_tilts, self.tilted_s, seconds), self.tilted_s)
        cause = rules.losses(asked.rules, asked.frame, np.isfinite(poses).all((0, 2)),
                             self.tilted_s, poses[-1, :, :2])
        return np.where(self.mask, cause, rules.PRESENT)

    def drop(self, robot: int) -> None:
        """Takes a robot out of the team."""
        mask = self.mask.copy()
        mask[robot] = False
        self.snapshot = replace(self.snapshot, agent_mask=mask)

    def settle(self, decision: int) -> None:
        """Positions to cells, for a decision."""
        cells = self._asked.frame.settle(self.xy, self.snapshot.cells)
        self.snapshot = replace(self.snapshot, cells=cells, step=decision)

    def believed(self, goals: npt.NDArray[np.int32], decision: int) -> Snapshot:
        """The moment as the planner sees it.

        A silent robot is believed to be where it was last sent, `goals` [R, 2]. In async mode,
        where each robot's decisions count, the clock is that of the team.
        """
        cells = np.where(self.silent(decision)[:, None], goals, self.snapshot.cells)
        return replace(self.snapshot, cells=cells, step=decision // self._asked.pace,
                       max_steps=self._asked.mission.max_steps)

    def solve(self, xy: Floats, cells: npt.NDArray[np.int32]) -> Bools:
        """Marks targets whose needed robots stand in their cell, at `xy` and `cells` [R, 2].

        Returns [R, M], who contributed to those that are solved now.
        """
        now = self.snapshot
        here = rules.present(self._asked.frame, xy, cells, now.target_cells)
        shares = rules.contributing(here & self.mask[:, None] & ~now.solved[None],
                                    now.agent_skills, now.target_skills, now.target_and)
        self.snapshot = replace(now, solved=now.solved | shares.any(0))
        return shares

    def learn(self, robot: int, cell: npt.NDArray[np.int32]) -> bool:
        """Closes ground that a robot could not cross to its kind, if all can still be solved.

        Whether that is news.
        """
        kind, known = int(self.snapshot.agent_kinds[robot]), self.snapshot.passable
        if known is not None and not known[kind, cell[1], cell[0]]:
            return False
        closed = without_cell(self.snapshot, kind, cell)
        if unsolvable(closed):
            return False
        self.snapshot = closed
        return True

    def unsolvable(self) -> list[int]:
        """Open targets that can never be solved. What was learned may be wrong: it is forgotten
        first.
        """
        if not unsolvable(self.snapshot):
            return []
        self.snapshot = replace(self.snapshot, passable=self._charted)
        return unsolvable(self.snapshot)
