"""Batches spread over all devices, parameters on each of them.

On a CPU every core is made a device of its own: XLA shares out a big matrix product among
cores, but not the many small operations between, which are most of what a small network costs.

Legend: E environments, or states of a batch; the leading axis that is spread.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from moonteam.errors import InputError
from moonteam.planners.batch import cores


def use_all_cores() -> None:
    """Makes each core a device; without effect once JAX has begun to compute."""
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError:
        return  # somebody computed before: keep the devices there are


def mesh() -> Mesh:
    """All devices in one row."""
    return Mesh(np.array(jax.devices()), ("batch",))


def spread(tree: Any) -> Any:
    """The leading axis of every leaf shared out evenly over the devices."""
    return jax.device_put(tree, NamedSharding(mesh(), PartitionSpec("batch")))


def everywhere(tree: Any) -> Any:
    """Every leaf whole on each device."""
    return jax.device_put(tree, NamedSharding(mesh(), PartitionSpec()))


def check_divides(source: str, key: str, value: int) -> None:
    """Raises InputError if `value` rows cannot be shared out evenly."""
    count = len(jax.devices())
    if value % count:
        raise InputError(source, f"{value} does not divide among {count} devices", key)
