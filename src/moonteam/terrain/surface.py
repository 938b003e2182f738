"""The ground as a function: height, normal and slope at (x, y), jittable and batched.

Heights stand on a regular grid, row 0 in the south, column 0 in the west, the site's centre
at the origin. Each square is split into two triangles as MuJoCo splits a height field, so
what a robot feels is what the engines collide with.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surface:
    """Elevation samples [ny, nx] in metres, `spacing` metres apart."""

    heights: Array  # [ny, nx] m, float32
    spacing: float = field(metadata={"static": True})  # m

    @property
    def extent(self) -> tuple[float, float]:
        """Half widths (x, y) in metres."""
        ny, nx = self.heights.shape
        return (nx - 1) * self.spacing / 2, (ny - 1) * self.spacing / 2

    def height(self, xy: Array) -> Array:
        """Ground height [...] m under points xy [..., 2] m; the border's height outside."""
        corner, gradient, offset = self._triangle(xy)
        return corner + jnp.sum(gradient * offset, axis=-1)

    def normal(self, xy: Array) -> Array:
        """Unit normal [..., 3] of the triangle under xy [..., 2] m."""
        _, gradient, _ = self._triangle(xy)
        up = jnp.concatenate([-gradient, jnp.ones_like(gradient[..., :1])], axis=-1)
        return up / jnp.linalg.norm(up, axis=-1, keepdims=True)

    def slope(self, xy: Array) -> Array:
        """Slope [...] rad of the triangle under xy [..., 2] m."""
        _, gradient, _ = self._triangle(xy)
        return jnp.arctan(jnp.linalg.norm(gradient, axis=-1))

    def _triangle(self, xy: Array) -> tuple[Array, Array, Array]:
        """South-west corner height [...], gradient [..., 2], offset from the corner [..., 2].

        MuJoCo splits a square along the diagonal from its south-west... corner pair
        (x+1, y) to (x, y+1): see mjc_ConvexHField's order of prism vertices.
        """
        ny, nx = self.heights.shape
        half = jnp.array(self.extent)
        last = jnp.array([nx - 1, ny - 1], jnp.float32)
        at = jnp.clip((xy + half) / self.spacing, 0.0, last - 1e-4)
        cell = jnp.floor(at).astype(jnp.int32)
        fx, fy = jnp.moveaxis(at - cell, -1, 0)
        x, y = cell[..., 0], cell[..., 1]
        sw, se = self.heights[y, x], self.heights[y, x + 1]
        nw, ne = self.heights[y + 1, x], self.heights[y + 1, x + 1]
        lower = fx + fy <= 1.0
        gx = jnp.where(lower, se - sw, ne - nw)
        gy = jnp.where(lower, nw - sw, ne - se)
        corner = jnp.where(lower, sw, se + nw - ne)
        gradient = jnp.stack([gx, gy], axis=-1) / self.spacing
        return corner, gradient, jnp.stack([fx, fy], axis=-1) * self.spacing
