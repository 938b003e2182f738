"""Small cases worked out by hand: every reward term, every flag, the observation's layout."""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.errors import InputError
from moonteam.grid.types import Buffer, Problem

UP, DOWN, LEFT, RIGHT, STAY = range(5)
A, B, AB = 1, 2, 3

SLOTS, ROWS = 3, 5  # every case is padded to these, so that one compilation serves all

step = jax.jit(grid.step, static_argnums=0)
reset_to = jax.jit(grid.reset_to, static_argnums=0)
observe_now = jax.jit(grid.observe, static_argnums=0)
available = jax.jit(grid.available)


def wide(rows, length):
    array = np.array(rows)
    return jnp.array(np.pad(array, [(0, length - len(rows)), *[(0, 0)] * (array.ndim - 1)]))


def problem(agents, targets, size=(5, 5), rows=ROWS, slots=SLOTS, **more):
    """Agents are skill masks, targets (cell, skill mask, is AND)."""
    places, needs, both = zip(*targets, strict=True)
    return Problem(
        size=jnp.array(size, jnp.int32),
        agent_skills=wide(agents, rows).astype(jnp.int32),
        agent_kinds=jnp.zeros(rows, jnp.int32),
        agent_mask=jnp.arange(rows) < len(agents),
        target_cells=wide(places, slots).astype(jnp.int32),
        target_skills=wide(needs, slots).astype(jnp.int32),
        target_and=wide(both, slots),
        target_mask=jnp.arange(slots) < len(targets), **more)


@dataclass
class Case:
    """A state, and how much of it is real."""

    state: grid.State
    agents: int
    targets: int

    @property
    def solved(self):
        return self.state.solved[:self.targets]


def start(config, agents, cells, targets, **more):
    state, _ = reset_to(config, problem(agents, targets, **more),
                        wide(cells, ROWS).astype(jnp.int32))
    return Case(state, len(agents), len(targets))


def act(config, case, *actions):
    """One step; what is returned of it is without the padding."""
    r = jax.tree.map(np.asarray, step(config, case.state, wide(actions, ROWS).astype(jnp.int32)))
    n, m = case.agents, case.targets
    assert r.state.solved[m:].all()
    terms = {name: getattr(r.rewards, name)[:n] for name in grid.TERMS}
    return Outcome(r.state, n, m, grid.Rewards(**terms), r.reward[:n], bool(r.terminated),
                   bool(r.truncated), r.true_moves[:n], r.newly_solved[:m])


@dataclass
class Outcome(Case):
    rewards: grid.Rewards
    reward: np.ndarray
    terminated: bool
    truncated: bool
    true_moves: np.ndarray
    newly_solved: np.ndarray

    @property
    def cells(self):
        return self.state.cells[:self.agents]


CONFIG = grid.EnvConfig(max_steps=10, c_ar=0.5)


def test_moves_in_the_papers_order_and_the_border():
    state = start(CONFIG, [A] * 5, [(2, 2)] * 5, [((0, 0), A, False)])
    result = act(CONFIG, state, UP, DOWN, LEFT, RIGHT, STAY)
    assert result.cells.tolist() == [[2, 3], [2, 1], [1, 2], [3, 2], [2, 2]]
    assert result.true_moves.tolist() == [True] * 4 + [False]
    corner = start(CONFIG, [A, A], [(4, 4), (0, 1)], [((0, 0), B, False)])
    result = act(CONFIG, corner, UP, LEFT)
    assert result.cells.tolist() == [[4, 4], [0, 1]]
    assert result.true_moves.tolist() == [False, False]
    np.testing.assert_allclose(result.rewards.SC, [-0.1, -0.1])  # a bump is still a move


def test_approach_is_summed_over_open_targets_that_share_a_skill():
    targets = [((3, 4), A, False), ((0, 2), AB, True), ((4, 0), B, False)]
    state = start(CONFIG, [A, B], [(0, 0), (4, 4)], targets)
    result = act(CONFIG, state, STAY, STAY)
    scale = 1 / (3 * 10)
    first = scale * (math.exp(-0.5 * 5) + math.exp(-0.5 * 2))
    second = scale * (math.exp(-0.5 * math.sqrt(20)) + math.exp(-0.5 * 4))
    np.testing.assert_allclose(result.rewards.AR, [first, second], rtol=1e-6)
    np.testing.assert_allclose(result.rewards.TC, [-0.1, -0.1], rtol=1e-6)
    assert not result.rewards.SC.any()
    assert not result.rewards.WC.any()


def test_or_target_is_solved_by_one_skill_and_everyone_is_rewarded():
    targets = [((1, 0), AB, False), ((4, 4), A, False)]
    state = start(CONFIG, [B, A], [(0, 0), (2, 2)], targets)
    result = act(CONFIG, state, RIGHT, STAY)
    assert result.solved.tolist() == [True, False]
    np.testing.assert_allclose(result.rewards.TR, [0.5, 0.5])
    np.testing.assert_allclose(result.rewards.TB, [0, 0])
    np.testing.assert_allclose(result.rewards.AR, [0, math.exp(-0.5 * math.sqrt(8)) / 20],
                               rtol=1e-6)
    np.testing.assert_allclose(result.rewards.SC, [-0.1, 0])
    np.testing.assert_allclose(result.rewards.TC, [-0.05, -0.05])
    assert not result.terminated
    wanted = 1.0 * result.rewards.AR + 0.5 + 0.3 * result.rewards.SC + 0.5 * -0.05
    np.testing.assert_allclose(result.reward, wanted, rtol=1e-6)


def test_and_target_needs_all_skills_in_the_cell_at_once():
    state = start(CONFIG, [A, B], [(0, 0), (2, 0)], [((1, 0), AB, True)])
    alone = act(CONFIG, state, RIGHT, STAY)
    assert not alone.solved.any()
    assert alone.rewards.WC.tolist() == [0, 0]  # shares a skill: not a wrong cell
    gone = act(CONFIG, alone, LEFT, LEFT)
    assert not gone.solved.any()
    met = act(CONFIG, gone, RIGHT, STAY)
    assert met.solved.all()
    assert met.terminated
    assert not met.truncated
    np.testing.assert_allclose(met.rewards.TB, [1, 1])
    np.testing.assert_allclose(met.rewards.TR, [1, 1])
    np.testing.assert_allclose(met.rewards.AR, [0, 0])
    np.testing.assert_allclose(met.reward, [1 + 0.2 - 0.03, 1.2], rtol=1e-6)
    after = act(CONFIG, met, LEFT, LEFT)
    assert after.solved.all(), "once solved, solved"
    assert after.terminated
    assert not after.rewards.TB.any(), "the bonus comes once"


def test_one_agent_with_all_skills_solves_an_and_target_alone():
    state = start(CONFIG, [AB, A], [(0, 0), (4, 4)], [((1, 0), AB, True)])
    assert act(CONFIG, state, RIGHT, STAY).terminated


def test_wrong_cell_costs_every_step_until_someone_solves_it():
    targets = [((1, 0), A, False), ((4, 4), B, False)]
    state = start(CONFIG, [B, A], [(0, 0), (1, 2)], targets)
    first = act(CONFIG, state, RIGHT, STAY)
    assert first.rewards.WC.tolist() == [-1, 0]
    second = act(CONFIG, first, STAY, DOWN)
    assert second.rewards.WC.tolist() == [-1, 0]
    third = act(CONFIG, second, STAY, DOWN)
    assert third.rewards.WC.tolist() == [0, 0], "solved by the other agent"
    np.testing.assert_allclose(second.reward[0], second.rewards.AR[0] - 0.25 - 0.5 * 0.1, rtol=1e-6)


def test_requirement_that_holds_at_reset_is_solved_at_step_0():
    state = start(CONFIG, [A], [(1, 1)], [((1, 1), AB, False), ((2, 2), A, False)])
    assert state.solved.tolist() == [True, False]
    result = act(CONFIG, state, STAY)
    assert not result.newly_solved.any()
    assert not result.rewards.TR.any()


def test_truncation_is_not_termination():
    config = replace(CONFIG, max_steps=2)
    state = start(config, [A], [(0, 0)], [((2, 0), A, False)])
    first = act(config, state, RIGHT)
    assert (bool(first.terminated), bool(first.truncated)) == (False, False)
    late = act(config, first, STAY)
    assert (bool(late.terminated), bool(late.truncated)) == (False, True)
    just = act(config, first, RIGHT)
    assert (bool(just.terminated), bool(just.truncated)) == (True, False)


def test_phases_and_the_literal_step_cost():
    state = start(CONFIG, [A], [(0, 0)], [((1, 0), A, False)])
    boot = act(CONFIG.phase("bootstrap"), state, RIGHT)
    np.testing.assert_allclose(boot.reward, [1.0])  # TR alone; AR is over, SC, TC, TB are off
    literal = act(replace(CONFIG, literal_step_cost=True), state, RIGHT)
    np.testing.assert_allclose(literal.rewards.SC, [-1])
    np.testing.assert_allclose(literal.reward, [1 + 0.2 - 0.3], rtol=1e-6)


def test_replanning_puts_the_next_target_into_the_slot():
    buffer = Buffer(cells=jnp.array([[4, 4], [3, 0]]), skills=jnp.array([B, AB]),
                    both=jnp.array([False, True]), used=jnp.zeros((), jnp.int32))
    targets = [((1, 0), A, False), ((0, 1), A, False), ((2, 2), A, False)]
    state = start(CONFIG, [A, A], [(0, 0), (0, 0)], targets, buffer=buffer)
    result = act(CONFIG, state, RIGHT, UP)  # two at once: slots 0 and 1, in order
    p = result.state.problem
    assert p.target_cells.tolist() == [[4, 4], [3, 0], [2, 2]]
    assert p.target_skills.tolist() == [B, AB, A]
    assert p.target_and.tolist() == [False, True, False]
    assert result.solved.tolist() == [False, False, False]
    assert result.newly_solved.tolist() == [True, True, False]
    np.testing.assert_allclose(result.rewards.TR, [0.4, 0.4], rtol=1e-6)  # 2 of 3 + 2
    np.testing.assert_allclose(result.rewards.TC, [-3 / 50] * 2, rtol=1e-6)
    near = [(math.exp(-0.5 * math.dist(at, (3, 0))) + math.exp(-0.5 * math.dist(at, (2, 2)))) / 50
            for at in ((1, 0), (0, 1))]
    np.testing.assert_allclose(result.rewards.AR, near, rtol=1e-5)
    assert int(p.buffer.used) == 2
    # The buffer is used up: the third stays solved.
    third = act(CONFIG, act(CONFIG, result, RIGHT, STAY), UP, STAY)
    third = act(CONFIG, third, UP, STAY)
    assert third.solved.tolist() == [False, False, True]
    assert not third.terminated


def observe(agents, cells, targets, **more):
    """Unpadded observations, of a state at reset."""
    raw = more.pop("normalize_positions", True)
    config = replace(CONFIG, normalize_positions=raw)
    arrays = problem(agents, targets, rows=len(agents), slots=len(targets), **more)
    return reset_to(config, arrays, jnp.array(cells, jnp.int32))[1]


def test_observation_layout():
    targets = [((4, 4), AB, True), ((1, 2), B, False)]
    team = [A, B, AB], [(0, 0), (4, 2), (1, 2)]
    own, others = [1.0, 0.5], [0.0, 0.0, 0.25, 0.5]
    relative = [0.0, 0.5, 0.0, 0.0]  # the second is solved at reset
    wanted = [*own, *others, *relative, B, A, AB, AB, B, 1.0, 0.0]
    observation = observe(*team, targets)
    config = grid.EnvConfig(num_agents=3, num_targets=2)
    assert observation.shape == (3, 2 * 3 + 2 * 2 + 3 + 2 + 2) == (3, config.obs_dim)
    np.testing.assert_allclose(observation[1], wanted)
    raw = observe(*team, targets, normalize_positions=False)
    np.testing.assert_allclose(raw[1], [4, 2, 0, 0, 1, 2, 0, 2, 0, 0, *wanted[10:]])


def test_observation_of_an_oblong_map_scales_each_axis():
    observation = observe([A], [(2, 1)], [((4, 0), A, False)], size=(5, 3))
    np.testing.assert_allclose(observation[0], [0.5, 0.5, 0.5, -0.5, A, A, 0])


def test_a_lost_agent_solves_nothing_does_not_move_and_is_not_seen():
    case = start(CONFIG, [A, B], [(0, 0), (4, 4)], [((1, 0), A, False)])
    mask = case.state.problem.agent_mask.at[0].set(False)
    lost = replace(case.state, problem=replace(case.state.problem, agent_mask=mask))
    result = act(CONFIG, Case(lost, 2, 1), RIGHT, STAY)
    assert result.cells.tolist() == [[0, 0], [4, 4]]
    assert not result.solved.any()
    assert result.rewards.SC.tolist() == [0, 0]
    assert available(lost)[:2].tolist() == [[False, False, False, False, True],
                                                 [False, True, True, False, True]]
    seen = observe_now(CONFIG, replace(lost, cells=lost.cells.at[0].set(3)))[1]
    first_other, its_skills = seen[2:4], seen[2 * ROWS + 2 * SLOTS + 1]
    assert not first_other.any()
    assert its_skills == 0


def test_available_actions_are_those_that_are_not_turned_back():
    passable = jnp.ones((1, 5, 5), bool).at[0, 1, 0].set(False)
    state = start(CONFIG, [A, A], [(0, 0), (2, 4)], [((1, 3), A, False)], passable=passable)
    assert available(state.state)[:2].tolist() == [[False, False, False, True, True],
                                              [False, True, True, True, True]]
    result = act(CONFIG, state, UP, UP)
    assert result.cells.tolist() == [[0, 0], [2, 4]]
    np.testing.assert_allclose(result.rewards.SC, [-0.1, -0.1])


def test_the_presets_are_the_papers():
    config = grid.preset_config("pi_7t", "bootstrap")
    assert (config.num_agents, config.num_targets, config.width, config.height) == (3, 7, 32, 32)
    assert (config.c_ar, config.max_steps, config.num_buffer) == (0.04, 128, 0)
    assert config.weights == grid.RewardWeights(AR=1.0, TR=1.0, WC=0.25, SC=0.0, TC=0.0, TB=0.0)
    assert grid.preset_config("pi_5t").weights == grid.RewardWeights(1.0, 1.0, 0.25, 0.3, 0.5, 0.2)
    assert {n: p.c_ar for n, p in grid.PRESETS.items()} == {
        "pi_5t": 0.0075, "pi_6t": 0.0075, "pi_7t": 0.04, "pi_5t5r": 0.0075}
    assert grid.preset_config("pi_5t5r").num_buffer == 5
    assert hash(config) == hash(grid.preset_config("pi_7t", "bootstrap"))


@pytest.mark.parametrize(("changes", "said"), [
    ({"num_skills": 9}, "num_skills: 9 is not in 1..8"),
    ({"num_agents": 0}, "num_agents: 0 is not allowed; at least 1"),
    ({"num_buffer": -1}, "num_buffer: -1 is not allowed; at least 0"),
])
def test_impossible_configs_say_so(changes, said):
    with pytest.raises(InputError, match=said):
        grid.EnvConfig(**changes)


def test_impossible_phases_presets_and_maps_say_so():
    with pytest.raises(InputError, match="'warmup' is not one of bootstrap, refinement"):
        grid.RewardWeights().phase("warmup")
    with pytest.raises(InputError, match="'pi_9t' is not one of pi_5t, pi_6t, pi_7t, pi_5t5r"):
        grid.preset("pi_9t")
    with pytest.raises(InputError, match="4 targets leave no free cell on a map of 2 x 2"):
        grid.sample(grid.EnvConfig(num_targets=4, width=2, height=2), jax.random.key(0))
