"""A moment of the planners' world as a problem of the macro world.

Legend as in `grid.macro.types`.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from moonteam.grid.macro.draw import unit_of
from moonteam.grid.macro.types import FAR, MacroProblem
from moonteam.planners.seconds.base import MS, NEVER, Int64, Moment

Float32 = npt.NDArray[np.float32]


def problem_of(now: Moment, agents: int = 0, targets: int = 0, skills: int = 0) -> MacroProblem:
    """The moment in float32 seconds (NumPy arrays), so that now is 0 in both.

    Solved targets and lost agents are masked. What waits for a target under way appears when that
    ends at the earliest: nothing else of it matters any more. All that a moment holds is known.

    Args:
      now: the moment.
      agents: N, padded to at least so many.
      targets: M, likewise.
      skills: S, likewise.
    """
    n, m = max(agents, len(now.present)), max(targets, len(now.solved))
    s = max(skills, now.need.shape[1])
    under_way = np.where(now.after & now.solved[None], now.ends[None], 0).max(1, initial=0)
    present, open_ = _padded(now.present, False, n), _padded(~now.solved, False, m)
    start = _padded(_seconds(now.start), FAR, n, m)
    has = _padded(now.has & now.present[:, None], False, n, s)
    need = _padded((now.need * ~now.solved[:, None]).astype(np.int32), 0, m, s)
    unit = unit_of(start, has, need, present, open_)  # pyright: ignore[reportArgumentType]
    found = {
        "start": start, "between": _padded(_seconds(now.between[now.classes]), FAR, n, m, m),
        "home": _padded(_seconds(now.home), 0.0, n, m),
        "home_now": _padded(_seconds(now.home_now), 0.0, n), "has": has, "need": need,
        "either": _padded(now.either, False, m), "service": _padded(_seconds(now.service), 0.0, m),
        "after": _padded(now.after, False, m, m),
        "appears": _padded(_seconds(np.maximum(now.appears, under_way)), 0.0, m),
        "shown": np.zeros(m, np.float32), "lapses": _padded(_seconds(now.lapses), FAR, m),
        "free": _padded(_seconds(now.free), 0.0, n),
        "effort": _padded(now.effort.astype(np.float32), 0.0, n),
        "limit": _seconds(np.asarray(now.limit)), "agent_mask": present, "target_mask": open_,
        "unit": np.asarray(unit, np.float32)}
    return MacroProblem(**found)


def _seconds(ms: Int64) -> Float32:
    """Seconds of milliseconds, FAR of NEVER."""
    return np.where(ms >= NEVER, FAR, ms / MS).astype(np.float32)


def _padded(values: np.ndarray, fill: float | bool, *shape: int) -> np.ndarray:
    """The values in the first corner of an array of this shape."""
    if values.shape == shape:
        return values
    out = np.full(shape, fill, values.dtype)
    out[tuple(slice(0, size) for size in values.shape)] = values
    return out
