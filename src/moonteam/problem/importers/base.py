"""What an importer is, and what several of them need: instances in order, YAML, places."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import yaml

from moonteam import files
from moonteam.errors import InputError
from moonteam.problem.timed import Place, Timed
from moonteam.strict import line_of

T = TypeVar("T")


@dataclass(frozen=True)
class Importer:
    """A format of instances that others publish."""

    name: str
    folder: str
    """Where such a folder is: repository and path, for the help text."""
    read: Callable[[Path], list[Timed]]
    """The folder's instances, in order. Raises InputError naming the file and the key."""


def skill(number: int) -> str:
    """The letter of a numbered capability: A, B, ..., Z, then S26."""
    return chr(ord("A") + number) if number < 26 else f"S{number}"


def numbered(folder: Path, pattern: str) -> list[Path]:
    """What the folder has of a pattern such as `env_*`, by the numbers in the names.

    Raises InputError if the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder")
    found = [path for path in folder.glob(pattern) if re.search(r"\d", path.stem)]
    if not found:
        raise InputError(folder, f"holds no {pattern}")
    return sorted(found, key=lambda path: (
        [int(n) for n in re.findall(r"\d+", path.stem)], path.name))


def folders(folder: Path, pattern: str) -> list[Path]:
    """The sub-folders of a pattern, by their numbers; files of the same name are passed over."""
    found = [path for path in numbered(folder, pattern) if path.is_dir()]
    if not found:
        raise InputError(folder, f"holds no folder {pattern}")
    return found


def read_yaml(path: Path) -> Any:
    """The value of a YAML file, plain data only. Raises InputError."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml's, if it is there: 10 x faster
    try:
        return yaml.load(files.read_text(path), Loader=loader)
    except yaml.YAMLError as error:
        raise InputError(path, f"is not YAML{line_of(error)}") from None


def entry(value: Any, path: Path, *keys: str | int, kind: type[T] | Any = Any) -> T:
    """What stands at `value[key][key]...`, of a type. Raises InputError naming the key."""
    where = ""
    for key in keys:
        where = f"{where}[{key}]" if isinstance(key, int) else f"{where}.{key}".lstrip(".")
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError):
            raise InputError(path, "missing", where) from None
    return files.convert(value, kind, path, where)


def places(distances: npt.NDArray[np.float64], path: Path) -> list[Place]:
    """Places in the plane with these distances [P, P], m; the first is the origin.

    Classical scaling (Torgerson 1952), turned so that the first other place lies to the right and
    the first off that axis above it: a graph of straight ways says no more of where things are.
    Raises InputError if no places in a plane have these distances.
    """
    count = len(distances)
    centre = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ distances**2 @ centre)
    top = np.argsort(values)[::-1][:2]
    found = np.zeros((count, 2))
    found[:, :len(top)] = vectors[:, top] * np.sqrt(np.maximum(values[top], 0.0))
    found -= found[0]
    scale = float(distances.max())
    away = np.flatnonzero(np.hypot(*found.T) > 1e-9 * scale)
    if len(away):
        x, y = found[away[0]] / np.hypot(*found[away[0]])
        found = found @ np.array([[x, -y], [y, x]])
        off = found[np.abs(found[:, 1]) > 1e-9 * scale, 1]
        found[:, 1] *= -1.0 if len(off) and off[0] < 0 else 1.0
    between = np.hypot(*(found[:, None] - found[None]).transpose(2, 0, 1))
    wrong = float(np.abs(between - distances).max(initial=0.0))
    if not wrong <= 1e-6 * scale:
        raise InputError(path, "its distances are not those of places in a plane: off by "
                         f"{wrong:g}")
    return [(float(x), float(y)) for x, y in found.round(9) + 0.0]
