"""Checkpoints that survive being killed: whole or not there, and checked when read.

`checkpoints/00000120/` holds `learner/` (as Orbax writes it: the trainee's state, such as
parameters, optimiser, environment states, memories, keys) and `about.json` (where in the run, what
network, a checksum of each file). A folder appears under its name only when complete. The number
counts updates over all phases.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
import warnings
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from urllib.parse import quote

import jax
import msgspec
import numpy as np

from moonteam import files
from moonteam.errors import InputError

KEEP = 3
Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Expect = Callable[["About"], Any]
"""The state that a run needs of a checkpoint, in shapes; raises InputError if none will do."""


class About(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands beside the arrays."""

    phase: str
    update: Count
    total_updates: Count
    env_steps: Count
    seconds: Annotated[float, msgspec.Meta(ge=0)]
    files: dict[str, int]
    network: dict[str, Any]


def raw(state: Any) -> Any:
    """The tree with the keys of random numbers as their words, which can be written."""
    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, state)


def _is_key(leaf: Any) -> bool:
    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def flatten(state: Any) -> dict[str, np.ndarray]:
    """Every leaf of a `raw` tree as a host array, named by its path."""
    leaves = jax.tree_util.tree_flatten_with_path(state)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def unflatten(found: dict[str, np.ndarray], like: Any, source: object) -> Any:
    """The state again, in host arrays but for its keys; `like` gives structure and shapes.

    Raises InputError if they differ.
    """
    check(found, like, source)
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    return jax.tree_util.tree_unflatten(structure, [
        _keys(found[jax.tree_util.keystr(path)]) if _is_key(leaf)
        else found[jax.tree_util.keystr(path)] for path, leaf in leaves])


def _keys(words: np.ndarray) -> jax.Array:
    return jax.random.wrap_key_data(jax.numpy.asarray(words))


def check(found: Mapping[str, Any], like: Any, source: object) -> None:
    """Raises InputError unless names, shapes and kinds of numbers are those of the state `like`.

    `found` may be arrays, or what is said of them.
    """
    leaves = jax.tree_util.tree_flatten_with_path(like)[0]
    wanted = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    if set(wanted) != set(found):
        odd = sorted(set(wanted) ^ set(found))[0]
        raise InputError(source, f"a checkpoint of another network: {odd} is in one only")
    for name, leaf in wanted.items():
        held = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        shape, dtype = getattr(found[name], "shape", None), getattr(found[name], "dtype", None)
        if shape != held.shape or dtype != held.dtype:
            raise InputError(
                source, f"a checkpoint of another network: {name} is {dtype}"
                f"{list(shape or ())}, this run needs {held.dtype}{list(held.shape)}")


def checksums(learner: Path) -> dict[str, int]:
    """CRC-32 of every file under the folder.

    Checked before Orbax reads: given a torn file, its threads outlive the error they raise.
    """
    names = sorted(p for p in learner.rglob("*") if p.is_file())
    return {p.relative_to(learner).as_posix(): _checksum(p) for p in names}


def _checksum(path: Path) -> int:
    found = 0
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            found = zlib.crc32(block, found)
    return found


def place_of(folder: Path, total_updates: int) -> Path:
    """Where the checkpoint after so many updates is, or would be."""
    return folder / f"{total_updates:08d}"


def save(folder: Path, state: Any, about: About, keep: Iterable[int] = ()) -> Path:
    """Writes one checkpoint; drops all but the newest few and those after so many updates.

    `state` holds host arrays, keys as `raw` words. Raises InputError if it cannot be written.
    """
    import orbax.checkpoint as ocp  # seconds to import, and only training needs it

    place = place_of(folder, about.total_updates)
    arrays = flatten(state)
    partial = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=folder, prefix=".part-"))
        with _without_tracebacks():
            ocp.PyTreeCheckpointer().save(partial.resolve() / "learner", arrays)
        sums = checksums(partial / "learner")
        files.write_json(partial / "about.json", msgspec.structs.replace(about, files=sums))
        if place.exists():
            shutil.rmtree(place)
        partial.rename(place)
    # tensorstore reports a full disk as ValueError
    except (OSError, ValueError, InputError) as error:
        last = newest(folder)
        kept = f"; the last good checkpoint is {last}" if last else ""
        raise InputError(place, f"checkpoint could not be written: {_why(error)}{kept}") from None
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
    for old in set(_all(folder)[:-KEEP]) - {place_of(folder, updates) for updates in keep}:
        shutil.rmtree(old, ignore_errors=True)
    return place


@contextmanager
def _without_tracebacks() -> Iterator[None]:
    """Orbax logs those of its threads, whose error it raises anyway."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _why(error: Exception) -> str:
    """The last words of an error; tensorstore tells its whole way down to the system's."""
    text = error.problem if isinstance(error, InputError) else str(error)
    head, number, _ = text.splitlines()[0].partition(" [os_error_code")
    return head.rpartition(": ")[2] if number else head


def read(place: Path, expect: Expect | None = None) -> tuple[About, dict[str, np.ndarray]]:
    """This one checkpoint. Raises InputError if it is none, torn, or not what is expected.

    Arrays are read when all is known to be as expected.
    """
    try:
        return _read(place, expect)
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise InputError(place, f"is no whole checkpoint ({_reason(error)}); allowed is a folder "
                         "like RUN/checkpoints/00001000") from None


def newest(folder: Path) -> Path | None:
    """The newest checkpoint's folder, unchecked."""
    return (_all(folder) or [None])[-1]


def load(folder: Path, expect: Expect | None = None
         ) -> tuple[About, dict[str, np.ndarray]] | None:
    """The newest checkpoint that is whole; a torn one is passed over with a warning.

    Raises InputError if that is not what is expected.
    """
    for place in reversed(_all(folder)):
        try:
            return _read(place, expect)
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            warnings.warn(f"{place} is torn and was passed over ({_reason(error)})", stacklevel=2)
    return None


def _read(place: Path, expect: Expect | None) -> tuple[About, dict[str, np.ndarray]]:
    about = msgspec.json.decode((place / "about.json").read_bytes(), type=About)
    like = None if expect is None else expect(about)
    if checksums(place / "learner") != about.files:
        raise ValueError("its checksums do not match")
    arrays = _stored(place.resolve() / "learner")
    if expect is not None:
        check(arrays, like, place)
    return about, {name: np.asarray(one.store.read().result()) for name, one in arrays.items()}


class _Stored(NamedTuple):
    """What is said of an array: a few bytes can stand for terabytes of zeros."""

    shape: tuple[int, ...]
    dtype: np.dtype
    store: Any


def _stored(learner: Path) -> dict[str, _Stored]:
    """The arrays that Orbax wrote, by name, not yet read.

    By its storage alone, one after the other: Orbax reads all at once, and what it leaves behind
    when one of them is wrong complains later. Raises ValueError for what is no array.
    """
    import tensorstore as ts

    base = {"driver": "ocdbt", "base": f"file://{quote(str(learner))}/"}
    store = ts.KvStore.open(base).result()
    found = {}
    for key in store.list().result():
        name, slash, last = key.decode().rpartition("/")
        if not (slash and last == ".zarray"):
            continue
        one = ts.open({"driver": "zarr", "kvstore": base | {"path": f"{name}/"}}).result()
        wide = one.chunk_layout.read_chunk.shape or ()
        if any((chunk or 0) > max(side, 1) for chunk, side in zip(wide, one.shape, strict=True)):
            raise ValueError(f"the parts of {name} are larger than all of it")
        found[name] = _Stored(tuple(one.shape), one.dtype.numpy_dtype, one)
    return found


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _all(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("[0-9]*") if p.is_dir()) if folder.is_dir() else []
