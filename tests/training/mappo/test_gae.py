"""Hand numbers: gamma 0.5, lambda 0.5, so that all of them are exact in binary."""

import jax.numpy as jnp
import numpy as np

from training.mappo import gae

REWARDS = jnp.array([1.0, 2.0, 4.0])
VALUES = jnp.array([8.0, 16.0, 32.0])
FALSE = jnp.zeros(3, bool)


def run(terminated, truncated, next_values):
    return gae.advantages(REWARDS, VALUES, jnp.asarray(next_values), jnp.asarray(terminated),
                          jnp.asarray(truncated), 0.5, 0.5)


def test_without_an_end():
    # deltas: 1 + 8 - 8 = 1, 2 + 16 - 16 = 2, 4 + 32 - 32 = 4; factor 1/4
    np.testing.assert_array_equal(run(FALSE, FALSE, [16.0, 32.0, 64.0]), [1.75, 3.0, 4.0])


def test_termination_drops_the_value_of_what_follows():
    # delta_1 = 2 - 16 = -14, and nothing flows back from step 2
    ended = FALSE.at[1].set(True)
    np.testing.assert_array_equal(run(ended, FALSE, [16.0, 32.0, 64.0]), [1 - 14 / 4, -14.0, 4.0])


def test_truncation_keeps_the_value_of_the_final_observation():
    # the episode was cut off in a state of value 100: delta_1 = 2 + 50 - 16 = 36
    cut = FALSE.at[1].set(True)
    following = gae.successor_values(VALUES, jnp.array(64.0), jnp.array(100.0), cut)
    np.testing.assert_array_equal(following, [16.0, 100.0, 64.0])
    np.testing.assert_array_equal(run(FALSE, cut, following), [1 + 36 / 4, 36.0, 4.0])
