"""Errors that a user can mend: one clear line naming file, key and what is allowed."""

import difflib
from collections.abc import Iterable

LONGEST = 600
"""Characters of a source or a problem that are shown."""
_LONGEST_NAME = 80
"""Characters of a name that is compared with others."""
_NEAR = 0.65
"""Of two names that are taken for one: twice what they share over the letters of both."""


def meant(name: str, names: Iterable[str], before: str = "") -> str:
    """`did you mean NEAR? `, to be put before the list of names; empty where none is near.

    `before` is what all of them begin with, to be said but not compared.
    """
    if len(name) > _LONGEST_NAME:
        return ""
    known = {one.casefold(): one for one in names}
    near = difflib.get_close_matches(name.casefold(), known, 1, _NEAR)
    return f"did you mean {before}{known[near[0]]}? " if near else ""


def not_one_of(name: object, names: Iterable[object]) -> str:
    """What is said of a value that is none of a few, the nearest of them at the end."""
    known = [str(one) for one in names]
    near = meant(str(name), known).rstrip()
    return f"{name!r} is not one of {', '.join(known)}{'; ' * bool(near)}{near}"


class InputError(Exception):
    """Bad input. The command line prints the message alone and exits with code 2.

    Args:
      source: the file (or option) at fault, as the user named it.
      problem: what is wrong and what is allowed, in one line.
      key: where inside the file, e.g. ``robots[2].start``; empty for the whole file.
    """

    def __init__(self, source: object, problem: str, key: str = ""):
        self.source = str(source)
        self.key = key
        self.problem = problem
        where = f"{_line(self.source)}: {_line(key, 200)}: " if key else f"{_line(self.source)}: "
        super().__init__(where + _line(" ".join(problem.split())))


def _line(text: str, longest: int = LONGEST) -> str:
    """As a terminal shows it in one line: what has no shape is written as its number."""
    if len(text) > longest:
        text = f"{text[:longest - 100]} ... {text[-80:]}"
    return text if text.isprintable() else "".join(
        c if c.isprintable() else ascii(c)[1:-1] for c in text)
