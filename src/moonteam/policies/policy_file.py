"""A shipped policy: one safetensors file whose header says what it is.

Header (JSON under the key `moonteam`): format, network kind, its config, the training
recipe and the commit it was trained at. Parameters are stored under slash-joined paths.
"""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import safetensors
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import save

from moonteam import files
from moonteam.errors import InputError
from moonteam.strict import json_value

FORMAT = "moonteam-policy-1"
MOST_BYTES = 256 << 20
"""Of a file."""


@dataclass(frozen=True)
class PolicyFile:
    """A policy as stored: `config` builds the network `kind`; `params` are its arrays."""

    kind: str
    config: dict[str, Any]
    params: dict[str, Any]
    recipe: dict[str, Any] = field(default_factory=dict)
    commit: str = ""


def save_policy(path: str | os.PathLike[str], policy: PolicyFile) -> None:
    """Writes the file, whole or not at all."""
    header = {f.name: getattr(policy, f.name) for f in dataclasses.fields(policy)
              if f.name != "params"}
    flat = flatten_dict(policy.params, sep="/")
    arrays = {str(name): np.ascontiguousarray(np.asarray(leaf)) for name, leaf in flat.items()}
    data = save(arrays, {"moonteam": json.dumps({"format": FORMAT} | header, sort_keys=True)})
    with files.replacing(path) as temporary:
        temporary.write_bytes(data)


class _Header(msgspec.Struct, forbid_unknown_fields=True):
    """Under the key `moonteam`."""

    format: str
    kind: str
    config: dict[str, Any]
    recipe: dict[str, Any] = {}
    commit: str = ""


def load_policy(path: str | os.PathLike[str]) -> PolicyFile:
    """Reads a policy file. Raises InputError if it is missing, torn or of another maker.

    Its arrays take no more memory than the file has bytes, which are bounded.
    """
    if not Path(path).exists():
        raise InputError(path, "no such file")
    if not Path(path).is_file():
        raise InputError(path, "is a folder, a policy file is needed" if Path(path).is_dir()
                         else "is no file")
    if (size := Path(path).stat().st_size) > MOST_BYTES:
        raise InputError(path, f"not a policy file: {size:,} bytes; at most {MOST_BYTES:,}")
    _check_header(path, size)
    try:
        with safetensors.safe_open(os.fspath(path), framework="numpy") as opened:
            header = _header(path, opened.metadata() or {})
            arrays = {name: _array(path, opened, name) for name in list(opened.keys())}
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(path, f"not a policy file (safetensors): {error}") from None
    return PolicyFile(header.kind, header.config, _nested(path, arrays), header.recipe,
                      header.commit)


def _check_header(path: str | os.PathLike[str], size: int) -> None:
    """Raises InputError for a name given twice; what else is wrong, safetensors says itself."""
    with Path(path).open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        text = file.read(length) if length <= size else b""
    if text:
        json_value(text.decode("utf-8", "replace"), path, "header")


def _header(path: object, metadata: dict[str, str]) -> _Header:
    text = metadata.get("moonteam")
    value = json_value(text, path, "moonteam") if text else {}
    if not isinstance(value, dict) or value.get("format") != FORMAT:
        raise InputError(path, f"a safetensors file, but not a policy of format {FORMAT}")
    return files.convert(value, _Header, path, "moonteam")


def _array(path: object, opened: Any, name: str) -> np.ndarray:
    """One parameter. Raises InputError unless all of it are numbers of 32 bits."""
    if (kind := opened.get_slice(name).get_dtype()) != "F32":
        raise InputError(path, f"parameter {name} is stored as {kind}; F32 is needed")
    array = opened.get_tensor(name)
    if not np.isfinite(array).all():
        raise InputError(path, f"parameter {name} is not all numbers")
    return array


def _nested(path: object, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The tree of names with slashes. Raises InputError where an array is a branch too."""
    for name in arrays:
        parts = name.split("/")
        for branch in ("/".join(parts[:n]) for n in range(1, len(parts))):
            if branch in arrays:
                raise InputError(path, f"parameter {branch} is there, and {name} too")
    return unflatten_dict(arrays, sep="/")


def check_shapes(path: object, found: dict, wanted: dict) -> None:
    """Raises InputError naming the first parameter that is missing, unknown or misshapen.

    `wanted` is a tree of arrays or `jax.ShapeDtypeStruct`s.
    """
    have: dict[str, Any] = dict(flatten_dict(found, sep="/"))
    want: dict[str, Any] = dict(flatten_dict(wanted, sep="/"))
    for name in sorted({*map(str, have), *map(str, want)}):
        if name not in have or name not in want:
            what = "is missing" if name not in have else "does not belong to this network"
            raise InputError(path, f"parameter {name} {what}")
        if tuple(have[name].shape) != tuple(want[name].shape):
            raise InputError(path, f"parameter {name} has shape {list(have[name].shape)}, this "
                             f"network needs {list(want[name].shape)}")
