"""The soil's forces on one wheel and one foot, apart from any engine."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.physics.regolith import wheel
from moonteam.physics.regolith.bed import bed_of
from moonteam.physics.regolith.forces import Felt, fresh, soil_forces
from moonteam.robots.base import CONTROL_PERIOD, Tread
from moonteam.terrain.soil import SOILS
from moonteam.terrain.surface import Surface

SOIL = SOILS["nominal"]
LOAD, TIP = 6.0, 0.14
WHEEL, FOOT = Tread(0.10, 0.01, True), Tread(0.07, 0.006)
FLAT = Surface(jnp.zeros((41, 41)), 0.25)


def made(tread):
    axis = [[0.0, 1.0, 0.0]] if tread.rolls else [[0.0, 0.0, 0.0]]
    bed = bed_of(SOIL, [tread], np.array([TIP]), np.array(axis), np.array([LOAD]))
    return bed, jax.jit(partial(soil_forces, bed))


def felt(velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), load=LOAD, height=TIP):
    centre = jnp.array([[0.0, 0.0, height]])

    def row(values):
        return jnp.array([values], jnp.float32)

    return Felt(centre, jnp.eye(3)[None], row(spin), row(velocity), centre, centre,
                jnp.array([load]))


def steady(step, told_of, seconds=3.0, surface=FLAT):
    memory = fresh(1)
    for _ in range(round(seconds / CONTROL_PERIOD)):
        forces, memory, told = step(surface, memory, told_of)
    return np.asarray(forces)[0], memory, told


@pytest.mark.parametrize("slip", [0.1, 0.4, 0.8])
def test_a_wheel_that_rolls_steadily_pulls_as_the_table_says(slip):
    _, step = made(WHEEL)
    rate = 0.4 / TIP
    forces, memory, told = steady(step, felt((0.4 * (1 - slip), 0, 0), (0, rate, 0), height=0.12))
    sums = wheel.curves(wheel.Shape(TIP - 0.01, 0.10, 0.01), SOIL, np.array([LOAD]),
                        np.array([slip]))
    assert float(told.slip[0]) == pytest.approx(slip, abs=1e-3)
    assert forces[0] == pytest.approx(LOAD * float(sums.pull[0, 0]), rel=0.02, abs=0.02)
    assert forces[4] == pytest.approx(-LOAD * TIP * float(sums.torque[0, 0]), rel=0.02)
    assert float(memory.depth[0]) == pytest.approx(float(sums.sinkage[0, 0]), rel=0.05)
    assert forces[1] == pytest.approx(0.0, abs=1e-3)
    assert forces[2] == pytest.approx(0.0, abs=1e-5), "the contact carries the weight, not the soil"


def test_it_pulls_back_when_it_is_braked_and_to_the_side_when_it_slides():
    _, step = made(WHEEL)
    braked, _, told = steady(step, felt((0.4, 0, 0), (0, 0.2 / TIP, 0), height=0.12))
    assert float(told.slip[0]) == pytest.approx(-0.5, abs=1e-3)
    assert braked[0] < -0.5
    aside, _, _ = steady(step, felt((0.3, 0.3, 0), (0, 0.3 / TIP, 0), height=0.12))
    assert aside[1] < -0.5 * abs(aside[0]) - 0.5
    assert aside[3] != 0.0, "at the rim, not at the axle"


def test_a_standing_foot_is_held_like_a_spring_until_the_soil_shears():
    _, step = made(FOOT)
    memory, pulls = fresh(1), []
    for _ in range(20):  # the soil takes the load
        _, memory, _ = step(FLAT, memory, felt())
    for _ in range(400):  # dragged by 0.1 m/s for 3.2 s
        forces, memory, _ = step(FLAT, memory, felt((0.1, 0, 0)))
        pulls.append(-float(forces[0, 0]))
    cohesion, tangent = wheel.interface(SOIL, FOOT.grousers)
    strength = LOAD * tangent + cohesion * np.pi * FOOT.width**2 / 4
    assert pulls[5] < 0.3 * strength, "it gives way before it holds"
    assert max(pulls) == pytest.approx(0.95 * strength, rel=0.03)
    for _ in range(100):
        forces, memory, _ = step(FLAT, memory, felt())
    assert -float(forces[0, 0]) > 0.8 * strength, "what is held stays held where nothing moves"


def test_a_lifted_foot_feels_nothing_and_comes_down_on_fresh_soil():
    _, step = made(FOOT)
    _, memory, _ = steady(step, felt((0.05, 0, 0)))
    assert abs(float(memory.moved[0, 0])) > 0.01
    assert float(memory.depth[0]) > 0
    for _ in range(400):
        forces, memory, told = step(FLAT, memory, felt((0.5, 0, 0.3), load=0.0, height=0.5))
    assert np.abs(np.asarray(forces)).max() < 1e-5
    assert float(memory.depth[0]) < 1e-4
    assert float(told.load[0]) < 1e-6


def test_what_stands_on_a_rock_gets_nothing_from_the_soil():
    """A contact that carries, half a metre above the ground."""
    _, step = made(FOOT)
    forces, _, _ = steady(step, felt((0.1, 0, 0), height=0.6))
    assert np.abs(forces).max() < 1e-5


def test_forces_lie_in_the_plane_of_the_ground():
    slope = np.tan(np.radians(15.0))
    x = 0.25 * (np.arange(41) - 20)
    surface = Surface(jnp.asarray(np.tile(slope * x, (41, 1)), jnp.float32), 0.25)
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0)
    _, step = made(FOOT)
    forces, _, _ = steady(step, felt((0.05, 0.03, 0.05 * slope)), surface=surface)
    assert np.linalg.norm(forces[:3]) > 1.0
    assert forces[:3] @ normal == pytest.approx(0.0, abs=1e-4)
