"""What every test shares: strict JAX, and what was compiled once is kept."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Commands that train make each core a device; which test asks first must not matter.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "1")

import jax

from moonteam.compilation import enable_cache

jax.config.update("jax_numpy_rank_promotion", "raise")
enable_cache()
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
