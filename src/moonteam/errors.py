"""Errors that a user can mend: one clear line naming file, key and what is allowed."""


LONGEST = 600
"""Characters of a source or a problem that are shown."""


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
