"""MuJoCo MJX, imported quietly: where Warp is absent it prints two lines on standard output,
which belongs to a command's JSON.
"""

from __future__ import annotations

import contextlib
import io
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import numpy.typing as npt
from jax import Array

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco.mjx import Model, make_data, put_model, step
    from mujoco.mjx._src.collision_driver import geom_pairs, has_collision_fn
    from mujoco.mjx._src.support import contact_force_dim
    from mujoco.mjx._src.types import GeomType

__all__ = ["GeomType", "Model", "geom_pairs", "has_collision_fn", "make_data",
           "normal_forces", "put_model", "step", "without_sensors"]


def without_sensors(model: Model) -> Model:
    """The model with no sensor evaluated: touch sensors cost a third of a step."""
    off = model.opt.disableflags | int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    return model.replace(opt=model.opt.replace(disableflags=off))


def normal_forces(model: Model, data: Any, geoms: npt.NDArray[np.intp]) -> Array:
    """Normal force N of all contacts of each of `geoms` [C], as touch sensors about them say."""
    contact = data._impl.contact
    parts, which = zip(*(contact_force_dim(model, data, dim) for dim in sorted(set(contact.dim))),
                       strict=True)
    normal = jnp.concatenate([part[:, 0] for part in parts])
    pairs = contact.geom[np.concatenate(which)]
    touches = jnp.any(pairs[None] == geoms[:, None, None], axis=-1)
    return jnp.sum(jnp.where(touches, normal, 0.0), axis=1)
