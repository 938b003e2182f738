"""Errors that a user can mend: one clear line naming file, key and what is allowed."""


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
        where = f"{self.source}: {key}: " if key else f"{self.source}: "
        super().__init__(where + " ".join(problem.split()))
