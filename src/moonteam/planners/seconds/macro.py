"""A moment of the planners' world as a problem of the macro world.

Legend as in `grid.macro.types`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.planners.macro import unit_of
from moonteam.planners.seconds.base import MS, NEVER, Int64, Moment


def problem_of(now: Moment) -> MacroProblem:
    """The moment in float32 seconds (NumPy arrays); now is 0 in both. All that it holds is known.

    Solved targets and lost agents are masked. What waits for a target under way appears when that
    ends, at the earliest: nothing else of a target under way matters any more.
    """
    under_way = np.where(now.after & now.solved[None], now.ends[None], 0).max(1, initial=0)
    zero = np.zeros(len(now.solved), np.float32)
    start = _seconds(now.start)
    has = now.has & now.present[:, None]
    need = np.where(now.solved[:, None], 0, now.need).astype(np.int32)
    columns: dict[str, np.ndarray | np.float32 | np.int32] = {
        "start": start, "between": _seconds(now.between[now.classes]),
        "home": _seconds(now.home), "home_now": _seconds(now.home_now), "has": has, "need": need,
        "either": now.either, "service": _seconds(now.service), "after": now.after,
        "appears": _seconds(np.maximum(now.appears, under_way)), "shown": zero,
        "following": np.zeros(len(zero), np.int32),
        "looks": np.zeros(len(zero), bool), "unseen": zero, "coming": np.int32(now.coming),
        "middle": zero if now.middle is None else _seconds(now.middle),
        "middle_now": np.zeros(len(start), np.float32) if now.middle_now is None
        else _seconds(now.middle_now),
        "lapses": _seconds(now.lapses),
        "worth": zero if now.worth is None else now.worth.astype(np.float32),
        "free": _seconds(now.free),
        "lost": np.full(len(start), FAR, np.float32),
        "effort": now.effort.astype(np.float32), "limit": _seconds(np.asarray(now.limit)),
        "agent_mask": now.present, "target_mask": ~now.solved, "unit": unit_of(start, has, need)}
    return MacroProblem(**columns)  # pyright: ignore[reportArgumentType]


def _seconds(ms: Int64) -> npt.NDArray[np.float32]:
    """Seconds of milliseconds, FAR of NEVER."""
    return np.where(ms >= NEVER, FAR, ms / MS).astype(np.float32)
