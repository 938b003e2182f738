"""JAX's persistent compilation cache: what was compiled once is not compiled again."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """MOONTEAM_CACHE, else moonteam/ in the user's cache folder."""
    chosen = os.environ.get("MOONTEAM_CACHE")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "moonteam"


def enable_cache() -> None:
    """Turns the cache on for this process; call it before anything is jitted.

    A folder that cannot be written leaves the cache off: it saves time, nothing else.
    """
    import jax

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
