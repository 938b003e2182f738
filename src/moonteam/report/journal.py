"""A run over many rows that can be interrupted or killed: its folder and its options."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from moonteam import files, interrupts, outputs
from moonteam.errors import InputError
from moonteam.report.command import flag
from moonteam.version import __version__

NEEDS_OUT = "needs the folder of the run to go on with: --out DIR"
Entry = TypeVar("Entry")
T = TypeVar("T")


class Journal(Generic[Entry]):
    """The folder's rows.jsonl: a line is added as each row is done.

    `entries` is what was done before; empty unless the run is resumed.
    """

    def __init__(self, out: Path, resume: bool, options: dict[str, Any], kind: Any,
                 names: Sequence[str] = (), wait: bool = False):
        """Starts the folder, or reads what is done if it is to be resumed.

        `kind` is the type of an entry, `names` what an earlier run left, to be removed unless it is
        resumed; with `wait` nothing is removed or written until `begin`. Raises InputError.
        """
        self._path, self._config, self._begun = out / "rows.jsonl", out / "config.json", False
        self.entries: list[Entry] = []
        self._held = {"moonteam": __version__, "options": options}
        if resume:
            _check_same(out, self._config, msgspec.json.decode(files.dump_json(self._held)))
            self.entries = self._read(kind)
        self._old = None if resume else (out, names)
        if not wait:
            self.begin()

    def begin(self) -> None:
        """Writes the options, and the entries without the half of a line; once."""
        if not self._begun:
            if self._old is not None:
                outputs.clear(*self._old)
            files.write_json(self._config, self._held)
            files.write_text(self._path, "".join(map(_line, self.entries)))
            self._begun = True

    def add(self, entry: Entry) -> None:
        """Adds an entry; what an interruption cuts off is dropped when the run is resumed."""
        files.append(self._path, _line(entry))

    def _read(self, kind: Any) -> list[Entry]:
        """The whole entries; half a line at the end is left out."""
        found = []
        text = files.read_text(self._path) if self._path.exists() else ""
        whole, _, _ = text.rpartition("\n")
        for number, line in enumerate(files.lines(whole) if whole else [], 1):
            try:
                found.append(msgspec.json.decode(line, type=kind))
            except msgspec.DecodeError as error:
                raise InputError(self._path, f"line {number} is no row: {error}") from None
        return found


@dataclass(frozen=True)
class Kept:
    """Results by name, each made once: in a journal where there is a folder, else only made."""

    journal: Journal[tuple[tuple[str, ...], Any]] | None = None
    known: dict[tuple[str, ...], Any] = field(default_factory=dict)
    prefix: tuple[str, ...] = ()

    @classmethod
    def of(cls, out: Path | None, resume: bool, options: dict[str, Any],
           names: Sequence[str] = ()) -> Kept:
        """Results of a command with these options and files. Raises InputError, see `Journal`."""
        if out is None:
            if resume:
                raise InputError("--resume", NEEDS_OUT)
            return cls()
        entry = tuple[tuple[str, ...], Any]
        journal = Journal[entry](out, resume, options, entry, names, wait=True)
        return cls(journal, dict(journal.entries))

    def within(self, *names: str) -> Kept:
        """The same journal, its names behind these."""
        return Kept(self.journal, self.known, (*self.prefix, *names))

    def once(self, names: tuple[str, ...], kind: type[T], make: Callable[[], T]) -> T:
        """What was made under these names before, or what is made and noted now.

        `kind` is what msgspec reads it as. KeyboardInterrupt and InputError pass through.
        """
        whole = (*self.prefix, *names)
        if whole in self.known:
            return msgspec.convert(self.known[whole], kind)
        self.begin()
        made = make()
        self._add(whole, made)
        return made

    def copy(self) -> Kept:
        """The same journal, to be added to by `note`."""
        return Kept(self.journal, dict(self.known), self.prefix)

    def begin(self) -> None:
        """Something is to be made."""
        if self.journal is not None:
            self.journal.begin()

    def note(self, names: tuple[str, ...], made: Any) -> None:
        """Notes what was made elsewhere, which `once` finds then as a resumed run does."""
        whole = (*self.prefix, *names)
        self._add(whole, made)
        self.known[whole] = msgspec.json.decode(files.dump_json(made))

    def _add(self, whole: tuple[str, ...], made: Any) -> None:
        if self.journal is not None:
            self.journal.add((whole, made))
        interrupts.hold()

    def has(self, *names: str) -> bool:
        """Whether it was made before."""
        return (*self.prefix, *names) in self.known


NOTHING = Kept()
"""Where nothing is kept."""


def _line(entry: object) -> str:
    return files.dump_json(entry) + "\n"


def _check_same(out: Path, config: Path, plain: dict[str, Any]) -> None:
    """Raises InputError if the folder's run was made with other options."""
    if not config.exists():
        raise InputError("--resume", f"{out} holds no run to go on with")
    before = msgspec.json.decode(files.read_text(config))
    if before == plain:
        return
    changed = sorted(key for key in plain["options"]
                     if plain["options"][key] != before.get("options", {}).get(key))
    raise InputError("--resume", f"{out} was made with other options: "
                     + (", ".join(changed) or "another version of moonteam"))


def check(args: Any, ranges: Sequence[tuple[str, float, float]],
          choices: Sequence[str] = ()) -> None:
    """Raises InputError for an option of `args` out of its (name, low, high), for a choice made
    twice or not at all, and for --resume without --out.
    """
    for name, low, high in ranges:
        value = getattr(args, name)
        if not low <= value <= high:
            raise InputError(flag(name), f"{value} is not allowed; {low} to {high}")
    for name in choices:
        chosen = getattr(args, name)
        if len(set(chosen)) < len(chosen) or not chosen:
            raise InputError(flag(name), "give each once, and at least one")
    if args.resume and args.out is None:
        raise InputError("--resume", NEEDS_OUT)


def interrupted(out: Path | None) -> int:
    """Says that the run was stopped and how to go on; returns the exit code."""
    more = ": --resume goes on" if out else ""
    print(f"moonteam: interrupted{more}", file=sys.stderr)
    return interrupts.CODE
