"""Checkpoints that survive being killed: whole or not there, and checked when read.

`checkpoints/00000120/` holds `learner/` (Orbax: the trainee's state, such as parameters,
optimiser, environment states, memories, keys) and `about.json` (where in the run, what network, a
checksum of each file). A folder appears under its name only when complete. The number counts
updates over all phases.
"""

from __future__ import annotations

import shutil
import tempfile
import warnings
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import msgspec
import numpy as np

from moonteam import files
from moonteam.errors import InputError

KEEP = 3


class About(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What stands beside the arrays."""

    phase: str
    update: int
    total_updates: int
    env_steps: int
    seconds: float
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
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    if set(names) != set(found):
        odd = sorted(set(names) ^ set(found))[0]
        raise InputError(source, f"a checkpoint of another network: {odd} is in one only")
    return jax.tree_util.tree_unflatten(structure, [
        _leaf(found[name], leaf, name, source)
        for name, (_, leaf) in zip(names, leaves, strict=True)])


def _leaf(array: np.ndarray, like: Any, name: str, source: object) -> Any:
    held = jax.eval_shape(jax.random.key_data, like) if _is_key(like) else like
    if array.shape != held.shape or array.dtype != held.dtype:
        raise InputError(
            source, f"a checkpoint of another network: {name} is "
            f"{array.dtype}{list(array.shape)}, this run needs {held.dtype}{list(held.shape)}")
    return jax.random.wrap_key_data(jax.numpy.asarray(array)) if _is_key(like) else array


def checksums(learner: Path) -> dict[str, int]:
    """CRC-32 of every file under the folder.

    Checked before Orbax reads: given a torn file, its threads outlive the error they raise.
    """
    names = sorted(p for p in learner.rglob("*") if p.is_file())
    return {p.relative_to(learner).as_posix(): zlib.crc32(p.read_bytes()) for p in names}


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
        ocp.PyTreeCheckpointer().save(partial.resolve() / "learner", arrays)
        sums = checksums(partial / "learner")
        files.write_json(partial / "about.json", msgspec.structs.replace(about, files=sums))
        if place.exists():
            shutil.rmtree(place)
        partial.rename(place)
    except (OSError, ValueError) as error:  # tensorstore reports a full disk as ValueError
        last = newest(folder)
        kept = f"; the last good checkpoint is {last}" if last else ""
        problem = str(error).splitlines()[0]
        raise InputError(place, f"checkpoint could not be written: {problem}{kept}") from None
    finally:
        if partial is not None:
            shutil.rmtree(partial, ignore_errors=True)
    for old in set(_all(folder)[:-KEEP]) - {place_of(folder, updates) for updates in keep}:
        shutil.rmtree(old, ignore_errors=True)
    return place


def read(place: Path) -> tuple[About, dict[str, np.ndarray]]:
    """This one checkpoint. Raises InputError if it is none, or torn."""
    try:
        return _read(place)
    except (OSError, ValueError, msgspec.MsgspecError) as error:
        raise InputError(place, f"is no whole checkpoint ({_reason(error)}); allowed is a folder "
                         "like RUN/checkpoints/00001000") from None


def newest(folder: Path) -> Path | None:
    """The newest checkpoint's folder, unchecked."""
    return (_all(folder) or [None])[-1]


def load(folder: Path) -> tuple[About, dict[str, np.ndarray]] | None:
    """The newest checkpoint that is whole; a torn one is passed over with a warning."""
    for place in reversed(_all(folder)):
        try:
            return _read(place)
        except (OSError, ValueError, msgspec.MsgspecError) as error:
            warnings.warn(f"{place} is torn and was passed over ({_reason(error)})", stacklevel=2)
    return None


def _read(place: Path) -> tuple[About, dict[str, np.ndarray]]:
    import orbax.checkpoint as ocp

    about = msgspec.json.decode((place / "about.json").read_bytes(), type=About)
    if checksums(place / "learner") != about.files:
        raise ValueError("its checksums do not match")
    restored = ocp.PyTreeCheckpointer().restore(place.resolve() / "learner")
    return about, {str(name): np.asarray(leaf) for name, leaf in restored.items()}


def _reason(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]


def _all(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("[0-9]*") if p.is_dir()) if folder.is_dir() else []
