"""What a user names, found and read: a mission, a scenario, one of a set, or a whole set."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from moonteam import files, paths
from moonteam.errors import InputError, meant
from moonteam.problem import mission as missions
from moonteam.problem import scenario, timed
from moonteam.problem.mission import Mission
from moonteam.problem.scenario import Scenario
from moonteam.problem.timed import Timed

YAML = (".yaml", ".yml")
SETS, MISSIONS = ("testsets", ".jsonl"), ("missions", ".yaml")


def load(source: str | os.PathLike[str]
         ) -> Mission | Scenario | Timed | list[Scenario] | list[Timed]:
    """Reads and checks what `source` names.

    A mission (.yaml), a scenario (.json), a set (.jsonl), one line of a set (`SET:INDEX`,
    counted from 0, or `SET:ID`), or the name of a bundled mission or set. Scenarios whose objects
    say `"clock": "seconds"` are problems by the clock, `Timed`. A mission without a name gets
    that of its file. Raises InputError naming file, key and what is allowed.
    """
    name = os.fspath(source)
    path = Path(name)
    head, colon, which = name.rpartition(":")
    if colon and not path.is_file() and path.suffix not in YAML:
        return pick(paths.find(head, *SETS), which)
    if path.suffix == ".jsonl":
        return load_set(path)
    if names_mission(name):
        return load_mission(name)
    if not path.suffix and not path.is_file():
        return load_set(paths.find(name, *SETS))
    return timed.load(path) if timed.by_the_clock(path) else scenario.load(path)


def names_mission(name: str) -> bool:
    """Whether it is the file or the name of a mission, and not of scenarios.

    Raises InputError for a name, not that of a file, which is neither's.
    """
    path = Path(name)
    if path.suffix or path.is_file():
        return path.suffix in YAML
    sets, known = (paths.bundled_names(*kind) for kind in (SETS, MISSIONS))
    if name not in (*sets, *known):
        what = "is a folder" if path.is_dir() else "no such file"
        raise InputError(name, f"{what}; {meant(name, [*known, *sets])}bundled "
                         f"missions: {', '.join(known)}; sets: {', '.join(sets)}")
    return name not in sets


def load_set(path: Path) -> list[Scenario] | list[Timed]:
    """A set, in steps or by the clock (or one `.json` of either). Raises InputError."""
    if not timed.by_the_clock(path):
        return scenario.load_set(path)
    return timed.load_set(path) if path.suffix == ".jsonl" else [timed.load(path)]


def load_one(source: str | os.PathLike[str]) -> Mission | Scenario:
    """A mission or a scenario in steps, be it the only one of a set.

    Raises InputError, for a problem by the clock too.
    """
    found = load_single(source)
    if isinstance(found, Timed):
        raise InputError(source, "is by the clock; only scenarios in steps can be used here")
    return found


def load_single(source: str | os.PathLike[str]) -> Mission | Scenario | Timed:
    """A mission, a scenario or a problem by the clock, be it the only one of a set.

    Raises InputError.
    """
    found = load(source)
    if isinstance(found, list):
        if len(found) > 1:
            raise InputError(source, f"is a set, which holds {len(found)} scenarios; choose one, "
                             f"such as {os.fspath(source)}:0")
        found = found[0]
    return found


def load_mission(name: str) -> Mission:
    """A mission file, or the bundled mission of that name, its kinds of robot found.

    Files that it names have their full paths: it can be written anywhere. Raises InputError.
    """
    return _settled(*read_mission(name))


def decode_mission(text: str, source: object) -> Mission:
    """The same of a mission that was made in Python, from its JSON. Raises InputError."""
    found = files.convert(msgspec.json.decode(text), Mission, source)
    return _settled(missions.check(found, source), source)


def _settled(found: Mission, source: object) -> Mission:
    from moonteam.robots import team

    if found.site.dem is not None:
        full = os.fspath(Path(found.site.dem).resolve())
        found = msgspec.structs.replace(found, site=msgspec.structs.replace(found.site, dem=full))
    return team.settled(found, source)


def read_mission(name: str) -> tuple[Mission, Path]:
    """The mission as its file has it, named after the file where it has no name, and the file.

    Raises InputError.
    """
    path = paths.find(name, "missions", ".yml" if name.endswith(".yml") else ".yaml")
    found = missions.load(path)
    return msgspec.structs.replace(found, name=found.name or path.stem), path


def pick(path: Path, which: str) -> Scenario | Timed:
    """Scenario number `which` of a set, or the one with that id. Raises InputError."""
    found = load_set(path)
    same = [s for s in found if s.id == which]
    if same:
        return same[0]
    if which.isdecimal() and int(which) < len(found):
        return found[int(which)]
    near = meant(which, [s.id for s in found])
    raise InputError(path, f"has no scenario {which!r}; {near}a number 0 to {len(found) - 1} or an "
                     f"id, such as {found[0].id or 'none here'}")
