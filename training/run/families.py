"""What runs judged family by family have in common: a list of figures in each evaluation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, TypeVar

from training.run.compare import Final, Kind, Line
from training.run.trainee import Row

T = TypeVar("T")


class FamiliesLine(Line, Generic[T], frozen=True, kw_only=True):
    """With or without an evaluation."""

    families: list[T] | None = None


class FamiliesFinal(Final, Generic[T], frozen=True, kw_only=True):
    """The last evaluation; `scenarios` of each family."""

    families: list[T]


def mean(row: Row, key: str) -> float:
    """Of a figure over the families of an evaluation."""
    return sum(family[key] for family in row["families"]) / len(row["families"])


def kind(name_key: str, figures: type, columns: tuple[tuple[str, str, int], ...], note: str,
         draw: Callable[[Path, dict[str, list[list[Row]]]], None],
         scenarios: Callable[[dict[str, Any]], int]) -> Kind:
    """How such runs are told, read and shown.

    Args:
      name_key: key of config.json that holds the preset.
      figures: a struct, what is known of a family.
      columns: of the table: figure, title, digits; each is the mean over the families.
      note: how failures count.
      draw: curves of groups of runs.
      scenarios: held-out scenarios of a family, from the run's config.
    """
    final = FamiliesFinal[figures]

    def ended(config: dict[str, Any], line: FamiliesLine) -> FamiliesFinal | None:
        if line.families is None:
            return None
        return final(env_steps=line.env_steps, seconds=line.seconds, families=line.families,
                     scenarios=scenarios(config))

    def means(found: FamiliesFinal) -> dict[str, float]:
        return {key: sum(getattr(row, key) for row in found.families) / len(found.families)
                for key, _, _ in columns}

    def gap(row: Row) -> tuple[float, float] | None:
        found = row.get("families")
        return (mean(row, "success"), mean(row, "makespan_gap")) if found else None

    return Kind(name_key, FamiliesLine[figures], final, ended, means, columns, note, draw, gap)
