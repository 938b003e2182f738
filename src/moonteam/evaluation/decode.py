"""How actions are read from a policy's probabilities: argmax, sample, best-of-K."""

from __future__ import annotations

from dataclasses import dataclass

from moonteam.errors import InputError

MOST_ROLLOUTS = 4096
ALLOWED = "argmax, plain-argmax, sample, best-of-K (such as best-of-16)"


@dataclass(frozen=True)
class Decode:
    """How one row decides.

    `sample` draws the actions; `watch` takes the likeliest but draws where the team comes back
    to a joint state without having solved a target in between, as
    `planners.learned.LearnedPlanner` does; of `rollouts` tries a scenario the best counts.
    """

    name: str
    sample: bool = False
    watch: bool = False
    rollouts: int = 1


def parse(text: str) -> Decode:
    """`argmax`, `plain-argmax`, `sample` or `best-of-K`. Raises InputError."""
    simple = {"argmax": Decode(text, watch=True), "plain-argmax": Decode(text),
              "sample": Decode(text, sample=True)}
    if text in simple:
        return simple[text]
    head, _, count = text.rpartition("-")
    if head == "best-of":
        if count.isascii() and count.isdigit() and 1 <= int(count) <= MOST_ROLLOUTS:
            return Decode(f"best-of-{int(count)}", sample=True, rollouts=int(count))
        raise InputError("--decode", f"best-of-K needs a whole number K from 1 to "
                         f"{MOST_ROLLOUTS}, not {count!r}")
    raise InputError("--decode", f"{text!r} is not one of {ALLOWED}")
