"""Cells to metres and back, in NumPy and in JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sim2grid.frame import HYSTERESIS, Frame


def test_centre_of_an_even_and_an_odd_map():
    even, odd = Frame((8, 6), 2.0), Frame((5, 5), 1.0)
    np.testing.assert_allclose(even.centre(np.array([0, 0])), [-7.0, -5.0])
    np.testing.assert_allclose(even.centre(np.array([7, 5])), [7.0, 5.0])
    np.testing.assert_allclose(odd.centre(np.array([2, 2])), [0.0, 0.0])


@settings(max_examples=200, deadline=None)
@given(st.integers(1, 64), st.integers(1, 64), st.floats(0.25, 100.0),
       st.floats(-0.49, 0.49), st.floats(-0.49, 0.49), st.data())
def test_any_point_of_a_cell_maps_back_to_it(width, height, cell_m, dx, dy, data):
    frame = Frame((width, height), cell_m)
    cell = np.array([data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))])
    xy = frame.centre(cell) + np.array([dx, dy]) * cell_m
    np.testing.assert_array_equal(frame.cell(xy), cell)
    assert frame.inside(xy, cell)
    assert not frame.off_map(xy)
    anywhere = np.array([0, 0])
    past = np.abs(cell + np.array([dx, dy])).max() - 0.5 - HYSTERESIS
    assume(abs(past) > 1e-6)
    expected = cell if past > 0 else anywhere
    np.testing.assert_array_equal(frame.settle(xy, anywhere), expected)


def test_jax_and_numpy_agree_on_random_poses_under_jit_and_vmap():
    frame = Frame((32, 20), 1.5)
    rng = np.random.default_rng(0)
    xy = rng.uniform(-30, 30, (500, 2)).astype(np.float32)
    last = rng.integers(0, 20, (500, 2)).astype(np.int32)
    np.testing.assert_array_equal(jax.jit(frame.cell)(jnp.array(xy)), frame.cell(xy))
    np.testing.assert_array_equal(
        jax.vmap(frame.settle)(jnp.array(xy), jnp.array(last)), frame.settle(xy, last))
    np.testing.assert_allclose(
        jax.jit(frame.centre)(jnp.array(last)), frame.centre(last), rtol=1e-6)
    assert frame.settle(xy, last).dtype == np.int32


@pytest.mark.parametrize(("x", "cell"), [
    (0.49, 1), (0.51, 1), (0.549, 1), (0.551, 2),  # to the right out of cell 1 (border at 0.5)
    (-0.51, 1), (-0.549, 1), (-0.551, 0),
])
def test_cell_changes_only_past_the_hysteresis(x, cell):
    frame = Frame((3, 3), 1.0)
    np.testing.assert_array_equal(
        frame.settle(np.array([x, 0.0]), np.array([1, 1])), [cell, 1])


def test_a_robot_on_a_border_does_not_flicker():
    frame = Frame((4, 1), 1.0)
    cell = np.array([1, 0])
    seen = []
    for x in (-0.02, 0.03, -0.01, 0.04, 0.06, 0.03, -0.04, -0.06):
        cell = frame.settle(np.array([x, 0.0]), cell)
        seen.append(int(cell[0]))
    assert seen == [1, 1, 1, 1, 2, 2, 2, 1]


def test_off_the_map_needs_half_a_cell():
    frame = Frame((4, 4), 2.0)
    points = np.array([[4.9, 0.0], [5.1, 0.0], [0.0, -5.1], [-3.9, 3.9]])
    assert frame.off_map(points).tolist() == [False, True, True, False]
    np.testing.assert_array_equal(frame.cell(points[1]), [3, 2])
