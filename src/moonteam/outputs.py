"""Where a command writes: over nothing that is there unless told to, and never two at once.

A command holds its folder, or its one file, while it runs; `moonteam.files` asks here before each
file. Outside of a command (a library's user, a test) there is no rule: who names a file may
replace it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import shlex
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from moonteam.errors import InputError

LOCK = ".lock"
"""In a folder that is held: who holds it. What counts is the system's lock on the file, which
ends with its process, however that ends."""
_UNLOCKABLE = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)
"""Of a file system that knows no locks."""


@dataclass
class _Place:
    """What one command may write to: a folder with all in it, or a file."""

    root: Path  # absolute
    replaces: bool
    own: set[Path] = field(default_factory=set)
    staged: list[tuple[Path, Path]] | None = None  # (whole, its place), to be moved at the end


_places: list[_Place] = []


@contextlib.contextmanager
def folder(path: Path, names: Sequence[str], *, force: bool = False, resume: bool | None = None,
           updates: Sequence[str] = (), together: bool = True) -> Iterator[None]:
    """Holds a folder for the files `names` (patterns as `Path.glob` has them) of one command.

    Args:
      path: made if it is missing, and removed again if nothing was written.
      names: what the command writes. One that is there already is refused.
      force: replaces them instead.
      resume: the command goes on with its own files; None where it has no such option.
      updates: files that the command reads, adds to and writes anew; they may be there.
      together: where there is something to replace, all new files take their places at the end,
        so that the old ones stay as they are where the command fails; else one by one.

    Raises InputError in one line for what is in the way, and for a folder that another process
    holds.
    """
    root = Path(os.path.abspath(path))
    if any(place.root == root for place in _places):
        yield
        return
    if force and resume:
        raise InputError("--force", "is for a new run; --resume alone goes on with one")
    replaces = force or bool(resume)
    if path.is_symlink() and not replaces:
        raise InputError(path, "is a symbolic link; --force writes where it leads")
    made = _make(path)
    try:
        with _locked(path):
            held = _in_the_way(path, names)
            if held and not replaces:
                raise InputError(path, _refusal(held[0], resume))
            place = _Place(root, replaces, {root / name for name in updates
                                            if not (root / name).is_symlink()},
                           [] if held and force and together else None)
            with _holding(place):
                yield
    finally:
        for parent in made:
            with contextlib.suppress(OSError):  # something is in it
                parent.rmdir()


@contextlib.contextmanager
def file(path: Path, force: bool = False) -> Iterator[None]:
    """The same for a command that writes one file."""
    place = _Place(Path(os.path.abspath(path)), force)
    _admit(place, place.root, path)
    with _holding(place):
        yield


def free(path: Path, names: Sequence[str]) -> Path:
    """The folder, or the first of PATH-2, PATH-3 and so on that holds none of the files."""
    count, found = 1, path
    while os.path.lexists(found) and (not found.is_dir() or found.is_symlink()
                                      or _in_the_way(found, (*names, LOCK))):
        count += 1
        found = path.with_name(f"{path.name}-{count}")
    return found


def clear(path: Path, names: Sequence[str]) -> None:
    """Removes an earlier run's files from a folder; of links, the links.

    For a run that writes as it goes, once it is known that it can begin.
    """
    for old in _in_the_way(path, names):
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink()
    for place in _places:
        if place.root == Path(os.path.abspath(path)):
            place.staged = None


def admit(path: Path) -> None:
    """Raises InputError if the command that runs may not write this file, or not through it."""
    place, full = _place_of(path)
    if place is not None:
        _admit(place, full, path)


def publish(temporary: Path, path: Path) -> None:
    """Puts a whole file into its place: never over another's, at the end where all go together."""
    place, full = _place_of(path)
    if place is not None and place.staged is not None:
        place.staged.append((temporary, full))
    elif place is None or place.replaces or full in place.own:
        temporary.replace(path)
    else:
        _link(temporary, path)
        place.own.add(full)


def _make(path: Path) -> list[Path]:
    """Makes a folder; those that were missing, the deepest first."""
    missing = [one for one in (path, *path.parents) if not one.exists()]
    if path.exists() and not path.is_dir():
        raise InputError("--out", f"{path} is a file; a folder is needed")
    path.mkdir(parents=True, exist_ok=True)
    return missing


def _in_the_way(path: Path, names: Sequence[str]) -> list[Path]:
    """Files, folders and links of these names, also those that lead nowhere."""
    return [one for name in names
            for one in (sorted(path.glob(name)) if "*" in name else [path / name])
            if os.path.lexists(one)]


def _refusal(held: Path, resume: bool | None) -> str:
    if held.is_symlink():
        return f"holds {held.name}, a symbolic link; --force replaces the link"
    more = "" if resume is None else "--resume goes on with the run, "
    return (f"holds {held.name} already; {more}--force replaces what is there, or choose another "
            "--out")


def _admit(place: _Place, full: Path, path: Path) -> None:
    if place.replaces or full in place.own:
        return
    if full != place.root:
        for parent in full.relative_to(place.root).parents[:-1]:
            if (place.root / parent).is_symlink():
                raise InputError(place.root / parent,
                                 "is a symbolic link; --force writes where it leads")
    if full.is_symlink():
        raise InputError(path, "is a symbolic link; --force replaces the link")
    if full.exists():
        raise InputError(path, "is there already; --force replaces it, or choose another --out")


def _place_of(path: Path) -> tuple[_Place | None, Path]:
    """The innermost place that holds the file."""
    full = Path(os.path.abspath(path))
    return next((place for place in reversed(_places) if full.is_relative_to(place.root)),
                None), full


@contextlib.contextmanager
def _holding(place: _Place) -> Iterator[None]:
    _places.append(place)
    try:
        yield
        for temporary, path in place.staged or ():
            temporary.replace(path)
    finally:
        _places.remove(place)
        for temporary, _ in place.staged or ():
            temporary.unlink(missing_ok=True)


def _link(temporary: Path, path: Path) -> None:
    """Moves a file to where none is; unlike a rename, this cannot replace one that just came."""
    try:
        os.link(temporary, path)
    except FileExistsError:
        raise InputError(path, "is there already; --force replaces it, or choose another --out"
                         ) from None
    except OSError:  # a file system without hard links
        temporary.replace(path)
        return
    temporary.unlink()


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Holds the folder's lock. Raises InputError naming who else does."""
    lock = path / LOCK
    handle = _lock(path, lock)
    try:
        if handle is not None:
            try:
                os.ftruncate(handle, 0)
                os.write(handle, os.fsencode(_who()))
            except OSError as error:
                raise InputError(path, f"cannot be written to: {error.strerror}") from None
        yield
    finally:
        if handle is not None:
            lock.unlink(missing_ok=True)
            os.close(handle)


def _lock(path: Path, lock: Path) -> int | None:
    """A descriptor with the lock on it; None where there are no locks."""
    try:
        import fcntl
    except ImportError:  # no Unix
        return None
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        except FileNotFoundError:  # whoever made the folder found nothing to write
            path.mkdir(parents=True, exist_ok=True)
            continue
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Whoever held it removes the file at its end; then it must be the new one's.
            if lock.exists() and os.path.samestat(os.fstat(handle), lock.stat()):
                return handle
        except BlockingIOError:
            who = os.fsdecode(os.read(handle, 1000)) or "another process"
            os.close(handle)
            raise InputError(path, f"is in use by {who}; wait for its end, or choose another --out"
                             ) from None
        except OSError as error:
            os.close(handle)
            if error.errno in _UNLOCKABLE:
                return None
            raise
        os.close(handle)


def _who() -> str:
    words = shlex.join(["moonteam", *sys.argv[1:]])
    return f"process {os.getpid()} on {platform.node()} ({words[:200]})"
