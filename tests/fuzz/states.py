"""Checkpoints whose parts are wrong though their checksums are right."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np

from tests.fuzz.mutation import Inside, Pairs, harmed, tree_of, written
from training.run import checkpoints
from training.run.checkpoints import About

STATE = {"params": {"w": np.ones((3, 4), np.float32), "b": np.arange(5, dtype=np.int32)},
         "count": np.float32(2)}
ABOUT = About("start", 1, 1, 8, 0.5, {}, {"width": 3})


def seeds(folder: Path) -> list[Any]:
    """One small checkpoint: what it says of itself, and its files."""
    state = checkpoints.raw({**STATE, "key": jax.random.key(3)})
    place = checkpoints.save(folder / "made", state, ABOUT)
    found = Pairs()
    for path in sorted((place / "learner").rglob("*")):
        if path.is_file():
            text = path.read_bytes()
            found.append([path.relative_to(place).as_posix(),
                          Inside(tree_of(json.loads(text))) if text[:1] == b"{" else text.hex()])
    about = json.loads((place / "about.json").read_text())
    return [Pairs([["about", tree_of({**about, "files": "right"})], ["files", found]])]


def write(folder: Path, tree: Any, harm: int) -> Path:
    """A checkpoint's folder; `files` that still says "right" is made so."""
    place = folder / "00000001"
    shutil.rmtree(place, ignore_errors=True)
    (place / "learner").mkdir(parents=True)
    held = {key: value for key, value in tree if isinstance(key, str)} \
        if isinstance(tree, Pairs) else {}
    listed = held.get("files")
    listed = listed if isinstance(listed, list) else ()
    pieces = [pair for pair in listed if isinstance(pair, list) and len(pair) == 2
              and isinstance(pair[0], str) and pair[0].startswith("learner/")]
    for number, (name, content) in enumerate(pieces):
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = harm % max(1, len(pieces)) != number
        path.write_bytes(_bytes(content) if whole else harmed(_bytes(content), harm))
    about = written(held.get("about")).encode("utf-8", "surrogatepass")
    sums = json.dumps(checkpoints.checksums(place / "learner")).encode()
    (place / "about.json").write_bytes(about.replace(b'"files": "right"', b'"files": ' + sums))
    return place


def _bytes(content: Any) -> bytes:
    try:
        return bytes.fromhex(content)
    except (TypeError, ValueError):
        tree = content.tree if isinstance(content, Inside) else content
        return written(tree).encode("utf-8", "surrogatepass")


def read(place: Path) -> None:
    """As a run that begins there does."""
    like = {**STATE, "key": jax.random.key(0)}
    _, arrays = checkpoints.read(place, lambda about: like)
    state = checkpoints.unflatten(arrays, like, place)
    assert state["params"]["w"].shape == (3, 4)
