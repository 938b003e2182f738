"""MuJoCo MJX, imported quietly: where Warp is absent it prints two lines on standard output,
which belongs to a command's JSON.
"""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco.mjx import Model, make_data, put_model, step
    from mujoco.mjx._src.collision_driver import geom_pairs, has_collision_fn
    from mujoco.mjx._src.types import GeomType

__all__ = ["GeomType", "Model", "geom_pairs", "has_collision_fn", "make_data", "put_model", "step"]
