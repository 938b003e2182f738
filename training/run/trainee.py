"""What a run asks of what it trains; MAPPO, imitation and refinement answer it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from moonteam.policies.policy_file import PolicyFile

Row = dict[str, Any]
"""A line of `metrics.jsonl`: the position, the rate, a chunk's figures, held-out scores if any."""


@dataclass
class Position:
    """Where a run stands; what `about.json` records and each line of the metrics begins with."""

    phase: str
    update: int = 0
    """Updates made in this phase; a round of imitation or refinement counts as one."""
    total_updates: int = 0
    """Over all phases; a checkpoint's number."""
    env_steps: int = 0
    """Steps of environments so far; each moves a whole team once."""
    seconds: float = 0.0
    """Spent in chunks; evaluations and compiling apart."""


def due(at: Position, updates: int, every: int) -> bool:
    """Whether to look at a phase of so many updates now: every so many, more often in a short one,
    for a curve of eight points, and at its end.
    """
    return at.update >= updates or at.update % max(1, min(every, updates // 8)) == 0


class Made(NamedTuple):
    """What a chunk came to."""

    updates: int
    env_steps: int
    figures: dict[str, float]


class Trainee(Protocol):
    """Something that is trained chunk by chunk, and is its arrays: the same arrays and the same
    recipe go on to the same bits, in another process too.
    """

    @property
    def name(self) -> str:
        """The preset."""
        ...

    @property
    def unit(self) -> str:
        """What is counted, for people: update or round."""
        ...

    @property
    def seed(self) -> int:
        """Of everything random in the run."""
        ...

    @property
    def recipe(self) -> dict[str, Any]:
        """`config.json`; a resumed run must keep all of it."""
        ...

    @property
    def network(self) -> dict[str, Any]:
        """What a checkpoint must agree in, to be gone on with."""
        ...

    @property
    def phases(self) -> tuple[tuple[str, int], ...]:
        """Names and numbers of updates, in order."""
        ...

    @property
    def env_steps(self) -> int:
        """Of the whole run."""
        ...

    def enter(self, phase: str) -> None:
        """Takes up a phase, with what the one before left; nothing if it is in it already."""
        ...

    def chunk(self, at: Position) -> Made:
        """Makes the next updates of the phase; none is cut."""
        ...

    def held_out(self, at: Position) -> dict[str, Any]:
        """Scores on scenarios that training never draws, if they are due here, else nothing.

        Asked before the first chunk too.
        """
        ...

    def weights(self) -> Any:
        """All parameters; one that is not a number stops the run."""
        ...

    def state(self) -> Any:
        """A tree of arrays, keys of random numbers among them: all that a resumed run needs."""
        ...

    def shapes(self, phase: str) -> Any:
        """`state` in that phase as shapes and kinds alone."""
        ...

    def restore(self, phase: str, state: Any) -> None:
        """Puts a `state` of host arrays back."""
        ...

    def score(self, row: Row) -> float | None:
        """Held-out success by which the best checkpoint is found; None without an evaluation."""
        ...

    def fallen(self, rows: list[Row]) -> str:
        """How far the policy has lost what it could, in words; empty if it has not."""
        ...

    def words(self, rows: list[Row]) -> str:
        """The lines beside the bar."""
        ...

    def policy(self, at: Position, commit: str) -> PolicyFile:
        """The shipped form."""
        ...

    def report(self, rows: list[Row]) -> dict[str, Any]:
        """Final figures for `report.json`."""
        ...

    def lines(self, report: dict[str, Any]) -> list[str]:
        """The final figures for people; the last says what was spent."""
        ...

    def draw_curve(self, path: Path, rows: list[Row]) -> None:
        """Writes `curve.png`."""
        ...
