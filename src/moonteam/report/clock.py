"""Measuring how long a call takes, on a machine that others may be using too."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np


class Times(NamedTuple):
    """Seconds of one call, over many calls; the first one, which compiles, is apart."""

    first: float
    median: float
    low: float  # 10th percentile
    high: float  # 90th percentile
    calls: int

    def document(self) -> dict:
        """As the report holds it."""
        return {"first_call_seconds": self.first, "seconds": self.median, "p10": self.low,
                "p90": self.high, "calls": self.calls}


def times_of(seconds: Sequence[float], first: float) -> Times:
    """Median and spread of measured calls; the first call's seconds beside them."""
    low, median, high = np.percentile(np.asarray(seconds, np.float64), [10, 50, 90])
    return Times(first, float(median), float(low), float(high), len(seconds))


def measure(call: Callable[[Any], Any], arguments: Sequence[Any], budget: float) -> Times:
    """Times `call` on each argument, until they are used up or `budget` seconds are.

    The first argument is used twice: its first call (loading, compiling) is not counted in
    the median. `call` must wait for its own result.
    """
    began = time.perf_counter()
    call(arguments[0])
    first = time.perf_counter() - began
    seconds = []
    until = time.perf_counter() + budget
    for argument in arguments:
        start = time.perf_counter()
        call(argument)
        stop = time.perf_counter()
        seconds.append(stop - start)
        if stop > until:
            break
    return times_of(seconds, first)


@contextlib.contextmanager
def one_core() -> Iterator[str]:
    """Keeps this thread and those it starts on one core; yields in words how that went.

    JAX starts its threads when it is first used: enter before it is imported.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield "not kept on one core: this system has no processor affinity"
        return
    allowed = os.sched_getaffinity(0)
    late = "; JAX was loaded before, its threads are not" if "jax" in sys.modules else ""
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield f"the process is kept on one core (processor affinity){late}"
    finally:
        os.sched_setaffinity(0, allowed)
