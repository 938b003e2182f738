"""MAPPO on macro-decisions on the bench: alone, and as our side beside JaxMARL's loop.

One family of problems, the preset's first: its two kinds of update take one of them each.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from moonteam.errors import InputError
from training.bench.measure import Wanted, matmul_peak, peak_bytes, seconds

if TYPE_CHECKING:
    from training.mappo.macro.config import MacroConfig


def products(work: Callable[..., Any], *args: Any) -> int:
    """Floating-point operations of the matrix products in `work(*args)`; no others are counted.

    A scan's body counts as often as it runs; what is in a while loop counts once.
    """
    import jax

    return _products(jax.make_jaxpr(work)(*args).jaxpr)


def _products(jaxpr: Any) -> int:
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (summed, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            total += 2 * math.prod((*equation.outvars[0].aval.shape, *(left[i] for i in summed)))
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        inside = (getattr(value, "jaxpr", value) for value in equation.params.values())
        total += times * sum(_products(inner) for inner in inside if hasattr(inner, "eqns"))
    return total


def config(preset: str, advantages: str) -> MacroConfig:
    """The preset with its first family alone, by the critic or by branches."""
    from training.mappo.macro.config import PRESETS

    chosen = PRESETS[preset]
    return replace(chosen, families=(replace(chosen.families[0], advantages=advantages),))


def flops(chosen: MacroConfig) -> float:
    """Of the matrix products, for one decision of the team by the critic.

    Once to decide; to learn thrice for each moment that is learned from, epoch by epoch.
    """
    import jax
    import jax.numpy as jnp

    from moonteam.policies.pointer import init, look, point
    from training.mappo.macro.update import fresh

    def met(key: Any) -> Any:
        """One moment, as the network sees it."""
        state = fresh(chosen.families[0].draw, chosen.hyper, None, key, 1).states
        return jax.vmap(look)(state, jnp.zeros(1))

    key = jax.random.key(0)
    params, view = jax.eval_shape(partial(init, chosen.spec), key), jax.eval_shape(met, key)
    once = products(lambda params, view: point(params, chosen.spec, view), params, view)
    hyper = chosen.hyper
    return once * (1.0 + 3.0 * hyper.epochs * hyper.learned)


def build(chosen: MacroConfig) -> tuple[Callable[[], Any], float]:
    """One update of a run, which gives its report, and the seconds that compiling took.

    The seconds hold one update: what is compiled is what training runs.
    """
    import jax

    from moonteam.compilation import enable_cache
    from training import sharding
    from training.mappo.macro.trainee import MacroMappo

    enable_cache()
    sharding.use_all_cores()
    trainee, rounds = MacroMappo(chosen), iter(range(2**31))

    def once() -> Any:
        key = jax.random.fold_in(jax.random.key(1), next(rounds))
        return trainee.practise(0, chosen.families[0], key, np.float32(0.0), np.float32(0.01))

    return once, seconds(once)


def measure(args: Wanted, command: str) -> dict[str, Any]:
    """The JSON document: both kinds of update. Raises InputError for what has no meaning here."""
    from moonteam.report import provenance
    from training import sharding

    for name in ("phase", "num_envs", "num_minibatches", "precision"):
        if getattr(args, name) != getattr(Wanted(), name):
            raise InputError(name, f"has no meaning for {args.preset}")
    rows = []
    for advantages in ("vine", "critic"):
        chosen = config(args.preset, advantages)
        once, first = build(chosen)
        took = min(seconds(once) for _ in range(args.repeats))
        rows.append({"advantages": advantages, "decisions": chosen.decisions, "seconds": took,
                     "decisions_per_s": chosen.decisions / took, "first_s": first})
        if advantages == "vine":
            rows[-1]["branches_per_s"] = float(np.asarray(once().episodes)) / took
        else:
            work = flops(chosen)
            rows[-1] |= {"flops_per_decision": work,
                         "achieved_gflops": work * chosen.decisions / took / 1e9}
    peak, peak_of = peak_bytes()
    best, critic = matmul_peak("float32") / 1e9, rows[-1]
    return {"title": f"{args.preset}, {chosen.families[0].name}",
            "preset": args.preset, "rows": rows, "matmul_peak_gflops": best, "peak_bytes": peak,
            "peak_of": peak_of, "repeats": args.repeats, "device": sharding.describe_device(),
            "meta": provenance.meta(command, 0), "notes": [
                "vine: moments branched, each with its options played to the end; critic: moments "
                f"decided, clipped PPO; best of {args.repeats} updates on "
                f"{sharding.describe_device()}",
                f"critic: {critic['flops_per_decision'] / 1e6:.2f} MFLOP a decision of the team: "
                f"{critic['achieved_gflops']:.1f} of {best:.0f} GFLOP/s measured, "
                f"{critic['achieved_gflops'] / best:.1%}"]}


def table(document: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows, a kind of update a row."""
    return [document["title"], "decisions/s", "branches/s", "ms an update",
            "first update, compiled, s"], [
        [row["advantages"], f"{row['decisions_per_s']:,.0f}",
         f"{row['branches_per_s']:,.0f}" if "branches_per_s" in row else "-",
         f"{row['seconds'] * 1e3:,.0f}", f"{row['first_s']:.1f}"] for row in document["rows"]]
