"""Distance fields against a breadth-first search, and the moves that shorten a way."""

from collections import deque
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from moonteam import grid

SIDE, KINDS, FIELDS = 7, 2, 3
STEPS = [(0, 1), (0, -1), (-1, 0), (1, 0)]

fields_of = jax.jit(grid.distance_fields)
problem_fields = jax.jit(grid.problem_fields)
distances = jax.jit(grid.distances)
first_step = jax.jit(grid.first_step)


def search(passable, start, target):
    """Moves from start to target, entering passable cells only; None where there is no way."""
    height, width = passable.shape
    seen, queue = {start: 0}, deque([start])
    while queue:
        at = queue.popleft()
        if at == target:
            return seen[at]
        for dx, dy in STEPS:
            goal = (at[0] + dx, at[1] + dy)
            inside = 0 <= goal[0] < width and 0 <= goal[1] < height
            if inside and goal not in seen and passable[goal[1], goal[0]]:
                seen[goal] = seen[at] + 1
                queue.append(goal)
    return None


@st.composite
def maps(draw):
    size = draw(st.tuples(st.integers(1, SIDE), st.integers(1, SIDE)))
    free = st.lists(st.sampled_from([True, True, False]), min_size=size[0] * size[1],
                    max_size=size[0] * size[1])
    passable = np.array([draw(free) for _ in range(KINDS)]).reshape(KINDS, size[1], size[0])
    cell = st.tuples(st.integers(0, size[0] - 1), st.integers(0, size[1] - 1))
    targets = draw(st.lists(cell, min_size=FIELDS, max_size=FIELDS))
    return size, passable, targets


@settings(max_examples=60, deadline=None)
@given(maps())
def test_fields_are_shortest_ways(case):
    size, passable, targets = case
    padded = np.ones((KINDS, SIDE, SIDE), bool)
    padded[:, :size[1], :size[0]] = passable
    fields = np.asarray(fields_of(jnp.array(padded), jnp.array(targets), jnp.array(size)))
    for kind in range(KINDS):
        for j, target in enumerate(targets):
            for y in range(size[1]):
                for x in range(size[0]):
                    way = search(passable[kind], (x, y), target)
                    wanted = grid.UNREACHABLE if way is None else way
                    assert fields[kind, j, y, x] == wanted, (kind, target, (x, y))


def test_open_map_is_manhattan_with_and_without_fields():
    problem, cells = grid.to_problem(grid.generate(0, num_agents=4, num_targets=3, size=(20, 9)))
    target = np.asarray(problem.target_cells)
    wanted = np.abs(target[None] - np.asarray(cells)[:, None]).sum(2)
    assert grid.problem_fields(problem) is None
    assert np.array_equal(distances(problem, None, cells), wanted)
    fields = fields_of(jnp.ones((1, 9, 20), bool), problem.target_cells)
    assert np.array_equal(distances(problem, fields, cells), wanted)
    closed = replace(problem, passable=jnp.ones((1, 9, 20), bool))
    assert np.array_equal(first_step(problem, None, cells), first_step(closed, fields, cells))


def test_first_step_is_every_move_that_shortens_the_way():
    blocked = {"legged": 0.2, "wheeled": 0.4}
    for seed in range(3):
        scenario = grid.generate(seed, num_agents=6, num_targets=4, size=(10, 10), blocked=blocked,
                                 kinds=("legged", "wheeled") * 3)
        problem, cells = grid.to_problem(scenario)
        fields = problem_fields(problem)
        ways = np.asarray(first_step(problem, fields, cells))
        passable = np.asarray(problem.passable)
        for i, (agent, kind) in enumerate(zip(scenario.agents, np.asarray(problem.agent_kinds),
                                              strict=True)):
            for j, target in enumerate(scenario.targets):
                here = search(passable[kind], agent.at, target.at)
                for k, (dx, dy) in enumerate(STEPS):
                    goal = (agent.at[0] + dx, agent.at[1] + dy)
                    shorter = (
                        here is not None and 0 <= goal[0] < 10 and 0 <= goal[1] < 10
                        and passable[kind, goal[1], goal[0]]
                        and search(passable[kind], goal, target.at) == here - 1)
                    assert ways[i, j, k] == shorter


def test_fields_of_a_batch():
    pairs = [grid.to_problem(grid.generate(s, size=(6, 6), blocked={"legged": 0.3}))
             for s in range(2)]
    batch, _ = grid.stack(pairs)
    together = jax.jit(jax.vmap(grid.problem_fields))(batch)
    for e, (problem, _) in enumerate(pairs):
        assert np.array_equal(together[e], problem_fields(problem))
