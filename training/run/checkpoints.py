"""Checkpoints that survive being killed: whole or not there, and checked when read.

`checkpoints/00000120/` holds `learner/` (Orbax: parameters, optimiser, environment states,
memory, key, update) and `about.json` (where in the run, what network, a checksum of each
file). A folder appears under its name only when complete. The number counts updates over all
phases.
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
from training.mappo.update import Learner

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


def flatten(learner: Learner) -> dict[str, np.ndarray]:
    """Every leaf as a host array, named by its path; the key already as its raw words."""
    leaves = jax.tree_util.tree_flatten_with_path(learner)[0]
    return {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in leaves}


def unflatten(found: dict[str, np.ndarray], like: Learner, source: object) -> Learner:
    """The learner again; `like` gives structure and shapes. Raises InputError if they differ."""
    raw = like._replace(key=jax.eval_shape(jax.random.key_data, like.key))
    leaves, structure = jax.tree_util.tree_flatten_with_path(raw)
    names = [jax.tree_util.keystr(path) for path, _ in leaves]
    if set(names) != set(found):
        odd = sorted(set(names) ^ set(found))[0]
        raise InputError(source, f"a checkpoint of another network: {odd} is in one only")
    for name, (_, leaf) in zip(names, leaves, strict=True):
        if found[name].shape != leaf.shape or found[name].dtype != leaf.dtype:
            raise InputError(
                source, f"a checkpoint of another network: {name} is "
                f"{found[name].dtype}{list(found[name].shape)}, this run needs "
                f"{leaf.dtype}{list(leaf.shape)}")
    whole = jax.tree_util.tree_unflatten(structure, [jax.numpy.asarray(found[n]) for n in names])
    return whole._replace(key=jax.random.wrap_key_data(whole.key))


def checksums(learner: Path) -> dict[str, int]:
    """CRC-32 of every file under the folder.

    Checked before Orbax reads: given a torn file, its threads outlive the error they raise.
    """
    names = sorted(p for p in learner.rglob("*") if p.is_file())
    return {p.relative_to(learner).as_posix(): zlib.crc32(p.read_bytes()) for p in names}


def place_of(folder: Path, total_updates: int) -> Path:
    """Where the checkpoint after so many updates is, or would be."""
    return folder / f"{total_updates:08d}"


def save(folder: Path, learner: Learner, about: About, keep: Iterable[int] = ()) -> Path:
    """Writes one checkpoint; drops all but the newest few and those after so many updates.

    `learner` holds host arrays, its key as raw words. Raises InputError if it cannot be written.
    """
    import orbax.checkpoint as ocp  # seconds to import, and only training needs it

    place = place_of(folder, about.total_updates)
    arrays = flatten(learner)
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
