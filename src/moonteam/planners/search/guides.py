"""Guides of local search: the plain one, by hand, and those that were learned."""

from __future__ import annotations

import functools
import math
import os
from pathlib import Path

import numpy as np
import numpy.typing as npt

from moonteam import paths
from moonteam.errors import InputError
from moonteam.planners.search.neighbourhoods import SHAPES, B, G, W

KIND = "guide"
"""Of a policy file that holds a guide."""
BUNDLED = "local_search"
"""The guide that ships."""
Floats = npt.NDArray[np.float64]


def vector_of(parts: dict[str, Floats]) -> Floats:
    """A guide's weights one after the other."""
    return np.concatenate([np.asarray(parts[name], np.float64).reshape(-1) for name in SHAPES])


def parts_of(vector: Floats) -> dict[str, Floats]:
    """A guide's weights by name."""
    out, first = {}, 0
    for name, shape in SHAPES.items():
        stop = first + math.prod(shape)
        out[name] = vector[first:stop].reshape(shape)
        first = stop
    return out


def _plain() -> dict[str, Floats]:
    """Found by trying: anywhere, near one another, along the critical chain, or of one agent."""
    ways, back, place, heat = (np.zeros((k, G)) for k in (W, B, 4, 2))
    back[2, 0] = 0.7  # twice as often in a row as with regret, or as cheapest first
    place[0, 0] = 0.05  # of a step; as noise as much as it is hot, half of the times
    heat[:, 0] = math.log(2.0), math.log(0.3)
    size = np.zeros((W, 3))
    size[:, 0] = math.log(24.0)
    seed = np.zeros((W, 5))
    seed[:, 4] = -8.0, 1.1, 8.0, 1.1  # three in four near a critical one, and all along the chain
    near = np.zeros((W, 9))
    near[0, 7] = 1.0
    near[1, 0] = 1.0
    near[2, :2] = 0.5, 1.0
    near[3, [0, 2, 3]] = 0.1, 1.0, 10.0  # who shares no agent is ten mean ways off
    return {"ways": ways, "size": size, "seed": seed, "near": near, "back": back,
            "row": np.array([1.0, 0.0, 0.0, 0.0, 0.0, 1.0]), "place": place, "heat": heat}


PLAIN = vector_of(_plain())


def load(name: str | os.PathLike[str] = BUNDLED) -> Floats:
    """The vector of a guide's file, or of a bundled guide.

    Raises InputError if it is none.
    """
    path = paths.find(os.fspath(name), "guides", ".safetensors")
    return _read(path, path.stat().st_mtime_ns)


@functools.cache
def _read(path: Path, _changed: int) -> Floats:
    """The vector of a file as it is since then: planners are made anew for every plan."""
    from moonteam.policies.policy_file import check_shapes, load_policy

    stored = load_policy(path)
    if stored.kind != KIND:
        raise InputError(path, f"is a policy of kind {stored.kind!r}; a guide of local search is "
                         "needed, as moonteam train guide makes it")
    check_shapes(path, stored.params, parts_of(PLAIN))
    return vector_of(stored.params)
