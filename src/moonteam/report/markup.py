"""HTML of reports and notebooks: tables and what stands in them.

Every word from outside goes through `html.escape`.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

Number = Callable[[float], str]
"""How a float is written."""


@dataclass(frozen=True)
class Raw:
    """Text that is HTML already."""

    text: str


def two_digits(value: float) -> str:
    """Such as 1,234.57."""
    return f"{value:,.2f}"


def cell(value: object, number: Number = two_digits) -> str:
    """A value for a person: a dash for none, few digits for numbers, escaped words."""
    if isinstance(value, Raw):
        return value.text
    if value is None or (isinstance(value, float) and value != value):
        return '<span class="dim">-</span>'
    if isinstance(value, bool):
        return f'<span class="{"good" if value else "bad"}">{"yes" if value else "no"}</span>'
    return number(value) if isinstance(value, float) else html.escape(str(value))


def table(head: Sequence[str], rows: Iterable[Sequence[object]], number: Number = two_digits
          ) -> str:
    """A table; columns whose values are all numbers stand to the right."""
    body = [list(row) for row in rows]
    numbers = [bool(body) and all(isinstance(row[k], (int, float, type(None))) and not
                                  isinstance(row[k], bool) for row in body)
               for k in range(len(head))]
    kind = [' class="n"' if one else "" for one in numbers]
    top = "".join(f"<th{k}>{html.escape(word)}</th>" for k, word in zip(kind, head, strict=True))
    # A narrow screen shows a row as a list: the titles go with the cells.
    said = [f' data-title="{html.escape(word)}"' for word in head]
    lines = "\n".join("<tr>" + "".join(f"<td{k}{t}>{cell(v, number)}</td>" for k, t, v in zip(
        kind, said, row, strict=True)) + "</tr>" for row in body)
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead>\n<tbody>{lines}</tbody>' \
           "</table></div>"


def data_uri(content: bytes, kind: str) -> str:
    """A file's content as an address."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
