"""A plan as a picture: the map, who walks where, and when each target is solved.

Cells are (x, y), x right, y up, origin lower left.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from moonteam import files
from moonteam.planners.base import IntArray, Plan, Snapshot
from moonteam.planners.simulate import replay
from moonteam.problem.scenario import Scenario
from moonteam.problem.skills import held, needed

COLOURS = ("#1485b8", "#b89514", "#a114b8", "#14b886", "#b85a14", "#1424b8",
           "#73b814", "#b81449")
"""Of robots: those of the films and reports, darker, as paper needs them."""
INK, PAPER, GROUND = "#22223b", "#fbfaf7", "#eeece6"
SHADE, FOR_ALL = "#bfb8b0", "#55555f"  # of ground closed to a kind, and to every kind


def draw_plan(path: str | Path, scenario: Scenario, plan: Plan, title: str,
              agents: Sequence[str], targets: Sequence[str],
              shades: Mapping[str, str] | None = None) -> None:
    """Draws the plan as a PNG; an infeasible one shows the map alone and says why.

    `shades`: kind -> #rrggbb of the ground that is closed to it.
    """
    shades = {"*": FOR_ALL} | dict(shades or {})
    width, height = scenario.size
    scale = 8.2 / max(width, height)
    figure = Figure(figsize=(max(5.0, width * scale) + 2.6, max(4.0, height * scale) + 1.0),
                    facecolor=PAPER, layout="constrained")
    with matplotlib.rc_context({"font.family": "DejaVu Sans"}):
        map_axes, side = figure.subplots(
            1, 2, gridspec_kw={"width_ratios": [max(5.0, width * scale), 2.4]})
        _ground(map_axes, scenario, shades)
        cells = replay(Snapshot.start(scenario), plan.actions).cells
        size = float(np.clip(9.5 * 32 / max(width, height), 5.5, 12.0))
        _paths(map_axes, cells, len(agents), scale)
        _targets(map_axes, scenario, plan, targets, size)
        _starts(map_axes, scenario, size)
        _sidebar(side, scenario, plan, agents, targets, shades)
        figure.suptitle(f"{title}: {plan.planner}, {_headline(plan)}", color=INK, fontsize=13,
                        fontweight="bold", x=0.02, ha="left")
        with files.replacing(path) as temporary:
            figure.savefig(temporary, dpi=130, facecolor=PAPER)


def _headline(plan: Plan) -> str:
    if plan.makespan is None:
        return "no plan"
    return f"{plan.objective}, {plan.status}: makespan {plan.makespan}, moves {plan.moves}"


def _ground(axes: Any, scenario: Scenario, shades: Mapping[str, str]) -> None:
    """The map with its grid and the cells that some kinds cannot enter."""
    width, height = scenario.size
    axes.set_facecolor(GROUND)
    for kind in sorted(scenario.blocked or {}, key=lambda k: -len((scenario.blocked or {})[k])):
        for x, y in (scenario.blocked or {})[kind]:
            axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, linewidth=0,
                                     color=shades.get(kind, SHADE)))
    if max(width, height) <= 64:
        axes.set_xticks(np.arange(-0.5, width), minor=True)
        axes.set_yticks(np.arange(-0.5, height), minor=True)
        axes.grid(which="minor", color="white", linewidth=0.6)
    axes.tick_params(which="both", length=0, labelsize=8, colors=INK)
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(-0.5, height - 0.5)
    axes.set_aspect("equal")
    for spine in axes.spines.values():
        spine.set_color("#c9c5bb")
    axes.set_axisbelow(True)


def _paths(axes: Any, cells: IntArray, agents: int, scale: float) -> None:
    """Each agent's way, moved a little aside so that shared stretches stay visible."""
    spread = 0.5 * (np.arange(agents) - (agents - 1) / 2) / max(agents, 3)
    for a in range(agents):
        line = cells[:, a] + spread[a]
        axes.plot(line[:, 0], line[:, 1], color=COLOURS[a % len(COLOURS)], alpha=0.85,
                  linewidth=max(1.2, 9 * scale), solid_capstyle="round",
                  solid_joinstyle="round", zorder=2)


def _targets(axes: Any, scenario: Scenario, plan: Plan, names: Sequence[str],
             size: float) -> None:
    """A card a target: its skills and type on the cell, name and step beside it."""
    visits = {visit.target: visit for visit in plan.schedule}
    taken = [t.at for t in scenario.targets] + [a.at for a in scenario.agents]
    for j, target in enumerate(scenario.targets):
        x, y = target.at
        visit = visits.get(j)
        edge = COLOURS[visit.agents[0] % len(COLOURS)] if visit and visit.agents else INK
        both = target.type == "AND" and len(set(target.skills)) > 1
        axes.add_patch(FancyBboxPatch(
            (x - 0.55, y - 0.5), 1.1, 1.0, boxstyle="round,pad=0.12,rounding_size=0.3",
            facecolor="white", edgecolor=edge, linewidth=1.8,
            linestyle="-" if visit else ":", zorder=4, clip_on=False))
        _inside(axes, (x, y), needed(target.skills, not both), size, INK, 5)
        label = names[j] + (f" @{visit.step}" if visit else "")
        dx, dy, align = _beside(x, y, scenario.size, taken, len(label))
        axes.text(x + dx, y + dy, label, ha=align, va="center", fontsize=size * 0.85, color=INK,
                  zorder=6, bbox={"boxstyle": "round,pad=0.15", "facecolor": PAPER,
                                  "edgecolor": "none", "alpha": 0.8})


def _inside(axes: Any, at: tuple[float, float], skills: str, size: float, colour: str,
            zorder: int) -> None:
    """Skills on a mark, which has room for two or three letters: names one a line, smaller."""
    for sign in (" + ", " / ", ", "):
        skills = skills.replace(sign, f"\n{sign.strip(' ,')}")
    longest = max(map(len, skills.splitlines()))
    axes.text(*at, skills, ha="center", va="center" if "\n" in skills else "center_baseline",
              fontsize=size * min(1.0, 2.6 / longest), fontweight="bold", color=colour,
              zorder=zorder)


def _beside(x: int, y: int, size: tuple[int, int], taken: Sequence[tuple[int, int]],
            letters: int) -> tuple[float, float, str]:
    """Offset and alignment of a label: on the side that keeps clear of others and the border."""
    reach = 0.9 + 0.55 * letters * max(size) / 32
    best: tuple[float, float, str] = (0.9, 0.0, "left")
    worst = float("inf")
    for dx, dy, align in ((0.9, 0.0, "left"), (-0.9, 0.0, "right"), (0.0, 1.15, "center"),
                          (0.0, -1.15, "center")):
        low = x + dx - (reach if align == "right" else reach / 2 if align == "center" else 0)
        high = x + dx + (reach if align == "left" else reach / 2 if align == "center" else 0)
        off = low < -0.5 or high > size[0] - 0.5 or not -0.5 <= y + dy <= size[1] - 0.5
        hits = sum(low - 0.7 <= tx <= high + 0.7 and abs(ty - y - dy) < 1.1
                   for tx, ty in taken if (tx, ty) != (x, y))
        if hits + 10 * off < worst:
            worst, best = hits + 10 * off, (dx, dy, align)
    return best


def _starts(axes: Any, scenario: Scenario, size: float) -> None:
    """A disc at each agent's start with its skills."""
    seen: dict[tuple[int, int], int] = {}
    for a, agent in enumerate(scenario.agents):
        shift = 0.35 * seen.get(agent.at, 0)
        seen[agent.at] = seen.get(agent.at, 0) + 1
        axes.scatter([agent.at[0] + shift], [agent.at[1] + shift], s=(2.0 * size) ** 2 * 0.75,
                     color=COLOURS[a % len(COLOURS)], edgecolor="white", linewidth=1.4, zorder=7)
        _inside(axes, (agent.at[0] + shift, agent.at[1] + shift), held(agent.skills), size * 0.85,
                "white", 8)


def _sidebar(axes: Any, scenario: Scenario, plan: Plan, agents: Sequence[str],
             targets: Sequence[str], shades: Mapping[str, str]) -> None:
    """Each agent's visits in order, or the reason why there is no plan."""
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    lines: list[tuple[str, str, bool]] = []
    for a, agent in enumerate(scenario.agents):
        kind = f" ({agent.kind})" if agent.kind else ""
        colour = COLOURS[a % len(COLOURS)]
        lines.append((f"{agents[a]}  {held(agent.skills)}{kind}", colour, True))
        mine = [v for v in plan.schedule if a in v.agents]
        for visit in mine:
            others = [agents[b] for b in visit.agents if b != a]
            mates = f" with {', '.join(others)}" if others else ""
            lines.append((f"{visit.step:>4}  {targets[visit.target]}{mates}", INK, False))
        if not mine:
            lines.append(("      stays", INK, False))
    step = min(0.027, 0.98 / max(1, len(lines) + len(agents) + 3))
    y = 0.985
    for text, colour, heading in lines:
        if heading:
            y -= 0.4 * step
        axes.text(0.0, y, text, color=colour, fontsize=min(9.5, 360 * step), va="top",
                  fontweight="bold" if heading else "normal", transform=axes.transAxes)
        y -= step
    note = "disc: start and skills\nA+B: all skills at once\nA/B: any of them\n@: step when solved"
    if plan.reason:
        note = textwrap.fill(plan.reason, 34)
    closed = [kind for kind, cells in (scenario.blocked or {}).items() if cells]
    for i, kind in enumerate(closed):
        axes.text(0.0, 0.09 + 0.022 * i, f"\u25a0 closed to {kind if kind != '*' else 'all'}",
                  color=shades.get(kind, SHADE), fontsize=9, va="bottom", transform=axes.transAxes)
    axes.text(0.0, 0.0, note, color="#6b6b78", fontsize=8, va="bottom", transform=axes.transAxes)
