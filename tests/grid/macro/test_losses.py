"""Robots lost in the macro world: they leave the team, and what they served is broken off."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR, plain

reset, step = jax.jit(world.reset), jax.jit(world.step)


def team(has, need, start, lost, **changes):
    """Targets all at one place: `start` s from each robot, from one to the next none."""
    has, need = np.array(has, bool), np.array(need, np.int32)
    robots, targets = len(has), len(need)
    begin = np.tile(np.array(start, np.float32)[:, None], (1, targets))
    made = plain(begin, np.zeros((robots, targets, targets), np.float32), has, need,
                 np.zeros(targets, bool), limit=np.float32(200.0), agent_mask=np.ones(robots, bool),
                 target_mask=np.ones(targets, bool), unit=np.float32(1.0))
    return replace(made, lost=np.array(lost, np.float32), **changes)


def test_who_is_lost_on_the_way_leaves_the_others_to_decide():
    first = reset(team([[1], [1]], [[1]], [10.0, 20.0], [4.0, FAR]))
    assert first.problem.agent_mask.all()
    then = step(first, np.array([0, 1], np.int32))
    assert float(then.state.now) == pytest.approx(4.0)
    assert then.state.problem.agent_mask.tolist() == [False, True]
    assert world.free(then.state).tolist() == [False, True]
    end = step(then.state, np.array([1, 0], np.int32))
    assert bool(end.terminated)
    assert float(end.state.now) == pytest.approx(24.0)


def test_a_service_is_broken_off_and_goes_on_when_another_has_come():
    both = team([[1, 0], [0, 1], [0, 1]], [[1, 1]], [2.0, 2.0, 10.0], [FAR, 4.0, FAR],
                service=np.array([5.0], np.float32))
    broken = step(reset(both), np.array([0, 0, 1], np.int32))
    assert float(broken.state.now) == pytest.approx(4.0)
    assert broken.state.serving.tolist() == [False]
    assert world.free(broken.state).tolist() == [False, False, True], "the first waits there"
    end = step(broken.state, np.array([1, 1, 0], np.int32))
    assert bool(end.terminated)
    assert float(end.state.now) == pytest.approx(4.0 + 10.0 + 5.0)


def test_without_anybody_who_can_it_is_over():
    end = step(reset(team([[1], [0]], [[1]], [10.0, 1.0], [4.0, FAR])),
               np.array([0, 1], np.int32))
    state = end.state
    for _ in range(3):
        if not bool(end.truncated):
            end = step(state, np.array([1, 1], np.int32))
            state = end.state
    assert bool(end.truncated)
    assert not bool(end.terminated)


def test_a_loss_after_everything_is_done_is_none():
    end = step(reset(team([[1]], [[1]], [3.0], [9.0])), np.array([0], np.int32))
    assert bool(end.terminated)
    assert float(end.seconds) == pytest.approx(3.0)
