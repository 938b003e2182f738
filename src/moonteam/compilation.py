"""How JAX and Numba are set up in this process: what they compiled is kept, where it can be."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from moonteam import files
from moonteam.errors import InputError


def cache_folder() -> Path:
    """MOONTEAM_CACHE, else moonteam/ in the user's cache folder."""
    chosen = os.environ.get("MOONTEAM_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # ~ if homeless
    return Path(base) / "moonteam"


_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # of glibc's mallopt(3)


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Spent:
    """Seconds covered by pieces of work that may overlap, each told of as it ends."""

    def __init__(self, now: Callable[[], float] = time.perf_counter):
        self.seconds = 0.0
        self._now = now
        self._pieces: list[tuple[float, float]] = []  # apart from each other, in order
        self._lock = threading.Lock()

    def add(self, seconds: float) -> None:
        """A piece that took so long ends now."""
        with self._lock:
            end = self._now()
            begin = end - seconds
            while self._pieces and self._pieces[-1][1] >= begin:
                first, last = self._pieces.pop()
                begin = min(begin, first)
                self.seconds -= last - first
            self._pieces.append((begin, end))
            self.seconds += end - begin


_compiling = Spent()
_heard: set[str] = set()


def spent_compiling() -> float:
    """Seconds in which this process traced or compiled for JAX or Numba, since it was first asked.

    What several threads compile at once counts once; what is under way counts at its end.
    """
    _hear()
    return _compiling.seconds


def working_time() -> float:
    """Seconds of a clock that stands still while something is compiled."""
    spent = spent_compiling()
    return time.perf_counter() - spent


def _hear() -> None:
    """Listens to what is imported by now."""
    if "jax" in sys.modules and "jax" not in _heard:
        import jax

        _heard.add("jax")
        jax.monitoring.register_event_duration_secs_listener(_of_jax)
    if "numba" in sys.modules and "numba" not in _heard:
        from numba.core import event

        class OfNumba(event.Listener):
            """Numba tells of the beginning of each compilation, and of its end."""

            begun = threading.local()

            def on_start(self, event: Any) -> None:
                vars(self.begun).setdefault("times", []).append(time.perf_counter())

            def on_end(self, event: Any) -> None:
                times = vars(self.begun).get("times")
                if times:
                    _compiling.add(time.perf_counter() - times.pop())

        _heard.add("numba")
        event.register("numba:compile", OfNumba())


def _of_jax(event: str, duration_secs: float, **kwargs: str | int) -> None:
    if event.startswith("/jax/core/compile/"):
        _compiling.add(duration_secs)


def keep_freed_memory() -> None:
    """Keeps freed memory in the process, where glibc would give it back to the system.

    XLA on a CPU takes its working memory anew at every call; giving it back each time costs
    a page fault for each 4 KiB of it, which was measured at more than half of the time of
    training a small network. Does nothing where the C library is another.
    """
    if not sys.platform.startswith("linux"):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_MMAP_MAX, 0)
    mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(_TOP_PAD, 2**28)


def forget() -> None:
    """Drops what JAX holds of programs in this process, and gives freed memory to the system.

    For a process that meets ever new shapes: JAX keeps the last thousands of traces of each kind.
    """
    import jax

    jax.clear_caches()
    gc.collect()
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


def enable_cache() -> None:
    """Turns the cache on for this process; call it before anything is jitted.

    A folder that cannot be written leaves the cache off: it saves time, nothing else. Any number
    of processes share it. Freed memory is kept, see `keep_freed_memory`.
    """
    import jax

    keep_freed_memory()
    _hear()
    folder = cache_folder() / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    _keep_whole_entries()
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _keep_whole_entries() -> None:
    """JAX's cache takes entries whole or not at all.

    JAX writes them in place: another process may read half of one, and of a process that is
    killed, or a disk that is full, half of one stays for good, complained about at every start.
    """
    from jax._src.lru_cache import LRUCache

    put = getattr(LRUCache.put, "jaxs", LRUCache.put)

    def put_whole(self: Any, key: str, value: bytes) -> None:
        if self.eviction_enabled:  # it has locks then
            return put(self, key, value)
        path = Path(str(self.path)) / f"{key}-cache"
        if not path.exists():
            with contextlib.suppress(OSError, InputError), files.replacing(path) as temporary:
                temporary.write_bytes(value)

    put_whole.jaxs = put  # type: ignore[attr-defined]
    LRUCache.put = put_whole


LOOP: Any = {"cache": True, "nogil": True, "_nrt": False}
"""`njit` options of inner loops: they make no arrays, and count no references to those they get."""


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Numba's decorator, without its cache where that has nowhere to be, or no room."""
    import numba

    _hear()
    jit: Any = numba.njit

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            made = jit(**options)(function)
        except RuntimeError:
            return jit(**options | {"cache": False})(function)
        if not hasattr(made, "_cache"):  # NUMBA_DISABLE_JIT
            return made
        save = made._cache.save_overload

        def save_if_possible(signature: Any, data: Any) -> None:
            with contextlib.suppress(OSError):
                save(signature, data)

        made._cache.save_overload = save_if_possible
        return made

    return decorate


def devices() -> list[Any]:
    """Those that JAX computes on; none where JAX_PLATFORMS asks for what is not there."""
    import jax

    try:
        return jax.devices()
    except (AssertionError, RuntimeError):  # either, by what JAX finds first
        return []


def call_at_once() -> None:
    """Runs programs for the CPU on the thread that calls them; call it before any of JAX.

    The native engine calls its controllers a hundred times a simulated second: handing each
    call to another thread and waiting for it took longer than the controllers themselves. Not
    for training, which keeps several CPU devices at work at once.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
