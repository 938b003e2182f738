"""The rules of execution: NumPy and JAX say the same, and each says what it means."""

from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from moonteam.grid import env, scenarios
from moonteam.planners.base import Snapshot, solved_now
from sim2grid import waypoints as ways
from sim2grid.frame import Frame, tilt
from sim2grid.loop import rules
from sim2grid.loop.rules import Rules

R, M = 4, 3
RULES, FRAME = Rules(), Frame((5, 4), 2.0)
PROPERTY = settings(max_examples=60, deadline=None, derandomize=True)


def floats(shape, low, high):
    """Multiples of 1/64: the same number in both precisions."""
    return hnp.arrays(np.int64, shape, elements=st.integers(low * 64, high * 64)).map(
        lambda a: a / 64)


def cells(rows=R):
    """A few cells only, so that some are shared."""
    return hnp.arrays(np.int32, (rows, 2), elements=st.integers(0, 2))


def bools(shape):
    return hnp.arrays(bool, shape)


def bits(rows):
    return hnp.arrays(np.int32, rows, elements=st.integers(0, 7))


XY = floats((R, 2), -6, 6)
SECONDS, SPEEDS = floats(R, 0, 20), floats(R, 1, 2)
QUATS = hnp.arrays(np.float64, (3, R, 4), elements=st.integers(-3, 3).map(float))

CASES = {
    "tilted": (lambda q, s: rules.tilted(q, 1.0 + 0.0 * s, s, 0.2), (QUATS, SECONDS)),
    "losses": (partial(rules.losses, RULES, FRAME), (bools(R), SECONDS, XY)),
    "patience": (partial(rules.patience, RULES), (SECONDS, SPEEDS)),
    "near": (partial(rules.near, RULES, FRAME), (XY, XY)),
    "slow_enough": (lambda a, b, v: rules.slow_enough(RULES, a, b, v, 0.25), (XY, XY, SPEEDS)),
    "arrived": (partial(rules.arrived, RULES, FRAME), (XY, XY, cells(), bools(R), SECONDS)),
    "late": (lambda t, limit: rules.late(t[:1], limit), (SECONDS, SECONDS)),
    "stalls": (partial(rules.stalls, RULES), (bits(R), bools(R), bools(R), XY, XY, XY)),
    "stuck": (partial(rules.stuck, RULES), (bools(R), bits(R))),
    "crowded": (partial(rules.crowded, RULES, FRAME), (XY, cells(), cells(), bools(R))),
    "present": (partial(rules.present, FRAME), (XY, cells(), cells(M))),
    "contributing": (rules.contributing, (bools((R, M)), bits(R), bits(M), bools(M))),
    "met": (rules.met, (bools((R, M)), bits(R), bits(M), bools(M))),
    "unsolvable": (rules.unsolvable,
                   (bools((R, M)), bools(R), bits(R), bits(M), bools(M), bools(M))),
    "seen": (rules.seen, (XY, XY)),
    "crowds": (ways.crowds, (cells(), bools(R))),
    "kept": (ways.kept, (cells(), cells(), bools(R), bools(R))),
    "yielding": (ways.yielding, (cells(), cells(), bools(R), bools(R))),
    "slots": (partial(ways.waypoints, FRAME), (cells(), bools(R))),
    "lanes": (partial(ways.waypoints, FRAME), (cells(), bools(R), XY)),
}


@pytest.mark.parametrize("name", CASES)
def test_numpy_and_jax_say_the_same(name):
    rule, drawn = CASES[name]
    compiled = jax.jit(rule)

    @PROPERTY
    @given(st.tuples(*drawn))
    def same(values):
        host = rule(*values)
        with jax.enable_x64(True):
            traced = compiled(*values)
        assert host.shape == traced.shape
        np.testing.assert_allclose(np.asarray(traced), host, rtol=0, atol=1e-9)
        narrow = [v.astype(np.float32) if v.dtype == float else v for v in values]
        single = compiled(*narrow)
        if name != "lanes":  # its two sides can be equally far but for rounding
            np.testing.assert_allclose(np.asarray(single), host, rtol=1e-5, atol=1e-4)

    same()


@PROPERTY
@given(QUATS)
def test_tilt_is_the_angle_of_the_z_axis(quats):
    flat = np.where((quats**2).sum(-1, keepdims=True) > 0, quats, [1.0, 0.0, 0.0, 0.0])
    w, x, y, z = np.moveaxis(flat, -1, 0)
    up = (w * w - x * x - y * y + z * z) / (flat**2).sum(-1)
    np.testing.assert_allclose(np.cos(tilt(flat)), up, atol=1e-7)


@PROPERTY
@given(cells(), bits(R), cells(M), bits(M), bools(M))
def test_solved_means_what_the_grid_means(at, skills, targets, need, both):
    need = np.maximum(need, 1)
    xy = FRAME.centre(at.astype(float))
    met = rules.met(rules.present(FRAME, xy, at, targets), skills, need, both)
    assert met.tolist() == solved_now(at, skills, targets, need, both).tolist()


def test_a_team_meets_a_target_as_in_the_grid_env():
    for seed in range(20):
        problem, at = scenarios.to_problem(scenarios.generate(seed, size=(3, 3), num_targets=2))
        here = rules.present(Frame((3, 3), 1.0), Frame((3, 3), 1.0).centre(at.astype(float)), at,
                             problem.target_cells)
        met = rules.met(here, problem.agent_skills, problem.target_skills, problem.target_and)
        assert met.tolist() == env.meets(problem, at).tolist()


def test_and_needs_all_its_skills_and_names_who_shares_them():
    here = np.ones((3, 2), bool)
    skills, need, both = np.array([1, 2, 4]), np.array([3, 3]), np.array([True, False])
    shares = rules.contributing(here, skills, need, both)
    assert shares.tolist() == [[True, True], [True, True], [False, False]]
    without = rules.contributing(here & (skills != 2)[:, None], skills, need, both)
    assert without.tolist() == [[False, True], [False, False], [False, False]]


def test_on_a_border_a_robot_is_in_no_targets_cell():
    frame, cell = Frame((2, 1), 1.0), np.array([[0, 0]], np.int32)
    past = np.array([[0.03, 0.0]])  # in cell (1, 0), by less than it takes to change cells
    assert frame.settle(past, cell).tolist() == [[0, 0]]
    both = np.array([[0, 0], [1, 0]])
    assert not rules.present(frame, past, cell, both).any()


def test_why_a_robot_is_lost():
    frame, xy = Frame((2, 2), 1.0), np.array([[0.0, 0.0]] * 3 + [[9.0, 0.0], [9.0, 0.0]])
    finite, tilted = np.array([True, True, False, True, True]), np.array([2.0, 2.2, 9, 0, 2.2])
    assert rules.losses(RULES, frame, finite, tilted, xy).tolist() == [
        rules.PRESENT, rules.FALLEN, rules.NOT_A_NUMBER, rules.OFF_THE_MAP, rules.FALLEN]


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_sums_of_looks_mean_the_same_in_both_precisions(precision):
    upright, over = [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]
    quats, limit = np.array([[over, upright]], precision), np.ones(2, precision)
    spent, time_s, looks = np.zeros(2, precision), precision(0.0), 0
    while not (gone := rules.losses(RULES, FRAME, np.ones(2, bool), spent,
                                    np.zeros((2, 2), precision))).any():
        spent = rules.tilted(quats, limit, spent, RULES.chunk_s)
        looks, time_s = looks + 1, precision(time_s + precision(RULES.chunk_s))
        assert rules.late(time_s, np.array([8.0], precision)).tolist() == [False]
    assert (looks, gone.tolist()) == (11, [rules.FALLEN, rules.PRESENT])
    while not rules.late(time_s, np.array([8.0], precision)).all():
        looks, time_s = looks + 1, precision(time_s + precision(RULES.chunk_s))
    assert looks == 40


def test_stuck_is_three_time_outs_in_a_row_without_progress():
    start, point = np.zeros((1, 2)), np.array([[1.0, 0.0]])
    yes, no, count = np.array([True]), np.array([False]), np.zeros(1, int)
    for went, wanted in ((0.1, 1), (0.2, 2), (0.3, 0), (0.1, 1), (0.0, 2), (-0.5, 3)):
        at = np.array([[went, 0.0]])
        count = rules.stalls(RULES, count, yes, no, at, start, point)
        assert count.tolist() == [wanted]
    assert rules.stuck(RULES, yes, count).all()
    assert rules.stalls(RULES, count, no, yes, point, start, point).tolist() == [0]


def test_open_targets_without_a_way_or_a_skill_are_unsolvable(mission):
    start = Snapshot.start(mission(["a legged A 0 0"], ["A OR 3 3"]).scenario())
    reach = np.array([[True]])
    args = (start.agent_skills, start.target_skills, start.target_and, start.solved)
    assert not rules.unsolvable(reach, start.agent_mask, *args).any()
    assert rules.unsolvable(~reach, start.agent_mask, *args).all()
    assert rules.unsolvable(reach, ~start.agent_mask, *args).all()
