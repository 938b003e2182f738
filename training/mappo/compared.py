"""What MAPPO runs are compared by: held-out success, makespan and moves, argmax and sampled."""

from __future__ import annotations

from typing import Any

import msgspec

from training.mappo.curve import draw_curve
from training.run.compare import Final, Kind, Line
from training.run.trainee import Row

KEYS = ("success", "makespan", "moves")
DECODES = ("argmax", "sample")


class Score(msgspec.Struct, frozen=True):
    """Held-out figures; see `training.mappo.held_out.Score`."""

    success: float
    makespan: float
    moves: float
    makespan_gap: float | None = None


class MappoLine(Line, frozen=True, kw_only=True):
    """The three figures are those while training."""

    success: float
    makespan: float
    moves: float
    argmax: Score | None = None
    sample: Score | None = None


class MappoFinal(Final, frozen=True, kw_only=True):
    """Both ways to decode."""

    argmax: Score
    sample: Score


def _ended(config: dict[str, Any], line: MappoLine) -> MappoFinal | None:
    if line.argmax is None or line.sample is None:
        return None
    return MappoFinal(env_steps=line.env_steps, seconds=line.seconds,
                      scenarios=config.get("eval_scenarios", 0), argmax=line.argmax,
                      sample=line.sample)


def _figures(final: MappoFinal) -> dict[str, float]:
    return {f"{decode}_{key}": getattr(getattr(final, decode), key)
            for decode in DECODES for key in KEYS}


def _gap(row: Row) -> tuple[float, float] | None:
    found = row.get("argmax", {})
    return (found["success"], found["makespan_gap"]) if "makespan_gap" in found else None


MAPPO = Kind(
    "name", MappoLine, MappoFinal, _ended, _figures,
    columns=(("argmax_success", "success, argmax", 3), ("sample_success", "success, sampled", 3),
             ("argmax_makespan", "mean T, argmax", 2), ("sample_makespan", "mean T, sampled", 2),
             ("argmax_moves", "mean moves, argmax", 2),
             ("sample_moves", "mean moves, sampled", 2)),
    note="failures count with max_steps and their real moves", draw=draw_curve, gap=_gap)
