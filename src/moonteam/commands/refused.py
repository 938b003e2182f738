"""What is wrong with a command's words, in one line.

tyro says it in a box of several; what it tells a hook is of its own (`tyro._errors`), and where a
version has none the box stays.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from moonteam.errors import InputError, meant, not_one_of

_OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*")


def in_one_line(prog: str, show_help: Callable[[], object]) -> AbstractContextManager[None]:
    """Inside it what tyro refuses becomes an InputError.

    Args:
      prog: the command, for messages.
      show_help: prints the help text, in which the options stand that there are.
    """
    try:
        from tyro import _errors as events
    except ImportError:
        return nullcontext()

    def refuse(event: Any) -> None:
        if isinstance(event, events.InvalidChoice):
            raise InputError(_name(event.argument), not_one_of(event.value, event.choices))
        if isinstance(event, events.UnrecognizedArgs):
            raise _unknown(prog, event.tokens, show_help)
        if isinstance(event, events.MissingArgs):
            if event.unrecognized_tokens:
                raise _unknown(prog, event.unrecognized_tokens, show_help)
            lacking = ", ".join(_form(one.arg) for one in event.missing_arguments)
            raise InputError(prog, f"{lacking} must be given; see {prog} --help")
        if isinstance(event, events.BadValue):
            raise InputError(_name(event.argument), f"a value must follow: "
                             f"{event.argument.lowered.metavar}")
        if isinstance(event, events.InstantiationFailure) and event.argument is not None:
            raise InputError(_name(event.argument), f"{event.argument.lowered.metavar} is needed: "
                             f"{event.message.splitlines()[0].rstrip('.')}")

    return events.on_parse_error(refuse)


def _name(argument: Any) -> str:
    """As the user writes it; of a word without option what help calls it."""
    name = argument.lowered.name_or_flags[-1]
    return name.upper() if argument.is_positional() else name


def _form(argument: Any) -> str:
    metavar = argument.lowered.metavar
    return metavar if argument.is_positional() else f"{_name(argument)} {metavar}"


def _unknown(prog: str, tokens: list[str], show_help: Callable[[], object]) -> InputError:
    """The first option that there is not, else the first word that has no place."""
    for token in tokens:
        name = token.partition("=")[0]
        if re.match("--?[A-Za-z]", name):
            known = dict.fromkeys(_OPTION.findall(_printed(show_help)))
            near = meant(name.strip("-"), [one.strip("-") for one in known], "--")
            return InputError(name, f"{prog} has no such option; {near}see {prog} --help")
    return InputError(prog, f"{tokens[0]!r} has no place here; see {prog} --help")


def _printed(show: Callable[[], object]) -> str:
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit), _unhooked():
        show()
    return text.getvalue()


@contextlib.contextmanager
def _unhooked() -> Iterator[None]:
    from tyro import _errors as events

    with events.on_parse_error(lambda event: None):
        yield
