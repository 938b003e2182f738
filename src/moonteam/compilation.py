"""How JAX is set up in this process: its compilation cache, and the memory it works in."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path
from typing import Any


def cache_folder() -> Path:
    """MOONTEAM_CACHE, else moonteam/ in the user's cache folder."""
    chosen = os.environ.get("MOONTEAM_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "moonteam"


_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # of glibc's mallopt(3)


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


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


def enable_cache() -> None:
    """Turns the cache on for this process; call it before anything is jitted.

    A folder that cannot be written leaves the cache off: it saves time, nothing else. Freed
    memory is kept, see `keep_freed_memory`.
    """
    import jax

    keep_freed_memory()
    folder = cache_folder() / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


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
