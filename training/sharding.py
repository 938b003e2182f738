"""Batches spread over all devices, parameters on each of them; several hosts count as one.

On a CPU every core is made a device of its own: XLA shares out a big matrix product among
cores, but not the many small operations between, which are most of what a small network costs.

Legend: E environments, or states of a batch; the leading axis that is spread.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from moonteam.compilation import cores
from moonteam.errors import InputError


def use_all_cores() -> None:
    """Makes each core a device, unless JAX_NUM_CPU_DEVICES says how many there are to be.

    Without effect once JAX has begun to compute.
    """
    if "JAX_NUM_CPU_DEVICES" in os.environ:
        return
    try:
        jax.config.update("jax_num_cpu_devices", cores())
    except RuntimeError:
        return  # somebody computed before: keep the devices there are


def devices_here() -> int:
    """JAX devices that `use_all_cores` makes, or leaves."""
    asked = os.environ.get("JAX_NUM_CPU_DEVICES", "")
    return int(asked) if asked.isdecimal() and int(asked) else cores()


def join(coordinator: str, processes: int, process: int) -> None:
    """Makes this process one of several that train together, before anything is computed.

    `coordinator` is host:port of process 0. Raises InputError if they do not come together.
    """
    if not 0 <= process < processes:
        raise InputError("--process", f"{process} is not allowed; 0 to {processes - 1}")
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except (RuntimeError, ValueError) as error:
        raise InputError("--coordinator", f"{coordinator}: {str(error).splitlines()[0]}") from None
    # The first word between devices has to come within half a minute of the others': now, not
    # after each process has compiled in its own time.
    multihost_utils.sync_global_devices("joined")


def mesh_for(rows: Iterable[int]) -> Mesh:
    """As many devices, in one row, as can share out each of these numbers of rows evenly.

    Raises InputError if that leaves out devices of another process.
    """
    devices = jax.devices()
    common = math.gcd(*rows)
    count = max(n for n in range(1, len(devices) + 1) if common % n == 0)
    if jax.process_count() > 1 and count < len(devices):
        raise InputError("num_envs", f"environments and minibatches must divide among "
                         f"{len(devices)} devices; {common} is what all of them divide by")
    return Mesh(np.array(devices[:count]), ("batch",))


def spread(mesh: Mesh, tree: Any) -> Any:
    """The leading axis of every leaf shared out evenly over the devices."""
    return _put(tree, NamedSharding(mesh, PartitionSpec("batch")))


def everywhere(mesh: Mesh, tree: Any) -> Any:
    """Every leaf whole on each device."""
    return _put(tree, NamedSharding(mesh, PartitionSpec()))


@contextmanager
def mesh_of(array: jax.Array) -> Iterator[None]:
    """The devices that `array` is spread over, known to `along` and `whole` inside."""
    found = array.sharding
    if isinstance(found, NamedSharding) and isinstance(found.mesh, Mesh):
        with jax.set_mesh(found.mesh):
            yield
    else:
        yield


def along(tree: Any, axis: int) -> Any:
    """Under jit: shares out this axis of every leaf over the devices of `mesh_of`.

    XLA cannot be left to find out: rows picked at random from a batch that is spread are
    gathered whole, and from there on every device would do the same work.
    """
    return _constrained(tree, PartitionSpec(*[None] * axis, "batch"))


def whole(tree: Any) -> Any:
    """Under jit: every leaf whole on each device of `mesh_of`."""
    return _constrained(tree, PartitionSpec())


def _constrained(tree: Any, spec: PartitionSpec) -> Any:
    if jax.sharding.get_abstract_mesh().empty:
        return tree
    return jax.tree.map(lambda leaf: jax.lax.with_sharding_constraint(leaf, spec), tree)


def _put(tree: Any, sharding: NamedSharding) -> Any:
    """Places every leaf; devices of other processes take only what comes from the host."""
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)

    def place(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(place(jax.random.key_data(leaf)))
        return jax.device_put(np.asarray(leaf), sharding)

    return jax.tree.map(place, tree)


def gather(tree: Any) -> Any:
    """Host arrays, whole, in every process."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    return multihost_utils.process_allgather(tree, tiled=True)


def anywhere(flag: bool) -> bool:
    """Whether it holds in any process; all of them must ask."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array([flag]))))


def describe_device() -> str:
    """Kind and number of the devices that JAX sees."""
    devices = jax.devices()
    return f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform})"
