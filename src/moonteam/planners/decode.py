"""How actions are read from a policy's probabilities: argmax, sample, best-of-K."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from moonteam.errors import InputError, meant
from moonteam.planners.base import SAMPLING

MOST_ROLLOUTS = 4096
ALLOWED = ("argmax, plain-argmax, sample or best-of-K (such as best-of-16); @T after it "
           "sets the temperature of drawing (such as sample@0.25)")
MODES = ("argmax", "plain-argmax", "sample", "best-of-K")

_FORM = re.compile(r"(?P<how>argmax|plain-argmax|sample|best-of-(?P<count>[^@]*))(@(?P<heat>.*))?")


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
    temperature: float = 1.0
    asked: str = field(default="", compare=False)
    """As the user wrote it; `parse` of it gives the same."""

    @property
    def heat(self) -> float:
        """Temperature at which targets are drawn; 0: never."""
        return 0.0 if not self.sample else self.temperature if "@" in self.asked else HELD


    @property
    def cooling(self) -> bool:
        """Whether several tries are cooler one by one, see `macro.rollouts`: none is asked for."""
        return self.rollouts > 1 and "@" not in self.asked


HELD = 1.0
"""Temperature at which choices of targets are drawn, which are few and held; `SAMPLING` is that
of the many steps of a stepwise policy."""


def parse(text: str) -> Decode:
    """The decoding that a user names, see `ALLOWED`. Raises InputError."""
    found = _FORM.fullmatch(text)
    if found is None:
        near = meant(re.sub(r"of-?\d*$", "of-K", text.partition("@")[0]), MODES).rstrip()
        raise InputError("--decode", f"{text!r} is not one of {ALLOWED}{'; ' * bool(near)}{near}")
    how, count = found["how"], found["count"]
    rollouts = 1
    if count is not None:
        if not (count.isascii() and count.isdigit() and 1 <= int(count) <= MOST_ROLLOUTS):
            raise InputError("--decode", f"best-of-K needs a whole number K from 1 to "
                             f"{MOST_ROLLOUTS}, not {count!r}")
        rollouts = int(count)
        how = f"best-of-{rollouts}"
    if how == "plain-argmax" and found["heat"] is not None:
        raise InputError("--decode", f"{text!r}: plain-argmax never draws, it has no temperature")
    sample = count is not None or how == "sample"
    usual = SAMPLING if sample else 1.0
    heat = usual if found["heat"] is None else _temperature(text, found["heat"])
    # Networks that choose targets draw at another usual temperature: what was asked is said.
    same = found["heat"] is None or (heat == usual and not sample)
    name = how + ("" if same else f"@{heat:g}")
    return Decode(name, sample, how == "argmax", rollouts, heat, text)


def _temperature(text: str, heat: str) -> float:
    try:
        value = float(heat)
    except ValueError:
        value = 0.0
    if not 0.0 < value < 1e6:
        raise InputError("--decode", f"{text!r}: a temperature above 0 follows the @")
    return value
