"""A planner in a user's own file works wherever a planner can be named."""

import msgspec
import pytest

from moonteam.cli import main

MINE = "examples/nearest_planner.py:NearestPlanner"


@pytest.mark.parametrize("words", [
    ["plan", "3x5:0"],
    ["evaluate", "grid", "3x5", "--limit", "2", "--planner", "greedy"],
    ["evaluate", "sets", "3x5", "--limit", "2", "--planner", "greedy"],
    ["evaluate", "replanning", "--count", "2", "--planner", "greedy"],
    ["evaluate", "timing", "--targets", "3", "--count", "2", "--budget", "0.2"],
    ["evaluate", "execution", "--count", "1", "--targets", "1", "--side", "8", "--loop", "closed",
     "--backend", "native"],
    ["rollout", "demo", "--no-video", "--backend", "native"]],
    ids=lambda words: " ".join(words[:2]))
def test_mine_is_taken(words, capsys, tmp_path):
    out = [] if words[:2] == ["evaluate", "execution"] else ["--out", str(tmp_path)]
    assert main([*words, "--planner", MINE, "--json", *out]) == 0
    text = capsys.readouterr().out
    document = msgspec.json.decode(text)
    assert "NearestPlanner" in text or document["planner"] == "nearest"
