"""What plugs in: objects found by a name of ours, by an entry point, or in a user's file."""

from __future__ import annotations

import importlib
import importlib.util
import sys
import zlib
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Generic, TypeVar, cast

from moonteam.errors import InputError, meant

T = TypeVar("T")


class Registry(Generic[T]):
    """Named objects of one type.

    Args:
      noun: what they are, in messages: "robot kind", "planner".
      group: entry-point group in which other packages offer theirs, such as `moonteam.robots`.
      kind: the type that every object must be an instance of.
      own: ours, as name -> "module:OBJECT"; imported when first asked for.
    """

    def __init__(self, noun: str, group: str, kind: type[T], own: dict[str, str]):
        self.noun, self.group, self.kind = noun, group, kind
        self._own: dict[str, str | T] = dict(own)

    def register(self, name: str, thing: T) -> T:
        """Adds an object in this process. Raises InputError if the name is taken by another."""
        held = self._own.get(name)
        if held is not None and held is not thing:
            raise InputError(name, f"is already the name of a {self.noun}")
        self._checked(thing, name)
        self._own[name] = thing
        return thing

    def names(self) -> tuple[str, ...]:
        """All that is registered: ours in our order, then other packages'."""
        return tuple(dict.fromkeys([*self._own, *sorted(self._offered())]))

    def get(self, name: str, source: object = None, key: str = "") -> T:
        """The object called `name`, or `OBJECT` of a `FILE.py:OBJECT`.

        Raises InputError naming `source` and `key` (else the name itself) and what is allowed.
        """
        try:
            return self._get(name)
        except InputError as error:
            if source is None:
                raise
            raise InputError(source, f"{error.source}: {error.problem}", key) from None

    def _get(self, name: str) -> T:
        file, colon, thing = name.rpartition(":")
        if colon and file.endswith(".py"):
            return self._checked(_from_file(file, thing), name)
        held = self._own.get(name)
        if held is None and name in (offered := self._offered()):
            try:
                held = offered[name].load()
            except Exception as error:
                raise InputError(name, f"the package that offers this {self.noun} cannot be "
                                 f"loaded: {type(error).__name__}: {error}") from error
        if held is None:
            raise InputError(name, self._unknown(name))
        if isinstance(held, str):
            module, _, thing = held.partition(":")
            held = getattr(importlib.import_module(module), thing)
        self._own[name] = found = self._checked(held, name)
        return found

    def _offered(self) -> dict[str, metadata.EntryPoint]:
        return {point.name: point for point in metadata.entry_points(group=self.group)}

    def _checked(self, thing: object, name: str) -> T:
        if not isinstance(thing, self.kind):
            raise InputError(name, f"is a {type(thing).__name__}, not a {self.kind.__name__}, "
                             f"which a {self.noun} must be")
        return cast(T, thing)

    def _unknown(self, name: str) -> str:
        return (f"no such {self.noun}; {meant(name, self.names())}registered: "
                f"{', '.join(self.names())}; or FILE.py:OBJECT")


def _from_file(file: str, thing: str) -> object:
    """The object of that name in a Python file, which is run once a process."""
    path = Path(file)
    if not path.is_file():
        raise InputError(file, "no such file")
    module = _module(path.resolve())
    if not hasattr(module, thing):
        near = meant(thing, [name for name in vars(module) if not name.startswith("_")])
        raise InputError(file, f"holds no {thing!r}{'; ' * bool(near)}{near}")
    return getattr(module, thing)


@cache
def _module(path: Path) -> object:
    """The file as a module, under a name of its own; files beside it can be imported."""
    name = f"moonteam_plugin_{path.stem}_{zlib.crc32(str(path).encode()):x}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    beside = str(path.parent)
    sys.path.insert(0, beside)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise InputError(path, f"cannot be run: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(beside)
    return module
