"""The figure and the one-page HTML report of `moonteam evaluate sensitivity`."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

from moonteam.report.markup import table
from sim2grid.show import plots
from sim2grid.show.page import folded, mean_interval, page, plot, tiles

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def curves_figure(document: dict[str, Any]) -> Figure:
    """Success and seconds against each quantity; a line a contender."""
    columns: dict[str, tuple[str, dict, dict]] = {}
    for curve in document["curves"]:
        _, success, seconds = columns.setdefault(curve["quantity"], (curve["label"], {}, {}))
        for lines, key in ((success, "success"), (seconds, "seconds")):
            lines[curve["contender"]] = [(at["value"], mean_interval(at, key))
                                         for at in curve["points"]]
    return plots.curves(list(columns.values()))


def sensitivity_page(document: dict[str, Any]) -> str:
    """The page of a report.json."""
    meta = document.get("meta", {})
    rows = document["rows"]
    lines = [[curve["label"], at["value"], curve["contender"],
              at["impossible"] or f"{at['solved']} of {at['missions']}",
              *_ends(at, "success", 2), *_ends(at, "seconds", 1),
              "; ".join(f"{cause}: {', '.join(map(str, numbers))}"
                        for cause, numbers in at["failures"].items()) or None]
             for curve in document["curves"] for at in curve["points"]]
    return page(document["title"], [
        f"<h1>{html.escape(document['title'].capitalize())}</h1>",
        f'<p class="sub"><code>{html.escape(str(meta.get("command", "")))}</code></p>',
        tiles([("executions", len(rows)), ("settings", len({r["setting"] for r in rows})),
               ("commit", str(meta.get("commit", "-"))[:9])]),
        '<p class="bad">Interrupted: what is done so far.</p>' if document.get("interrupted")
        else "",
        plot(plots.svg(curves_figure(document)), "sensitivity curves"),
        '<p class="dim">Bands: 95 % intervals, of success by Wilson, of seconds by bootstrap over '
        "the missions that succeeded.</p>",
        table(["quantity", "value", "contender", "solved", "success", "interval", "seconds",
               "interval", "failed missions"], lines),
        folded("how it was made", "\n".join(
            f"{k}: {v}" for k, v in (meta | {"options": document.get("options")}).items()))])


def _ends(at: dict[str, Any], key: str, digits: int) -> tuple[float | None, str | None]:
    value = mean_interval(at, key)
    if value is None or value[1] is None:
        return None, None
    mean, low, high = value
    return mean, f"{low:.{digits}f} to {high:.{digits}f}"
