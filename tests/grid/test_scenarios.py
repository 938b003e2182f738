"""Scenario files to arrays and back, padded batches, and the generator of scenario files."""

import itertools
from collections import Counter
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from moonteam import grid
from moonteam.errors import InputError
from moonteam.grid.scenarios import reachable
from moonteam.planners import base
from moonteam.problem import scenario

CERTIFIED = Path(__file__).parents[1] / "golden" / "certified_optima.jsonl"
KINDS = {"drone": 0.0, "legged": 0.15, "wheeled": 0.4}


def test_files_survive_the_round_trip():
    for given in scenario.load_set(CERTIFIED)[::20]:
        problem, cells = grid.to_problem(given)
        back = grid.to_scenario(problem, cells, name=given.id, max_steps=given.max_steps)
        assert scenario.check(back, "test") == replace_optimal(given)


def replace_optimal(given):
    return scenario.Scenario(size=given.size, agents=given.agents, targets=given.targets,
                             id=given.id, max_steps=given.max_steps)


def test_blocked_maps_survive_the_round_trip_and_the_batch():
    scenarios = [grid.generate(s, num_agents=n, num_targets=m, num_skills=3, size=size,
                               blocked=KINDS, kinds=("drone", "legged", "wheeled")[:n], name=str(s))
                 for s, (n, m, size) in enumerate([(3, 4, (8, 6)), (3, 6, (5, 9))])]
    batch, cells = grid.stack([grid.to_problem(s) for s in scenarios])
    assert cells.shape == (2, 3, 2)
    assert batch.passable.shape == (2, 3, 9, 8)
    for e, given in enumerate(scenarios):
        one, at = jax.tree.map(lambda x, e=e: x[e], (batch, cells))
        back = grid.to_scenario(one, at, name=given.id, kinds=("drone", "legged", "wheeled"))
        assert back == given


def test_arrays_agree_with_the_planners_snapshot():
    given = grid.generate(7, num_agents=4, num_targets=5, num_skills=3, blocked=KINDS)
    problem, cells = grid.to_problem(given)
    state, _ = grid.reset_to(grid.config_for(given), problem, cells)
    snapshot = base.Snapshot.start(given)
    for name in ("agent_skills", "agent_kinds", "agent_mask", "target_cells", "target_skills",
                 "target_and", "passable"):
        assert np.array_equal(getattr(problem, name), getattr(snapshot, name)), name
    assert np.array_equal(state.cells, snapshot.cells)
    assert np.array_equal(state.solved, snapshot.solved)


def test_an_and_of_one_skill_is_an_or():
    given = grid.generate(0, num_agents=1, num_targets=1, num_skills=1)
    odd = scenario.Scenario(size=given.size, agents=given.agents, targets=(
        scenario.Target(given.targets[0].at, ("A",), "AND"),))
    assert not grid.to_problem(odd)[0].target_and.any()


def test_a_scenarios_last_targets_can_be_its_buffer():
    given = grid.generate(1, num_targets=10)
    problem, cells = grid.to_problem(given, num_buffer=5)
    assert problem.target_cells.shape == (5, 2)
    assert problem.buffer.cells.tolist() == [list(t.at) for t in given.targets[5:]]
    assert grid.to_scenario(problem, cells).targets == given.targets
    config = grid.config_for(given, num_buffer=5)
    assert (config.num_targets, config.num_buffer) == (5, 5)
    with pytest.raises(InputError, match=r"num_buffer: 10 is not in 0\.\.9"):
        grid.to_problem(given, num_buffer=10)


def test_batches_that_cannot_be_say_so():
    ten = grid.generate(1, num_targets=10)
    with pytest.raises(InputError, match=r"buffers of different lengths: \[0, 5\]"):
        grid.stack([grid.to_problem(ten), grid.to_problem(ten, num_buffer=5)])
    with pytest.raises(InputError, match="at least one problem"):
        grid.stack([])
    blocked = grid.to_problem(grid.generate(0, blocked={"legged": 0.1}))
    with pytest.raises(InputError, match="1 names are needed"):
        grid.to_scenario(*blocked)


def test_generated_scenarios_follow_the_samplers_distribution():
    chances = Counter()
    for team in itertools.product((1, 2, 3), repeat=2):
        for need in (1, 2, 3):
            if not need & ~(team[0] | team[1]):
                for both in ((False, True) if need == 3 else (False,)):
                    chances[team, need, both] = 0.5 if need == 3 else 1.0
    # 9 * 3 draws, of which those with a requirement that nobody meets are drawn again
    valid = sum(chances.values())
    rng = np.random.default_rng(0)
    count = 4000
    drawn, places = Counter(), Counter()
    for _ in range(count):
        s = grid.generate(rng, num_agents=2, num_targets=1, size=(2, 2))
        drawn[tuple(s.mask(a.skills) for a in s.agents), s.mask(s.targets[0].skills),
              s.targets[0].type == "AND"] += 1
        places[s.targets[0].at, s.agents[0].at, s.agents[1].at] += 1
    assert set(drawn) == set(chances)
    expected = {k: v / valid * count for k, v in chances.items()}
    assert_close(drawn, expected)
    assert len(places) == 4 * 3 * 3
    assert_close(places, dict.fromkeys(places, count / 36))


def assert_close(drawn, expected):
    statistic = sum((drawn[k] - e) ** 2 / e for k, e in expected.items())
    freedom = len(expected) - 1
    assert abs(statistic - freedom) < 5 * np.sqrt(2 * freedom)


def test_generation_is_reproducible_and_valid():
    assert grid.generate(5, blocked=KINDS) == grid.generate(5, blocked=KINDS)
    assert grid.generate(5) != grid.generate(6)
    scenario.check(grid.generate(5, num_agents=10, num_targets=60, num_skills=8), "test")


def test_blocked_scenarios_are_solvable_and_the_map_is_as_asked():
    for seed in range(10):
        s = scenario.check(grid.generate(seed, num_agents=4, num_targets=8, num_skills=3,
                                         size=(16, 12), blocked=KINDS), "test")
        closed = {kind: set(s.blocked[kind]) for kind in KINDS}
        assert {k: len(c) for k, c in closed.items()} == {"drone": 0, "legged": 28, "wheeled": 76}
        assert closed["legged"] <= closed["wheeled"]
        kinds, passable = base.passable_maps(s)
        ways = [reachable(passable[k], a.at) for k, a in zip(kinds, s.agents, strict=True)]
        assert all(a.at not in closed[a.kind] for a in s.agents)
        for target in s.targets:
            able = {skill for a, way in zip(s.agents, ways, strict=True)
                    if way[target.at[1], target.at[0]] for skill in a.skills}
            need = set(target.skills)
            assert need <= able if target.type == "AND" else need & able


@pytest.mark.parametrize(("changes", "said"), [
    ({"size": (2, 2), "num_targets": 4}, "4 targets leave no free cell on a map of 2 x 2"),
    ({"blocked": {"legged": 1.0}}, r"blocked: legged: 1.0 is not in \[0, 1\)"),
    ({"kinds": ("drone",)}, "1 kinds for 3 agents"),
    ({"kinds": ("drone",) * 3, "blocked": {"legged": 0.1}}, "every kind needs its share"),
    ({"size": (3, 2), "num_targets": 5, "blocked": {"legged": 0.8}}, "no solvable scenario"),
])
def test_impossible_wishes_say_so(changes, said, monkeypatch):
    monkeypatch.setattr("moonteam.grid.scenarios.TRIES", 50)
    with pytest.raises(InputError, match=said):
        grid.generate(0, **changes)


def test_config_for_keeps_weights_and_flags():
    config = grid.config_for(grid.generate(0, size=(9, 7), num_agents=2, num_targets=3,
                                           max_steps=50), grid.preset_config("pi_7t", "bootstrap"))
    assert config == replace(grid.preset_config("pi_7t", "bootstrap"), num_agents=2, num_targets=3,
                             width=9, height=7, max_steps=50)
