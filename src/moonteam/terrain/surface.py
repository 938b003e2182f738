"""The ground as a function: height, normal, slope and boulder tops at (x, y), jittable, batched.

Heights stand on a regular grid, row 0 in the south, column 0 in the west, the site's centre
at the origin. Each square is split into two triangles along the diagonal from its south-west
to its north-east corner, as MuJoCo splits a height field, so what a controller asks is what
the engines collide with (the tests shoot MuJoCo rays at it).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """Elevation samples [ny, nx] in metres, `spacing` metres apart.

    With `which`, heights and tops are those of G sites [G, ny, nx], of which it is that one.
    """

    heights: Array  # [ny, nx] m, float32
    spacing: float = field(metadata={"static": True})  # m
    tops: Array | None = None  # [ny, nx] m, ground or the boulder above it; None: no boulders
    soft: bool = field(default=False, metadata={"static": True})  # whether wheels and feet sink in
    which: Array | None = None  # [] index of a site

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths (x, y) in metres."""
        ny, nx = self.heights.shape[-2:]
        return (nx - 1) * self.spacing / 2, (ny - 1) * self.spacing / 2

    def height(self, xy: Array) -> Array:
        """Ground height [...] m under points xy [..., 2] m; the border's height outside."""
        corner, gradient, offset = self._triangle(self.heights, xy)
        return corner + jnp.sum(gradient * offset, axis=-1)

    def top(self, xy: Array) -> Array:
        """Height [...] m that a flyer must stay above at xy [..., 2] m: ground and boulders."""
        samples = self.heights if self.tops is None else self.tops
        corner, gradient, offset = self._triangle(samples, xy)
        return corner + jnp.sum(gradient * offset, axis=-1)

    def normal(self, xy: Array) -> Array:
        """Unit normal [..., 3] of the triangle under xy [..., 2] m."""
        _, gradient, _ = self._triangle(self.heights, xy)
        return _normal(gradient)

    def slope(self, xy: Array) -> Array:
        """Slope [...] rad of the triangle under xy [..., 2] m."""
        _, gradient, _ = self._triangle(self.heights, xy)
        return jnp.arctan(jnp.linalg.norm(gradient, axis=-1))

    def plane(self, xy: Array, radius: Array | float) -> tuple[Array, Array]:
        """Plane fitted to the ground within `radius` m of xy [..., 2] m.

        Least squares over a ring of eight points and the centre. Returns the plane's height
        at xy [...] m and its unit normal [..., 3]: what a body that wide stands on.
        """
        ring = jnp.asarray(radius, jnp.float32) * _RING  # [8, 2]
        around = self.height(xy[..., None, :] + ring.reshape((1,) * (xy.ndim - 1) + (8, 2)))
        centre = self.height(xy)
        # Least squares for points symmetric about the centre: sum(h * d) / sum(d^2) per axis.
        # Written as a sum: a call of a matrix library costs more than the arithmetic.
        weight = (ring / jnp.sum(ring[:, 0] ** 2)).reshape((1,) * (xy.ndim - 1) + (8, 2))
        gradient = jnp.sum(around[..., None] * weight, axis=-2)
        return (jnp.sum(around, axis=-1) + centre) / 9.0, _normal(gradient)

    def _triangle(self, samples: Array, xy: Array) -> tuple[Array, Array, Array]:
        """The triangle of `samples` under a point: height [...] of the square's south-west
        corner, gradient [..., 2] and the point's offset [..., 2] m from that corner.
        """
        ny, nx = samples.shape[-2:]
        lead = (1,) * (xy.ndim - 1)
        half = jnp.array(self.extent, jnp.float32).reshape((*lead, 2))
        last = jnp.array([nx - 1, ny - 1], jnp.float32).reshape((*lead, 2))
        at = jnp.clip((xy + half) / self.spacing, 0.0, last)
        cell = jnp.minimum(jnp.floor(at), last - 1.0).astype(jnp.int32)
        offset = at - cell
        fx, fy = offset[..., 0], offset[..., 1]
        x, y = cell[..., 0], cell[..., 1]
        # Samples of one site among many are never cut out of them: that would copy them all.
        site = () if self.which is None else (self.which,)
        sw, se = samples[*site, y, x], samples[*site, y, x + 1]
        nw, ne = samples[*site, y + 1, x], samples[*site, y + 1, x + 1]
        south = fx >= fy  # the triangle south-west, south-east, north-east
        gx = jnp.where(south, se - sw, ne - nw)
        gy = jnp.where(south, ne - se, nw - sw)
        gradient = jnp.stack([gx, gy], axis=-1) / self.spacing
        return sw, gradient, offset * self.spacing


_RING = np.array(
    [[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)], np.float32
)
"""Eight unit directions [8, 2]."""


def _normal(gradient: Array) -> Array:
    """Unit normal [..., 3] of a plane with gradient [..., 2]."""
    up = jnp.concatenate([-gradient, jnp.ones_like(gradient[..., :1])], axis=-1)
    return up / jnp.linalg.norm(up, axis=-1, keepdims=True)
