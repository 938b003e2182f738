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
    points = waypoints(FRAME, [(2, 2), (2, 2)], [True, True], at)
    right = 2.0 * LANE * np.array([way[1], -way[0]])
    np.testing.assert_allclose(points[comer], right)
    np.testing.assert_allclose(points[1 - comer], -right)
    assert FRAME.inside(points, np.full((2, 2), 2)).all()


def test_who_stands_on_the_right_already_stays_there():
    at = np.array([[-2.0, 0.0], [0.0, -0.6]])
    points = waypoints(FRAME, [(2, 2), (2, 2)], [True, True], at)
    np.testing.assert_allclose(points, [[0.0, 0.6], [0.0, -0.6]])


def test_two_that_pass_on_from_their_sides_never_come_near():
    """From a shared cell of 1 m, one goes on east, the other west."""
    frame = Frame((5, 5), 1.0)
    sides = waypoints(frame, [(2, 2), (2, 2)], [True, True], np.array([[-1.0, 0], [0, 0]]))
    ends = np.array([[1.0, 0.0], [-1.0, 0.0]])
    for share in np.linspace(0, 1, 50):
        both = sides + share * (ends - sides)
        assert np.hypot(*(both[0] - both[1])) > 0.52, "hulls of 0.32 and 0.2 m"


def test_three_have_quarters_and_flyers_the_centre():
    goals = [(2, 2)] * 4
    points = waypoints(FRAME, goals, [True, True, False, True], np.zeros((4, 2)))
    apart = np.linalg.norm(points[[0, 0, 1]] - points[[1, 3, 3]], axis=1)
    assert (apart > 0.8).all()
    np.testing.assert_allclose(points[2], CENTRE)
    assert crowds(goals, [True, True, False, True]) == [[0, 1, 3]]
    assert crowds([(0, 0), (0, 1), (0, 0)], [True, True, False]) == []


def test_of_two_that_change_places_one_waits():
    ground = [True, True]
    assert yielding([(1, 0), (0, 0)], [(0, 0), (1, 0)], [0, 1], ground) == [1]
    assert yielding([(1, 0), (0, 0)], [(0, 0), (1, 0)], [0], ground) == [0], "the other is going"
    assert yielding([(1, 0), (0, 0)], [(0, 0), (1, 0)], [0, 1], [True, False]) == []
    assert yielding([(1, 0), (2, 0)], [(0, 0), (1, 0)], [0, 1], ground) == [], "one follows"
    assert yielding([(0, 0), (0, 0)], [(0, 0), (0, 0)], [0, 1], ground) == [], "they stand"
