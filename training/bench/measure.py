"""What every measurement of the learner uses: compiling, timing, the machine's peak, its memory."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from training.mappo.update import Learner


@dataclass(frozen=True)
class Wanted:
    """What is measured. None: as the preset, or JaxMARL's own configuration, has it."""

    preset: str = "small"
    phase: str = "refinement"
    num_envs: int | None = None
    num_minibatches: int | None = None
    precision: str | None = None
    updates: int = 2
    repeats: int = 5


def compiled(work: Callable[[Any], Any], held: Any, spread: Any = None) -> tuple[Any, float, int]:
    """The program of `work(held)`, the seconds that it took to compile, the bytes it works in.

    `spread`: an array whose devices the program is for.
    """
    import jax

    from training import sharding
    from training.bench import account

    with sharding.mesh_of(jax.numpy.zeros(()) if spread is None else spread):
        start = time.perf_counter()
        program = jax.jit(work).lower(held).compile()
        took = time.perf_counter() - start
    return program, took, account.set_aside(program) or 0


def timed(work: Callable[[Any], Any], begin: Callable[[], Learner],
          repeats: int) -> dict[str, Any]:
    """Compiles and runs `work`: seconds of the best repeat, compilation apart."""
    import jax

    held = jax.block_until_ready(begin())
    program, compile_s, bytes_ = compiled(work, held, held.carry.reset_before)
    jax.block_until_ready(program(held))
    best = min(seconds(lambda: program(held)) for _ in range(repeats))
    return {"seconds": best, "compile_s": compile_s, "compiled_bytes": bytes_}


def seconds(work: Callable[[], Any]) -> float:
    """How long `work` takes until its result is there."""
    import jax

    start = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - start


def matmul_peak(precision: str) -> float:
    """Floating-point operations a second of the fastest square product measured, all devices.

    On a CPU one product already has all cores; accelerators are taken to be alike.
    """
    import jax
    import jax.numpy as jnp

    from training.mappo import networks

    kind = jnp.bfloat16 if precision == "bfloat16" else jnp.float32
    on_cpu = jax.devices()[0].platform == "cpu"
    best = 0.0
    with networks.matmul_precision(precision):
        for side in (512, 1024, 2048) if on_cpu else (4096, 8192):
            square = jnp.ones((side, side), kind)
            product = jax.jit(lambda a: a @ a)
            jax.block_until_ready(product(square))
            best = max(best, *(2.0 * side**3 / seconds(lambda: product(square))  # noqa: B023
                               for _ in range(5)))
    return best if on_cpu else best * len(jax.devices())


def peak_bytes() -> tuple[int, str]:
    """Peak memory in use so far, and whose: the accelerator's, else the process's."""
    import jax

    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return stats["peak_bytes_in_use"], "accelerator"
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit, "process"
