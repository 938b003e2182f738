"""The rows of a table on a cluster: what a run here would note, made in parts of all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from moonteam.cluster import Cluster
from moonteam.report.journal import Kept
from moonteam.report.progress import track


class Part(NamedTuple):
    """Some results of a row, made together: `work` of the arguments answers one for each name."""

    names: list[tuple[str, ...]]
    work: Callable[..., Sequence[Any]]
    arguments: tuple[Any, ...]


def chunks(numbers: Sequence[int], size: int) -> list[Sequence[int]]:
    """The numbers in order, at most so many together."""
    return [numbers[i:i + size] for i in range(0, len(numbers), size)]


def done(cluster: Cluster, rows: Sequence[Sequence[Part]], kept: Kept) -> tuple[int, Kept]:
    """Makes and notes the parts of each row; how many rows are whole, and all that is kept.

    After Ctrl-C those rows that are whole, up to the first that is not, if there are any.
    """
    parts = [(i, part) for i, row in enumerate(rows) for part in row]
    missing, kept = [len(row) for row in rows], kept.copy()
    if parts:
        kept.begin()
    coming = cluster.done(_called, [(part.work, *part.arguments) for _, part in parts])
    try:
        for number, results in track(coming, f"on {cluster.name}", len(parts)):
            i, part = parts[number]
            for names, result in zip(part.names, results, strict=True):
                kept.note(names, result)
            missing[i] -= 1
    except KeyboardInterrupt:
        whole = next(i for i, left in enumerate([*missing, 1]) if left)
        if not whole:
            raise
        return whole, kept
    return len(rows), kept


def _called(work: Callable[..., Any], *arguments: Any) -> Any:
    return work(*arguments)
