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

import numpy as np
import safetensors
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import save

from moonteam import files
from moonteam.errors import InputError

FORMAT = "moonteam-policy-1"


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


def load_policy(path: str | os.PathLike[str]) -> PolicyFile:
    """Reads a policy file. Raises InputError if it is missing, torn or of another maker."""
    if not Path(path).exists():
        raise InputError(path, "no such file")
    if Path(path).is_dir():
        raise InputError(path, "is a folder, a policy file is needed")
    try:
        with safetensors.safe_open(os.fspath(path), framework="numpy") as opened:
            text = (opened.metadata() or {}).get("moonteam")
            arrays = {name: opened.get_tensor(name) for name in list(opened.keys())}
    except (safetensors.SafetensorError, OSError) as error:
        raise InputError(path, f"not a policy file (safetensors): {error}") from None
    header = json.loads(text) if text else {}
    if header.pop("format", None) != FORMAT:
        raise InputError(path, f"a safetensors file, but not a policy of format {FORMAT}")
    params = unflatten_dict(arrays, sep="/")
    return PolicyFile(params=params, **header)


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
