"""Tables of a report: terminal, Markdown, CSV and JSON, all from one document."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from moonteam import files
from moonteam.report.provenance import hardware_line

if TYPE_CHECKING:
    from rich.console import Console

Plain = tuple[list[str], list[list[str]]]
"""A table of plain cells: titles, rows."""


@dataclass(frozen=True)
class Column:
    """A column of a printed table: the key of the summary row, its title, how it is written."""

    key: str
    title: str
    write: Callable[[float], str]


def _plain(digits: int) -> Callable[[float], str]:
    return lambda value: f"{value:.{digits}f}"


def percent(value: float) -> str:
    """A gap, signed, such as +3.1 %."""
    return f"{100 * value:+.1f} %"


def duration(seconds: float) -> str:
    """Seconds in the unit that suits them."""
    if seconds < 1e-3:
        return f"{1e6 * seconds:.3g} us"
    return f"{1e3 * seconds:.3g} ms" if seconds < 1.0 else f"{seconds:.3g} s"


GRID_COLUMNS = (
    Column("success", "success", _plain(3)),
    Column("makespan", "mean T", _plain(2)),
    Column("moves", "mean moves", _plain(2)),
    Column("M_st", "M_st", _plain(2)),
    Column("st_ratio", "M_st ratio", _plain(3)),
    Column("M_tte", "M_tte", _plain(2)),
    Column("tte_ratio", "M_tte ratio", _plain(3)),
    Column("makespan_gap", "makespan gap", percent),
    Column("moves_gap", "moves gap", percent),
    Column("decisions", "decisions", _plain(1)),
)
SECONDS = (Column("seconds", "planning a scenario", duration),
           Column("first_call_seconds", "first call", duration))


def cell(row: dict, column: Column, spread: bool) -> str:
    """A value, with its interval in brackets if `spread` and there is one."""
    value = row[column.key]
    if value is None or not math.isfinite(value):
        return "-"
    text = column.write(value)
    low, high = row["intervals"].get(column.key, (math.nan, math.nan))
    if not spread or not math.isfinite(low):
        return text
    return f"{text} [{column.write(low)}, {column.write(high)}]"


def told(document: dict, columns: Sequence[Column]) -> list[Column]:
    """The columns that some row says something of: not all kinds of missions fill all."""
    return [one for one in columns if any(one.key in row for row in document["summary"])]


def markdown(document: dict, columns: Sequence[Column]) -> str:
    """The table with its command, sources and machine, ready for a page of docs."""
    columns = told(document, columns)
    titles = [document.get("rows_are", "planner"), *(c.title for c in columns)]
    lines = [f"`{document['meta']['command']}`", "",
             "| " + " | ".join(titles) + " |",
             "|" + "---|" * len(titles)]
    for row in document["summary"]:
        cells = [cell(row, column, spread=True) for column in columns]
        lines.append("| " + " | ".join([row["planner"], *cells]) + " |")
    lines.append("")
    lines += [f"- {note}" for note in document["notes"]]
    lines.append(f"- {hardware_line(document['meta'])}")
    return "\n".join(lines)


def show(document: dict, columns: Sequence[Column]) -> None:
    """The table on the terminal: a planner a column, intervals under the values.

    Where the planners do not fit beside each other, there are several tables.
    """
    from rich.console import Console
    from rich.table import Table

    console = Console()
    rows, columns = document["summary"], told(document, columns)
    room = max(1, (console.width - _TITLE_WIDTH) // _VALUE_WIDTH)
    for first in range(0, len(rows), room):
        part = rows[first:first + room]
        table = Table(title=document["title"] if first == 0 else None, title_justify="left")
        table.add_column("")
        for row in part:
            table.add_column(row["planner"], justify="right", min_width=_VALUE_WIDTH - 3)
        for column in columns:
            table.add_row(column.title, *(_two_lines(row, column) for row in part))
        console.print(table)
    for note in (*document["notes"], hardware_line(document["meta"])):
        console.print(note, highlight=False, markup=False)


_TITLE_WIDTH, _VALUE_WIDTH = 22, 21


def _two_lines(row: dict, column: Column) -> str:
    """A value and, beneath it, its interval."""
    value, _, spread = cell(row, column, spread=True).partition(" [")
    return f"{value}\n[dim]\\[{spread}[/dim]" if spread else value


def table_csv(document: dict) -> str:
    """The summary as CSV: each figure with its low and high end."""
    out = io.StringIO()
    rows = document["summary"]
    keys = [k for k in rows[0] if k not in ("intervals", "note")]
    ends = list(rows[0]["intervals"])
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(keys + [f"{k}_{end}" for k in ends for end in ("low", "high")])
    for row in rows:
        values = [row[k] for k in keys]
        values += [end for k in ends for end in row["intervals"][k]]
        writer.writerow(["" if isinstance(v, float) and math.isnan(v) else v for v in values])
    return out.getvalue()


_IN_STEPS: dict[str, Any] = {
    "id": "", "planner": "", "success": False, "makespan": None, "moves": 0,
    "optimal": {"makespan": None, "moves": None}}
"""A row of a report in steps, for the header where there is none."""


def rows_csv(document: dict) -> str:
    """One row a scenario and planner as CSV; the optima, where they are known, at the end."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    first = next(iter(document["rows"]), _IN_STEPS)
    keys, best = [key for key in first if key != "optimal"], list(first["optimal"])
    writer.writerow(keys + [f"optimal_{key}" for key in best])
    for row in document["rows"]:
        values = [row[key] for key in keys] + [row["optimal"][key] for key in best]
        writer.writerow([int(v) if isinstance(v, bool) else v for v in values])
    return out.getvalue()


def save(folder: Path, document: dict, columns: Sequence[Column]) -> None:
    """report.json, summary.csv, rows.csv and table.md."""
    files.write_json(folder / "report.json", document)
    files.write_text(folder / "summary.csv", table_csv(document))
    files.write_text(folder / "rows.csv", rows_csv(document))
    files.write_text(folder / "table.md", markdown(document, columns) + "\n")


def plain_markdown(document: dict, tables: Sequence[Plain]) -> str:
    """Tables of plain cells (titles, rows), with command, notes and machine."""
    lines = [f"`{document['meta']['command']}`", ""]
    for titles, rows in tables:
        lines += ["| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
        lines += ["| " + " | ".join(row) + " |" for row in rows] + [""]
    lines += [f"- {note}" for note in document["notes"]]
    return "\n".join([*lines, f"- {hardware_line(document['meta'])}"])


def save_plain(folder: Path, name: str, document: dict,
               tables: Sequence[Plain]) -> None:
    """The document as `name`.json and its tables as table.md."""
    files.write_json(folder / f"{name}.json", document)
    files.write_text(folder / "table.md", plain_markdown(document, tables) + "\n")


def fitted(titles: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> list[Plain]:
    """The table if it is at most `width` wide, else turned: a title a line, its rows side by side,
    as many in a table as there is room for.
    """
    if _width([titles, *rows]) <= width or not rows:
        return [(list(titles), [list(row) for row in rows])]
    found, first = [], 0
    while first < len(rows):
        last = first + 1
        while last < len(rows) and _width(zip(titles, *rows[first:last + 1], strict=True)) <= width:
            last += 1
        head, *rest = zip(titles, *rows[first:last], strict=True)
        found.append((list(head), [list(line) for line in rest]))
        first = last
    return found


def _width(lines: Iterable[Sequence[str]]) -> int:
    """How wide a printed table is: its widest cells, two spaces and a rule each."""
    return sum(max(len(part) for cell in column for part in (cell.splitlines() or [""])) + 3
               for column in zip(*lines, strict=True)) + 1


def show_plain(document: dict, tables: Sequence[Plain]) -> None:
    """The same on the terminal; what is wider is turned."""
    from rich.console import Console

    console = Console()
    for titles, rows in tables:
        show_rows(console, titles, rows)
    for note in (*document["notes"], hardware_line(document["meta"])):
        console.print(note, highlight=False, markup=False)


def show_rows(console: Console, titles: Sequence[str],
              rows: Sequence[Sequence[str | Sequence[str]]], title: str = "",
              right: Sequence[str] = ()) -> None:
    """A table on the terminal, never wider than that.

    A cell of several parts has them side by side, or, where the table is too wide so, one a line;
    what is wider still is turned. `right` are the titles of columns that stand to the right.
    """
    from rich.markup import escape
    from rich.table import Table

    def joined(sign: str) -> list[list[str]]:
        return [[cell if isinstance(cell, str) else sign.join(cell) for cell in row]
                for row in rows]

    lines = joined(" ")
    whole = _width([titles, *lines]) <= console.width
    lines = lines if whole else joined("\n")
    tall = any("\n" in cell for line in lines for cell in line)
    for number, (head, body) in enumerate(fitted(titles, lines, console.width)):
        table = Table(title=escape(title) if title and not number else None, show_lines=tall)
        for word in head:
            table.add_column(escape(word), overflow="fold", justify=(
                "right" if head == [*titles] and word in right else "left"))
        for line in body:
            table.add_row(*map(escape, line))
        console.print(table)


def parts(names: Iterable[str], word: str) -> list[str]:
    """Of a cell: names, a word before all but the first."""
    return [name if not k else f"{word} {name}" for k, name in enumerate(names)]


def print_plain(args: Any, document: dict,
                tables: Sequence[Plain]) -> None:
    """The document as `--json` or `--markdown` ask for it, else its tables for a person."""
    print_as(args, document, lambda: plain_markdown(document, tables),
             lambda: show_plain(document, tables))


def print_columns(args: Any, document: dict, page: Sequence[Column],
                  columns: Sequence[Column]) -> None:
    """The document as `--json` or `--markdown` (with the columns of the `page`) ask for it, else
    with all its columns for a person.
    """
    print_as(args, document, lambda: markdown(document, page), lambda: show(document, columns))


def print_as(args: Any, document: dict, page: Callable[[], str],
             person: Callable[[], object]) -> None:
    """`--json` prints the document, `--markdown` the page; else `person` shows it."""
    if args.json:
        print(files.dump_json(document))
    elif args.markdown:
        print(page())
    else:
        person()


def plain_csv(rows: Sequence[dict]) -> str:
    """Flat rows as CSV, yes and no as 1 and 0; a row without a key of another's is empty there."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(dict.fromkeys(key for row in rows for key in row)),
                            lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: int(value) if isinstance(value, bool) else value
                      for key, value in row.items()} for row in rows)
    return out.getvalue()
