"""A run over many missions that can be interrupted: its folder and its options."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from moonteam import files, outputs
from moonteam.errors import InputError
from moonteam.report.command import flag
from moonteam.version import __version__

Entry = TypeVar("Entry")


class Journal(Generic[Entry]):
    """The folder's rows.jsonl: a line is added as each mission ends.

    `entries` is what was done before; empty unless the run is resumed.
    """

    def __init__(self, out: Path, resume: bool, options: dict[str, Any], kind: Any,
                 names: Sequence[str] = ()):
        """Starts the folder, or reads what is done if it is to be resumed.

        `kind` is the type of an entry, `names` what an earlier run left, to be removed unless it is
        resumed. Raises InputError.
        """
        self._path, config = out / "rows.jsonl", out / "config.json"
        self.entries: list[Entry] = []
        held = {"moonteam": __version__, "options": options}
        if resume:
            _check_same(out, config, msgspec.json.decode(files.dump_json(held)))
            self.entries = self._read(kind)
        else:
            outputs.clear(out, names)
        files.write_json(config, held)
        files.write_text(self._path, "".join(map(_line, self.entries)))

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
        raise InputError("--resume", "needs the folder of the run to go on with: --out DIR")


def interrupted(out: Path | None) -> int:
    """Says that the run was stopped and how to go on; returns the exit code."""
    more = ": --resume goes on" if out else ""
    print(f"moonteam: interrupted{more}", file=sys.stderr)
    return 130
