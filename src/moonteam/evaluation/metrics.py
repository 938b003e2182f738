"""From what each planner did on each scenario to the figures of a table.

Definitions (Rubio, Richter, Kolvenbach, Hutter; DESIGN of this project where the paper is
silent), over all S scenarios of a set, failures included with T = T_max and the moves they
really made:

- success M_success: share of the scenarios solved within T_max;
- slack in time M_st = T_max - T, slack in effort M_tte = N * T_max - moves;
- slack ratios: mean slack over the mean slack of the optimum, a ratio of means;
- true gaps: mean makespan (or moves) over the mean optimum, less one. Slack ratios hide
  these: with T_max = 128 and an optimum of 45, a slack ratio of 0.86 is a gap of 26 %.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from moonteam.report.intervals import Bootstrap, Figure, share

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Family:
    """What the figures need to know of the scenarios themselves."""

    ids: tuple[str, ...]
    horizon: IntArray  # [S] T_max, steps
    num_agents: IntArray  # [S] N

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class Reference:
    """What each scenario is measured against; not-a-number where nothing is known."""

    makespan: FloatArray  # [S] steps
    moves: FloatArray  # [S]
    source: str = ""
    """Where the values come from, in words for the report."""


@dataclass(frozen=True)
class Outcomes:
    """What one planner did on every scenario, as the environment saw it."""

    planner: str
    success: npt.NDArray[np.bool_]  # [S]
    steps: IntArray  # [S] T; T_max where it failed
    moves: IntArray  # [S] team effort really spent
    seconds: float  # planning time of all scenarios, without the first call
    first_call: float = 0.0  # seconds of the first call: compilation, loading
    note: str = ""

    def __post_init__(self) -> None:
        if not len(self.success) == len(self.steps) == len(self.moves):
            raise ValueError("success, steps and moves must be of one length")


FIGURES = ("success", "makespan", "moves", "M_st", "M_tte", "st_ratio", "tte_ratio",
           "makespan_gap", "moves_gap", "decisions")
"""Keys of a summary row that carry an interval, in the order of the table."""


def figures(outcomes: Outcomes, family: Family, reference: Reference,
            bootstrap: Bootstrap) -> dict[str, Figure]:
    """Every figure of one planner, with its interval."""
    horizon, team = family.horizon, family.num_agents * family.horizon
    slack, effort = horizon - outcomes.steps, team - outcomes.moves
    time_gap = bootstrap.ratio(outcomes.steps, reference.makespan)
    effort_gap = bootstrap.ratio(outcomes.moves, reference.moves)
    return {
        "success": share(outcomes.success),
        "makespan": bootstrap.mean(outcomes.steps),
        "moves": bootstrap.mean(outcomes.moves),
        "M_st": bootstrap.mean(slack),
        "M_tte": bootstrap.mean(effort),
        "st_ratio": bootstrap.ratio(slack, horizon - reference.makespan),
        "tte_ratio": bootstrap.ratio(effort, team - reference.moves),
        "makespan_gap": Figure(*(v - 1.0 for v in time_gap)),
        "moves_gap": Figure(*(v - 1.0 for v in effort_gap)),
        # One joint action a step: a planner that thinks once still issues T of them.
        "decisions": bootstrap.mean(outcomes.steps),
    }


def summary(outcomes: Outcomes, family: Family, reference: Reference,
            bootstrap: Bootstrap) -> dict:
    """A row of the report: plain values, their intervals beside them, times apart."""
    found = figures(outcomes, family, reference, bootstrap)
    row: dict = {"planner": outcomes.planner, "scenarios": len(family)}
    row |= {key: figure.value for key, figure in found.items()}
    row["intervals"] = {key: [figure.low, figure.high] for key, figure in found.items()}
    row["seconds"] = outcomes.seconds / len(family)
    row["first_call_seconds"] = outcomes.first_call
    if outcomes.note:
        row["note"] = outcomes.note
    return row


def hold_against(row: dict, outcomes: Outcomes, other: Outcomes | None,
                 bootstrap: Bootstrap) -> None:
    """Adds to a summary row its mean makespan over another's, less one; None if there is none."""
    row["against"] = None
    if other is not None:
        value, low, high = (v - 1.0 for v in bootstrap.ratio(outcomes.steps, other.steps))
        row["against"], row["intervals"]["against"] = value, [low, high]


def rows(outcomes: Outcomes, family: Family, reference: Reference) -> list[dict]:
    """One row a scenario; `makespan` is None where the planner failed."""
    found = []
    for i, name in enumerate(family.ids):
        solved = bool(outcomes.success[i])
        optimal = {key: None if np.isnan(value[i]) else int(value[i]) for key, value in
                   (("makespan", reference.makespan), ("moves", reference.moves))}
        found.append({"id": name, "planner": outcomes.planner, "success": solved,
                      "makespan": int(outcomes.steps[i]) if solved else None,
                      "moves": int(outcomes.moves[i]), "optimal": optimal})
    return found
