"""Policy files taken apart, and put together wrongly."""

from __future__ import annotations

import json
import struct
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np

from moonteam.policies import entity, pointer, recurrent
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import PolicyFile, save_policy
from tests.fuzz.mutation import Inside, Pairs, harmed, put, tree_of, written

SPECS = {"pointer": (pointer, pointer.PointerSpec(width=4, heads=2, layers=1, pairs=2)),
         "entity": (entity, entity.EntitySpec(width=4, heads=2, layers=1)),
         "recurrent": (recurrent, recurrent.RecurrentSpec(2, 3, (8, 6), width=4))}
PARTS = ("header", "length", "arrays")


def parts(path: Path) -> Pairs:
    """The header as a tree, what is added to its length, and the arrays' bytes."""
    data = path.read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8:8 + length])
    said = Inside(tree_of(json.loads(header["__metadata__"]["moonteam"])))
    header["__metadata__"] = None
    tree = tree_of(header)
    tree[0][1] = Pairs([["moonteam", said]])
    return Pairs([["header", tree], ["length", 0], ["arrays", data[8 + length:].hex()]])


def seeds(folder: Path) -> list[Any]:
    """A small policy of each kind, taken apart."""
    found = []
    for kind, (module, spec) in SPECS.items():
        params = jax.tree.map(
            lambda leaf: np.zeros(leaf.shape, np.float32),
            jax.eval_shape(lambda key, m=module, s=spec: m.init(s, key), jax.random.key(0)))
        path = folder / f"{kind}.safetensors"
        save_policy(path, PolicyFile(kind, asdict(spec), params, {"seed": 1, "rates": [0.1]}, "c"))
        found.append(parts(path))
    return found


def write(folder: Path, tree: Any, harm: int) -> Path:
    """The file of what `parts` took apart, whatever has become of it."""
    held = {key: value for key, value in tree if isinstance(key, str)} \
        if isinstance(tree, Pairs) else {"header": tree}
    header = written(held.get("header")).encode("utf-8", "surrogatepass")
    more = held.get("length")
    length = len(header) + (more if isinstance(more, int) else 0)
    arrays = held.get("arrays")
    try:
        data = bytes.fromhex(arrays) if isinstance(arrays, str) else b""
    except ValueError:
        data = b"\0" * 99
    path = folder / "input.safetensors"
    return put(path, harmed(struct.pack("<Q", length % 2**64) + header + data, harm))


def read(path: Path) -> None:
    """As every command that takes a policy does."""
    found = Policy.load(path)
    again = path.with_name("again.safetensors")
    again.unlink(missing_ok=True)
    save_policy(again, found.source)
    assert Policy.load(again).brain == found.brain
