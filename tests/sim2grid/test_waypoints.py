"""Places of robots that share a cell, and who waits."""

import numpy as np
import pytest

from sim2grid.frame import Frame
from sim2grid.waypoints import LANE, crowds, waypoints, yielding

FRAME = Frame((5, 5), 2.0)
CENTRE = np.zeros(2)  # of cell (2, 2)


@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1)])
@pytest.mark.parametrize("comer", [0, 1])
def test_who_comes_keeps_right_of_who_stands(way, comer):
    way = np.array(way, float)
    at = np.zeros((2, 2))
    at[comer] = -2.0 * way
    points = waypoints(FRAME, np.array([(2, 2), (2, 2)]), np.ones(2, bool), at)
    right = 2.0 * LANE * np.array([way[1], -way[0]])
    np.testing.assert_allclose(points[comer], right)
    np.testing.assert_allclose(points[1 - comer], -right)
    assert FRAME.inside(points, np.full((2, 2), 2)).all()


def test_who_stands_on_the_right_already_stays_there():
    at = np.array([[-2.0, 0.0], [0.0, -0.6]])
    points = waypoints(FRAME, np.array([(2, 2), (2, 2)]), np.ones(2, bool), at)
    np.testing.assert_allclose(points, [[0.0, 0.6], [0.0, -0.6]])


def test_two_that_pass_on_from_their_sides_never_come_near():
    """From a shared cell of 1 m, one goes on east, the other west."""
    frame = Frame((5, 5), 1.0)
    sides = waypoints(frame, np.array([(2, 2), (2, 2)]), np.ones(2, bool),
                      np.array([[-1.0, 0], [0, 0]]))
    ends = np.array([[1.0, 0.0], [-1.0, 0.0]])
    for share in np.linspace(0, 1, 50):
        both = sides + share * (ends - sides)
        assert np.hypot(*(both[0] - both[1])) > 0.52, "hulls of 0.32 and 0.2 m"


def test_three_have_quarters_and_flyers_the_centre():
    goals, grounded = np.array([(2, 2)] * 4), np.array([True, True, False, True])
    points = waypoints(FRAME, goals, grounded, np.zeros((4, 2)))
    apart = np.linalg.norm(points[[0, 0, 1]] - points[[1, 3, 3]], axis=1)
    assert (apart > 0.8).all()
    np.testing.assert_allclose(points[2], CENTRE)
    assert (crowds(goals, grounded) == grounded[:, None] & grounded[None]).all()
    apart = crowds(np.array([(0, 0), (0, 1), (0, 0)]), np.array([True, True, False]))
    assert (apart == np.diag([True, True, False])).all()


def test_of_two_that_change_places_one_waits():
    def waits(goals, cells, free=(True, True), grounded=(True, True)):
        return yielding(*map(np.array, (goals, cells, free, grounded))).nonzero()[0].tolist()

    assert waits([(1, 0), (0, 0)], [(0, 0), (1, 0)]) == [1]
    assert waits([(1, 0), (0, 0)], [(0, 0), (1, 0)], (True, False)) == [0], "the other is going"
    assert waits([(1, 0), (0, 0)], [(0, 0), (1, 0)], grounded=(True, False)) == []
    assert waits([(1, 0), (2, 0)], [(0, 0), (1, 0)]) == [], "one follows"
    assert waits([(0, 0), (0, 0)], [(0, 0), (0, 0)]) == [], "they stand"
