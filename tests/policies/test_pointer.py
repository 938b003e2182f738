"""What the pointer network sees of coalitions."""

import jax.numpy as jnp
import numpy as np

from moonteam.grid.macro import world
from moonteam.grid.macro.types import FAR, plain
from moonteam.policies.pointer import LONG, look, together


def test_together_is_the_time_of_the_last_who_is_needed():
    rng = np.random.default_rng(0)
    times = rng.integers(0, 5, (3, 6, 4, 2)).astype(np.float32)  # with many that are equal
    count = rng.integers(0, 8, (3, 4, 2))
    found = np.asarray(together(jnp.asarray(times), jnp.asarray(count), LONG))
    for b, m, s in np.ndindex(count.shape):
        order, need = np.sort(times[b, :, m, s]), count[b, m, s]
        assert found[b, m, s] == (LONG if need > 6 else order[max(need, 1) - 1])


def test_who_waits_is_free_when_the_whole_coalition_can_have_been_there():
    """Three of four robots are needed: one is there, the others are 2, 5 and 9 s away."""
    ways = np.array([[0.0], [2.0], [5.0], [9.0]], np.float32)
    problem = plain(ways, np.zeros((4, 1, 1), np.float32), np.ones((4, 1), bool),
                    np.array([[3]], np.int32), np.zeros(1, bool), limit=np.float32(FAR),
                    agent_mask=np.ones(4, bool), target_mask=np.ones(1, bool),
                    unit=np.float32(1.0))
    state = world.reset(problem)
    first = world.step(state, jnp.array([0, 1, 1, 1], jnp.int32)).state
    view = look(first, jnp.zeros(()))
    assert view.lacks.tolist() == [[2]]
    assert view.spare.tolist() == [5.0, 0.0, 0.0, 0.0]
