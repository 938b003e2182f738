"""What wheels and feet leave behind in regolith, for the film.

A wheel leaves a mark each time its rim has turned by as much, so that where it slips the marks lie
closer, one over the other, and are darker; a foot leaves one where it stood.

Legend: T logged moments, K marks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from moonteam.physics.regolith.treads import geom_at
from moonteam.physics.render import Marker
from moonteam.robots.base import Tread

Floats = npt.NDArray[np.float64]

EVERY = 0.05
"""m of rim between two marks of a wheel."""

APART = 0.04
"""m between two marks of a foot, at least."""

THICK = 0.004  # m
NEAR = 0.015
"""A tread this near to the ground, m, is in it."""

DARK = (0.07, 0.065, 0.06, 0.14)
STANDING = 0.04
"""Slower than this, m/s, a foot stands."""


class Ruts:
    """Marks in the order in which they were made."""

    def __init__(self, times: Floats, markers: list[Marker]):
        order = np.argsort(times, kind="stable")
        self._times = np.asarray(times)[order]
        self._markers = [markers[k] for k in order]

    def until(self, second: float) -> list[Marker]:
        """Those that are there by then."""
        return self._markers[:int(np.searchsorted(self._times, second, side="right"))]


def ruts_of(model: Any, times: Floats, qpos: npt.NDArray, treads: Mapping[str, Tread],
            height: Callable[[Floats], Floats]) -> Ruts:
    """From a model with tread sites, times [T] s and poses qpos [T, nq]; `treads` by robot."""
    sites = [(s, treads[name.split("/")[0]]) for s in range(model.nsite)
             if "/tread" in (name := model.site(s).name)]
    if not sites:
        return Ruts(np.zeros(0), [])
    ids = [s for s, _ in sites]
    at, turned = _followed(model, np.nan_to_num(qpos), ids)
    when: list[float] = []
    markers: list[Marker] = []
    for c, (site, tread) in enumerate(sites):
        radius = float(model.geom_size[geom_at(model, site), 0])
        low = at[:, c, 2] - height(at[:, c, :2])
        down = low < radius + NEAR
        picked = _wheel(turned[:, c] * radius, down) if tread.rolls else _foot(
            times, at[:, c], down)
        for k in picked:
            when.append(float(times[k]))
            markers.append(_mark(tread, at[max(k - 2, 0):k + 3, c, :2], height))
    return Ruts(np.array(when), markers)


def _followed(model: Any, qpos: npt.NDArray, sites: list[int]) -> tuple[Floats, Floats]:
    """Places [T, C, 3] m of sites, and angles [T, C] rad of their bodies' joints."""
    data = mujoco.MjData(model)
    places = np.empty((len(qpos), len(sites), 3))
    for t, pose in enumerate(qpos):
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        places[t] = data.site_xpos[sites]
    joints = [int(model.body_jntadr[model.site_bodyid[s]]) for s in sites]
    return places, qpos[:, [int(model.jnt_qposadr[j]) for j in joints]]


def _wheel(rim: Floats, down: npt.NDArray[np.bool_]) -> list[int]:
    """Moments at which a rim that has turned by [T] m leaves a mark."""
    gone = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(rim)))])
    step = np.floor(gone / EVERY)
    return [int(k) for k in np.flatnonzero(np.diff(step) > 0) + 1 if down[k]]


def _foot(times: Floats, at: Floats, down: npt.NDArray[np.bool_]) -> list[int]:
    """Moments at which a foot stands somewhere new."""
    speed = np.linalg.norm(np.gradient(at[:, :2], times, axis=0), axis=1)
    picked: list[int] = []
    for k in np.flatnonzero(down & (speed < STANDING)):
        if not picked or np.linalg.norm(at[k, :2] - at[picked[-1], :2]) > APART:
            picked.append(int(k))
    return picked


def _mark(tread: Tread, way: Floats, height: Callable[[Floats], Floats]) -> Marker:
    """Flat on the ground in the middle of a piece of way [n, 2] m."""
    xy = way[len(way) // 2]
    along = way[-1] - way[0]
    length = float(np.hypot(*along))
    along = along / length if length > 1e-6 else np.array([1.0, 0.0])
    reach = 0.1
    rise = (height(xy + reach * along) - height(xy - reach * along)) / (2 * reach)
    aside = np.array([-along[1], along[0]])
    tilt = (height(xy + reach * aside) - height(xy - reach * aside)) / (2 * reach)
    x, y = np.append(along, rise), np.append(aside, tilt)
    x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
    axes = np.stack([x, y, np.cross(x, y)], axis=1)
    place = np.append(xy, float(height(xy)) + THICK / 2)
    half = tread.width / 2
    if tread.rolls:
        return Marker(mujoco.mjtGeom.mjGEOM_BOX, (0.6 * EVERY, half, THICK), place, DARK, axes)
    return Marker(mujoco.mjtGeom.mjGEOM_CYLINDER, (half, THICK, 0.0), place, DARK, axes)
