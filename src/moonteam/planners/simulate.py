"""Plans replayed on the host: a few lines of NumPy, without JAX.

What a move does and what solves a target is in `problem.rules`, for the environment in
`moonteam.grid` too; tests hold the two to each other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from moonteam.planners.base import BoolArray, IntArray, Snapshot, solved_now
from moonteam.problem import rules
from moonteam.problem.rules import DISPLACEMENTS, STAY


def moved(snapshot: Snapshot, actions: npt.ArrayLike) -> IntArray:
    """Cells [N, 2] after the joint action [N]; the border and blocked cells throw back.

    Lost agents (`agent_mask` False) do not move.
    """
    goal = snapshot.cells + DISPLACEMENTS[np.asarray(actions, np.int32)]
    return rules.moved(snapshot.cells, goal, snapshot.agent_mask, snapshot.agent_kinds,
                       snapshot.size, snapshot.passable).astype(np.int32)


def holding(snapshot: Snapshot) -> BoolArray:
    """[M] True where a target is solved, or its requirement holds at this moment."""
    skills = np.where(snapshot.agent_mask, snapshot.agent_skills, 0)
    return snapshot.solved | solved_now(snapshot.cells, skills, snapshot.target_cells,
                                        snapshot.target_skills, snapshot.target_and)


def step(snapshot: Snapshot, actions: npt.ArrayLike) -> Snapshot:
    """The next moment: everybody moves, then targets are solved."""
    after = replace(snapshot, cells=moved(snapshot, actions), step=snapshot.step + 1)
    return replace(after, solved=holding(after))


@dataclass(frozen=True)
class Trace:
    """What a list of joint actions did, up to the step that solved the last target."""

    cells: IntArray  # [T + 1, N, 2] cells, entry 0 is the start
    solved: BoolArray  # [T + 1, M]
    actions: IntArray  # [T, N]

    @property
    def complete(self) -> bool:
        """Whether every target was solved."""
        return bool(self.solved[-1].all())

    @property
    def makespan(self) -> int | None:
        """Steps until the last target was solved; None if some never were."""
        return len(self.actions) if self.complete else None

    @property
    def moves(self) -> int:
        """Actions other than stay, of all agents."""
        return int((self.actions != STAY).sum())


def replay(snapshot: Snapshot, actions: Iterable[npt.ArrayLike]) -> Trace:
    """Plays joint actions until all targets are solved or the actions or steps run out.

    They are asked for one by one, so an endless source of decisions will do.
    """
    now = replace(snapshot, solved=holding(snapshot))
    cells, solved, done = [now.cells], [now.solved], []
    for joint in actions:
        if now.solved.all() or now.step >= now.max_steps:
            break
        chosen = np.where(now.agent_mask, np.asarray(joint, np.int32), STAY)
        now = step(now, chosen)
        cells.append(now.cells)
        solved.append(now.solved)
        done.append(chosen)
    agents = len(snapshot.cells)
    return Trace(np.array(cells), np.array(solved),
                 np.array(done, np.int32).reshape(len(done), agents))


def replay_whole(snapshot: Snapshot, actions: IntArray) -> Trace:
    """`replay` of a list [T, N] known beforehand, all steps at once."""
    joint = actions[:max(snapshot.max_steps - snapshot.step, 0)]
    chosen = np.where(snapshot.agent_mask, joint, STAY).astype(np.int32)
    cells = _walked(snapshot, chosen)
    here = (cells[:, :, None] == snapshot.target_cells).all(-1)  # [T + 1, N, M]
    skills = np.where(snapshot.agent_mask, snapshot.agent_skills, 0)[:, None]
    present = np.bitwise_or.reduce(np.where(here, skills, 0), axis=1)  # [T + 1, M]
    meets = rules.met(present, snapshot.target_skills, snapshot.target_and)
    solved = np.logical_or.accumulate(meets | snapshot.solved)  # [T + 1, M]
    done = solved.all(-1)
    length = int(done.argmax()) if done.any() else len(chosen)
    return Trace(cells[:length + 1], solved[:length + 1], chosen[:length])


def _walked(snapshot: Snapshot, actions: IntArray) -> IntArray:
    """Cells [T + 1, N, 2] of joint actions [T, N]; all steps at once if none is thrown back."""
    ways = np.concatenate([snapshot.cells[None], DISPLACEMENTS[actions]])
    cells = ways.cumsum(0, dtype=np.int32)
    if rules.enterable(cells[1:], snapshot.agent_kinds, snapshot.size, snapshot.passable).all():
        return cells
    now = snapshot
    for t, joint in enumerate(actions):
        now = replace(now, cells=moved(now, joint))
        cells[t + 1] = now.cells
    return cells
