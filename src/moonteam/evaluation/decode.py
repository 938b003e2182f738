"""How actions are read from a policy's probabilities: argmax, sample, best-of-K."""

from __future__ import annotations

from dataclasses import dataclass

from moonteam.errors import InputError

MOST_ROLLOUTS = 4096


@dataclass(frozen=True)
class Decode:
    """`rollouts` tries a scenario, the best of which counts; `sample` draws the actions."""

    name: str
    sample: bool
    rollouts: int = 1


def parse(text: str) -> Decode:
    """`argmax`, `sample` or `best-of-K`. Raises InputError."""
    if text == "argmax":
        return Decode(text, sample=False)
    if text == "sample":
        return Decode(text, sample=True)
    head, _, count = text.rpartition("-")
    if head == "best-of":
        if count.isascii() and count.isdigit() and 1 <= int(count) <= MOST_ROLLOUTS:
            return Decode(f"best-of-{int(count)}", sample=True, rollouts=int(count))
        raise InputError("--decode", f"best-of-K needs a whole number K from 1 to "
                         f"{MOST_ROLLOUTS}, not {count!r}")
    raise InputError("--decode", f"{text!r} is not one of argmax, sample, best-of-K "
                     "(such as best-of-16)")
