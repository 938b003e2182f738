"""What the planners' tests share: the environment as judge, and plain searches to compare with."""

import heapq
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam import grid
from moonteam.grid.config import EnvConfig
from moonteam.planners.base import Snapshot
from moonteam.problem.scenario import load_set

STEPS, AGENTS, TARGETS = 128, 4, 12  # one shape, so that the environment is compiled once


@pytest.fixture(scope="session")
def golden(request):
    return load_set(request.config.rootpath / "tests/golden/certified_optima.jsonl")


def _play(config, problem, cells, actions):
    state, _ = grid.reset_to(config, problem, cells)

    def advance(state, joint):
        result = grid.step(config, state, joint)
        return result.state, result.state.solved.all()

    _, done = jax.lax.scan(advance, state, actions)
    return jnp.concatenate([state.solved.all()[None], done])


@pytest.fixture(scope="session")
def judge():
    """judge(scenarios, plans): per plan (first step at which the env has all solved, moves)."""
    play = jax.jit(jax.vmap(_play, in_axes=(None, 0, 0, 0)), static_argnums=0)

    def run(scenarios, plans):
        answers = []
        for start in range(0, len(scenarios), 40):
            answers += chunk(scenarios[start:start + 40], plans[start:start + 40])
        return answers

    def chunk(scenarios, plans):
        # one filler with the largest shapes; fillers complete the batch
        filler = grid.generate(0, num_agents=AGENTS, num_targets=TARGETS,
                               kinds=("a", "b", "c", "a"),
                               blocked={"a": 0.1, "b": 0.2, "c": 0.3})
        padded = [*scenarios, *[filler] * (41 - len(scenarios))]
        problems, cells = grid.stack([grid.to_problem(s) for s in padded])
        actions = np.full((len(padded), STEPS, AGENTS), 4, np.int32)
        for row, plan in zip(actions, plans, strict=False):
            row[:len(plan.actions), :plan.actions.shape[1]] = plan.actions[:STEPS]
        done = np.asarray(play(EnvConfig(max_steps=STEPS), problems, cells, jnp.asarray(actions)))
        return [(int(np.argmax(d)) if d.any() else None, int((p.actions != 4).sum()))
                for d, p in zip(done, plans, strict=False)]

    return run


def joint_state_optimum(snapshot: Snapshot, alpha: int, beta: int) -> float:
    """Least alpha * makespan + beta * moves by Dijkstra over (all agents' cells, solved set).

    It knows nothing of schedules or coalitions, only the rules of one step.
    """
    width, height = snapshot.size
    members = [a for a in range(len(snapshot.cells)) if snapshot.agent_mask[a]]

    def moves_of(a, cell):
        options = [(cell, 0)]
        for dx, dy in ((0, 1), (0, -1), (-1, 0), (1, 0)):
            x, y = cell[0] + dx, cell[1] + dy
            if not (0 <= x < width and 0 <= y < height):
                continue
            kind = snapshot.agent_kinds[a]
            if snapshot.passable is None or snapshot.passable[kind, y, x]:
                options.append(((x, y), 1))
        return options

    table = {(a, (x, y)): moves_of(a, (x, y)) for a in members
             for x in range(width) for y in range(height)}
    targets = [tuple(t) for t in snapshot.target_cells.tolist()]
    wants = list(zip(snapshot.target_skills.tolist(), snapshot.target_and.tolist(), strict=True))

    def solved_after(cells, solved):
        for t, target in enumerate(targets):
            if not solved >> t & 1 and target in cells:
                have = 0
                for a, cell in zip(members, cells, strict=True):
                    if cell == target:
                        have |= int(snapshot.agent_skills[a])
                need, every = wants[t]
                if (have & need) == need if every else have & need:
                    solved |= 1 << t
        return solved

    begin = tuple(tuple(snapshot.cells[a].tolist()) for a in members)
    first = solved_after(begin, sum(1 << t for t in np.flatnonzero(snapshot.solved).tolist()))
    goal = (1 << len(targets)) - 1
    queue, best = [(0, begin, first)], {(begin, first): 0}
    while queue:
        cost, cells, solved = heapq.heappop(queue)
        if solved == goal:
            return cost
        if cost > best[cells, solved]:
            continue
        for options in itertools.product(*(table[a, c] for a, c in zip(members, cells,
                                                                      strict=True))):
            after = tuple(cell for cell, _ in options)
            paid = cost + alpha + beta * sum(step for _, step in options)
            state = (after, solved_after(after, solved))
            if paid < best.get(state, float("inf")):
                best[state] = paid
                heapq.heappush(queue, (paid, *state))
    return float("inf")


@pytest.fixture(scope="session")
def joint_state_search():
    return joint_state_optimum
