"""What MAPPO says of itself while a run trains it."""

import sys
from io import StringIO

import jax
import numpy as np
import pytest

from moonteam.grid.config import EnvConfig
from moonteam.planners.base import Snapshot
from moonteam.planners.exact import ExactPlanner
from moonteam.report.progress import bar
from training.mappo.config import PRESETS
from training.mappo.grid_task import GridTask
from training.mappo.held_out import collapsed, optimum
from training.mappo.trainee import Mappo

SCORE = {"success": 0.987, "makespan": 113.62, "moves": 26.5}


class Terminal(StringIO):
    """A screen of 80 columns."""

    def isatty(self):
        return True


@pytest.mark.parametrize("name", ["small", "pi_5t5r"])
def test_the_live_lines_show_everything_on_80_columns(name, monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    for key, value in (("COLUMNS", "80"), ("TERM", "xterm"), ("NO_COLOR", "1")):
        monkeypatch.setenv(key, value)
    mappo, rows = Mappo(PRESETS[name]), []
    with bar(mappo.name, 7_000_000_000) as show:
        for steps, more in ((5_000_000_000, {"argmax": SCORE}), (6_000_000_000, {})):
            rows.append({"phase": "refinement", "env_steps": steps, "rate": 23456.7} | more)
            show(steps, mappo.words(rows))
    shown = screen.getvalue()
    last = shown[shown.rindex(name):]
    for part in ("refinement", "6,000,000,000 env steps", "23,457/s", "0.987 success",
                 "113.6 makespan", "26.5 moves", "0:00:0"):
        assert part in last, last
    assert "…" not in last


def looks(*successes):
    """Rows with evaluations of sampled actions, one every ten updates."""
    return [{"total_updates": 10 * i, "sample": {"success": s}} for i, s in enumerate(successes, 1)]


SMALL = looks(.633, .645, .656, .719, .754, .730, .820, .879, .895, .906, .895, .938, .941, .941,
              .926, .930, .953, .984, .988, .988, .980, .996, .988, .992)
"""What `moonteam train small --seed 0` shows."""


@pytest.mark.parametrize(("successes", "scenarios", "expected"), [
    ((0.9, 0.45, 0.4, 0.3), 256, True),
    ((0.6, 0.9, 0.0, 0.0, 0.0), 256, True),
    ((0.9, 0.9, 0.3, 0.3), 256, False),  # two only
    ((0.9, 0.3, 0.3, 0.5, 0.3), 256, False),  # not in a row
    ((0.9, 0.46, 0.4, 0.3), 256, False),  # more than half of the best
    ((0.45, 0.1, 0.1, 0.1), 256, False),  # never could do much
    ((0.6, 0.29, 0.29, 0.29), 16, False),  # chance, on so few scenarios
    ((0.1, 0.1, 0.1, 0.1), 256, False)])
def test_a_collapse_is_a_lasting_fall_to_half_of_what_it_could(successes, scenarios, expected):
    assert collapsed(looks(*successes), scenarios) is expected


def test_no_false_alarm_in_normal_learning():
    assert not any(collapsed(SMALL[:n], 256) for n in range(len(SMALL) + 1))
    training = [{"total_updates": n} for n in range(3)]
    assert not collapsed(training, 256)
    draw = np.random.default_rng(0)
    for scenarios in (4, 8, 16, 32, 256):  # one policy, measured again and again
        for ability in (0.3, 0.5, 0.7, 0.95):
            noisy = looks(*(draw.binomial(scenarios, ability, 400) / scenarios))
            assert not any(collapsed(noisy[:n], scenarios) for n in range(1, 401, 3))


def test_the_optimum_is_that_of_the_scenarios_that_are_played():
    """Against the exact planner, scenario by scenario; none where it is not known."""
    config = EnvConfig(num_agents=2, num_targets=3, width=9, height=7)
    key, count = jax.random.key(3), 6
    world = jax.device_get(GridTask(config).reset(jax.random.split(key)[0], count).world)
    spans = []
    for b in range(count):
        state = jax.tree.map(lambda x, b=b: x[b], world)
        p = state.problem
        spans.append(ExactPlanner().plan(Snapshot(
            (9, 7), state.cells, p.agent_skills, p.agent_kinds, p.agent_mask, p.target_cells,
            p.target_skills, p.target_and, state.solved)).makespan)
    assert optimum(GridTask(config), key, count) == np.mean(spans)
    assert optimum(GridTask(EnvConfig(num_buffer=5)), key, count) is None
    assert optimum(GridTask(EnvConfig(num_targets=9)), key, count) is None
