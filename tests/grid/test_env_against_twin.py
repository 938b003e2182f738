"""The environment against a slow plain-Python twin of its rules, rewards and observation."""

import math
import random
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from moonteam import grid
from moonteam.grid.types import Buffer, Problem

MOVES = {0: (0, 1), 1: (0, -1), 2: (-1, 0), 3: (1, 0), 4: (0, 0)}
TERMS = ("AR", "TR", "WC", "SC", "TC", "TB")


@dataclass
class Goal:
    at: tuple[int, int]
    skills: frozenset[int]
    every: bool
    solved: bool = False


@dataclass
class Twin:
    """Written from the table of rules alone; sets and loops, no arrays."""

    size: tuple[int, int]
    positions: list[tuple[int, int]]
    skills: list[frozenset[int]]
    goals: list[Goal]
    later: list[Goal] = field(default_factory=list)
    closed: list[set[tuple[int, int]]] | None = None  # one an agent
    max_steps: int = 128
    c_ar: float = 0.0075
    literal: bool = False
    raw: bool = False
    step_count: int = 0

    def __post_init__(self):
        self.total = len(self.goals) + len(self.later)
        for goal in self.goals:
            goal.solved = self.is_met(goal)

    def is_met(self, goal):
        team = [s for at, s in zip(self.positions, self.skills, strict=True) if at == goal.at]
        if goal.every:
            return goal.skills <= frozenset().union(*team)
        return any(s & goal.skills for s in team)

    def walk(self, agent, action):
        x, y = self.positions[agent]
        dx, dy = MOVES[action]
        goal = (x + dx, y + dy)
        if not (0 <= goal[0] < self.size[0] and 0 <= goal[1] < self.size[1]):
            return False
        if action == 4 or (self.closed and goal in self.closed[agent]):
            return False
        self.positions[agent] = goal
        return True

    def step(self, actions):
        walked = [self.walk(i, a) for i, a in enumerate(actions)]
        self.step_count += 1
        met = [not g.solved and self.is_met(g) for g in self.goals]
        for j, just in enumerate(met):
            if just:
                self.goals[j].solved = True
                if self.later:
                    self.goals[j] = self.later.pop(0)
        done = all(g.solved for g in self.goals)
        rewards = self.rewards(actions, sum(met), done)
        truncated = self.step_count >= self.max_steps and not done
        return rewards, done, truncated, walked, met

    def rewards(self, actions, num_met, done):
        terms = {name: [] for name in TERMS}
        open_goals = [g for g in self.goals if not g.solved]
        for at, skills, action in zip(self.positions, self.skills, actions, strict=True):
            shared = [g for g in open_goals if g.skills & skills]
            approach = sum(math.exp(-self.c_ar * math.dist(at, g.at)) for g in shared)
            wrong = sum(g.at == at and not g.skills & skills for g in open_goals)
            cost = 0.0 if action == 4 else 1.0 if self.literal else 1.0 / self.max_steps
            terms["AR"].append(approach / (self.total * self.max_steps))
            terms["TR"].append(num_met / self.total)
            terms["WC"].append(-float(wrong))
            terms["SC"].append(-cost)
            terms["TC"].append(-len(open_goals) / (self.total * self.max_steps))
            terms["TB"].append(float(done and num_met > 0))
        return terms

    def observe(self, agent, num_agents, num_targets):
        """As one list; `num_agents` and `num_targets` say how far to pad with zeros."""
        span = (1, 1) if self.raw else tuple(max(s - 1, 1) for s in self.size)
        order = [agent, *[i for i in range(num_agents) if i != agent]]
        where = [self.positions[i] if i < len(self.positions) else (0, 0) for i in order]
        own = self.positions[agent]
        out = [v / s for at in where for v, s in zip(at, span, strict=True)]
        goals = self.goals + [None] * (num_targets - len(self.goals))
        for goal in goals:
            gone = goal is None or goal.solved
            out += [0.0, 0.0] if gone else [(goal.at[d] - own[d]) / span[d] for d in (0, 1)]
        number = lambda skills: float(sum(2**s for s in skills))
        out += [number(self.skills[i]) if i < len(self.skills) else 0.0 for i in order]
        out += [number(g.skills) if g else 0.0 for g in goals]
        out += [float(g.every) if g else 0.0 for g in goals]
        return out


def mask(skills):
    return sum(1 << s for s in skills)


def to_arrays(twin, num_agents, num_targets, kinds=None, shape=None):
    """The twin's start as a padded problem; `shape` [K, H, W] where cells are blocked."""
    n, m = len(twin.positions), len(twin.goals)
    wide = lambda rows, length: np.pad(
        np.array(rows), [(0, length - len(rows)), *[(0, 0)] * (np.ndim(rows) - 1)])
    passable = None
    if shape is not None:
        passable = np.ones(shape, bool)
        for i, closed in enumerate(twin.closed or []):
            for x, y in closed:
                passable[kinds[i], y, x] = False
    buffer = None
    if twin.later:
        buffer = Buffer(
            jnp.array([g.at for g in twin.later]), jnp.array([mask(g.skills) for g in twin.later]),
            jnp.array([g.every for g in twin.later]), jnp.zeros((), jnp.int32))
    problem = Problem(
        size=jnp.array(twin.size),
        agent_skills=jnp.array(wide([mask(s) for s in twin.skills], num_agents)),
        agent_kinds=jnp.array(wide(kinds or [0] * n, num_agents), jnp.int32),
        agent_mask=jnp.arange(num_agents) < n,
        target_cells=jnp.array(wide([g.at for g in twin.goals], num_targets)),
        target_skills=jnp.array(wide([mask(g.skills) for g in twin.goals], num_targets)),
        target_and=jnp.array(wide([g.every for g in twin.goals], num_targets)),
        target_mask=jnp.arange(num_targets) < m,
        passable=None if passable is None else jnp.array(passable), buffer=buffer)
    return jax.tree.map(lambda x: x.astype(jnp.int32) if x.dtype == jnp.int64 else x, problem), \
        jnp.array(wide(twin.positions, num_agents), jnp.int32)


def trace(config, problem, cells, actions):
    """The reset and every step of a list of joint actions [T, N]."""
    state, observation = grid.reset_to(config, problem, cells)

    def one(state, joint):
        result = grid.step(config, state, joint)
        return result.state, result

    return (state, observation), jax.lax.scan(one, state, actions)[1]


one_trace = jax.jit(trace, static_argnums=0)
many_traces = jax.jit(jax.vmap(trace, in_axes=(None, 0, 0, 0)), static_argnums=0)


def assert_same(twin, config, num_agents, num_targets, start, results, actions):
    """Walks the twin through the actions and compares all that it saw."""
    n, m = len(twin.positions), len(twin.goals)
    seen = [state_of(twin, num_agents, num_targets)]
    events = []
    for joint in actions:
        rewards, *flags, walked, met = twin.step(joint[:n])
        seen.append(state_of(twin, num_agents, num_targets))
        terms = [[*rewards[name], *[0.0] * (num_agents - n)] for name in TERMS]
        events.append((terms, flags, walked + [False] * (num_agents - n),
                       met + [False] * (num_targets - m)))
    positions, solved, observations = (np.array(column) for column in zip(*seen, strict=True))
    terms, flags, walked, met = (np.array(column) for column in zip(*events, strict=True))

    state, observation = start
    after = results.state
    assert np.array_equal(np.concatenate([state.cells[None], after.cells])[:, :n], positions)
    assert np.array_equal(np.concatenate([state.solved[None], after.solved]), solved)
    got = np.concatenate([observation[None], results.observation])
    np.testing.assert_allclose(got[:, :n], observations, atol=1e-6)
    for k, name in enumerate(TERMS):
        np.testing.assert_allclose(getattr(results.rewards, name), terms[:, k], rtol=1e-5,
                                   atol=1e-9, err_msg=name)
    weights = np.array([getattr(config.weights, name) for name in TERMS])
    total = (terms * weights[None, :, None]).sum(1)
    np.testing.assert_allclose(results.reward, total, rtol=1e-4, atol=1e-7)
    assert np.array_equal(np.stack([results.terminated, results.truncated], 1), flags)
    assert np.array_equal(results.true_moves, walked)
    assert np.array_equal(results.newly_solved, met)
    assert after.step.tolist() == list(range(1, len(actions) + 1))


def state_of(twin, num_agents, num_targets):
    """Positions, solved flags (padding counts as solved) and observations of a moment."""
    padding = [True] * (num_targets - len(twin.goals))
    return (list(twin.positions), [g.solved for g in twin.goals] + padding,
            [twin.observe(i, num_agents, num_targets) for i in range(len(twin.positions))])


NUM_AGENTS, NUM_TARGETS, SIDE, HORIZON, BUFFER = 4, 5, 5, 12, 2
skill_sets = st.frozensets(st.integers(0, 2), min_size=1)


@st.composite
def episodes(draw):
    """A problem on a small map, where much happens, and its actions."""
    size = draw(st.tuples(st.integers(1, SIDE), st.integers(1, SIDE)))
    all_cells = [(x, y) for x in range(size[0]) for y in range(size[1])]
    cell = st.sampled_from(all_cells)
    n = draw(st.integers(1, NUM_AGENTS))
    spare = BUFFER if len(all_cells) > BUFFER and draw(st.booleans()) else 0
    places = draw(st.lists(cell, min_size=spare + 1, unique=True,
                           max_size=min(NUM_TARGETS + spare, len(all_cells))))
    goals = [Goal(at, need, len(need) > 1 and draw(st.booleans()))
             for at in places for need in [draw(skill_sets)]]
    kinds = draw(st.lists(st.integers(0, 1), min_size=n, max_size=n))
    walls = [draw(st.sets(cell, max_size=6)) for _ in range(2)]
    twin = Twin(
        size=size, positions=[draw(cell) for _ in range(n)], skills=[draw(skill_sets)
                                                                     for _ in range(n)],
        goals=goals[:len(goals) - spare], later=goals[len(goals) - spare:],
        closed=[walls[k] for k in kinds], max_steps=10, c_ar=0.04)
    joint = st.lists(st.integers(0, 4), min_size=NUM_AGENTS, max_size=NUM_AGENTS)
    return twin, kinds, draw(st.lists(joint, min_size=HORIZON, max_size=HORIZON))


@settings(max_examples=150, deadline=None)
@given(episodes())
def test_padded_episode_is_the_twins(episode):
    twin, kinds, actions = episode
    config = grid.EnvConfig(max_steps=10, c_ar=0.04)
    arrays = to_arrays(twin, NUM_AGENTS, NUM_TARGETS, kinds, (2, SIDE, SIDE))
    start, results = jax.tree.map(np.asarray, one_trace(config, *arrays, jnp.array(actions)))
    assert_same(twin, config, NUM_AGENTS, NUM_TARGETS, start, results, actions)
    assert one_trace._cache_size() <= 2, "one shape with, one without a buffer"


def random_twin(rng, n, m, skills, size, spare, walls, **rules):
    """A problem of fixed sizes, so that a batch of them stacks without padding."""
    area = [(x, y) for x in range(size[0]) for y in range(size[1])]
    subset = lambda: frozenset(rng.sample(range(skills), rng.randint(1, skills)))
    goals = [Goal(at, need, len(need) > 1 and rng.random() < 0.5)
             for at in rng.sample(area, m + spare) for need in [subset()]]
    closed = [set(rng.sample(area, walls)) for _ in range(n)] if walls else None
    return Twin(size=size, positions=rng.choices(area, k=n), skills=[subset() for _ in range(n)],
                goals=goals[:m], later=goals[m:], closed=closed, **rules)


FAMILIES = {
    "paper": {"n": 3, "m": 5, "skills": 2, "size": (8, 8), "spare": 0, "walls": 0},
    "replanning": {"n": 3, "m": 5, "skills": 2, "size": (6, 6), "spare": 5, "walls": 0},
    "three skills, oblong": {"n": 4, "m": 6, "skills": 3, "size": (9, 4), "spare": 0, "walls": 0},
    "a kind an agent": {"n": 2, "m": 3, "skills": 2, "size": (6, 6), "spare": 0, "walls": 8},
    "alone, raw, literal": {"n": 1, "m": 2, "skills": 1, "size": (4, 4), "spare": 0, "walls": 0,
                            "raw": True, "literal": True},
}


@pytest.mark.parametrize("family", FAMILIES)
def test_thousands_of_random_steps(family):
    sizes = FAMILIES[family]
    rng = random.Random(family)
    n, m = sizes["n"], sizes["m"]
    twins = [random_twin(rng, **sizes, max_steps=30, c_ar=0.0075) for _ in range(40)]
    config = grid.EnvConfig(
        max_steps=30, normalize_positions=not sizes.get("raw", False),
        literal_step_cost=sizes.get("literal", False))
    shape = (n, sizes["size"][1], sizes["size"][0]) if sizes["walls"] else None
    kinds = list(range(n)) if sizes["walls"] else None
    arrays = [to_arrays(twin, n, m, kinds, shape) for twin in twins]
    problems, cells = jax.tree.map(lambda *rows: jnp.stack(rows), *arrays)
    actions = np.array([[[rng.randrange(5) for _ in range(n)] for _ in range(32)] for _ in twins])
    starts, results = jax.tree.map(
        np.asarray, many_traces(config, problems, cells, jnp.array(actions)))
    solved_any = 0
    for e, twin in enumerate(twins):
        pick = lambda x, e=e: x[e]
        assert_same(twin, config, n, m, jax.tree.map(pick, starts), jax.tree.map(pick, results),
                    actions[e].tolist())
        solved_any += any(g.solved for g in twin.goals) or len(twin.later) < sizes["spare"]
    assert solved_any >= 10, "the random walks solve too little to test anything"
