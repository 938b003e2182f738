"""The rows of a table on a cluster: what a run here would note, made in parts of all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

from moonteam.cluster import Cluster
from moonteam.report.journal import Kept
from moonteam.report.progress import track

Row = TypeVar("Row")


class Part(NamedTuple):
    """Some results of a row, made together: `work` of the arguments answers one for each name."""

    names: list[tuple[str, ...]]
    work: Callable[..., Sequence[Any]]
    arguments: tuple[Any, ...]


def chunks(numbers: Sequence[int], size: int) -> list[Sequence[int]]:
    """The numbers in order, at most so many together."""
    return [numbers[i:i + size] for i in range(0, len(numbers), size)]


def done(cluster: Cluster | None, rows: Sequence[Row], count: int, kept: Kept,
         parts: Callable[[Row, int, Kept], Sequence[Part]]) -> tuple[list[Row], Kept]:
    """Makes and notes the parts of each row, if there is a cluster; the rows that are whole, or are
    to be made here, and all that is kept.

    `parts` answers those of a row, with so many of its `count` things in each at most. After Ctrl-C
    those rows that are whole, up to the first that is not, if there are any.
    """
    if cluster is None:
        return list(rows), kept
    size = cluster.size(count)
    cut = [parts(row, size, kept) for row in rows]
    pieces = [(i, part) for i, row in enumerate(cut) for part in row]
    missing, kept = [len(row) for row in cut], kept.copy()
    if pieces:
        kept.begin()
    coming = cluster.done(_called, [(part.work, *part.arguments) for _, part in pieces])
    try:
        for number, results in track(coming, f"on {cluster.name}", len(pieces)):
            i, part = pieces[number]
            for names, result in zip(part.names, results, strict=True):
                kept.note(names, result)
            missing[i] -= 1
    except KeyboardInterrupt:
        whole = next(i for i, left in enumerate([*missing, 1]) if left)
        if not whole:
            raise
        return list(rows[:whole]), kept
    return list(rows), kept


def _called(work: Callable[..., Any], *arguments: Any) -> Any:
    return work(*arguments)
