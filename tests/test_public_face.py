"""What `moonteam/__init__.py` names: every block of Python in the documents runs as it stands."""

import re
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

import moonteam
from moonteam import cli, files
from moonteam.planners import registry as planners
from moonteam.policies.policy import Policy
from moonteam.robots import KINDS

TOP = Path(__file__).parents[1]
PAGES = ("README.md", "docs/python.md", "docs/api/grid.md", "docs/own/planner.md")


@pytest.fixture(autouse=True)
def registries(monkeypatch):
    """What a test registers is forgotten after it."""
    for registry in (KINDS, planners._REGISTRY):
        monkeypatch.setattr(registry, "_own", dict(registry._own))


def blocks():
    for page in PAGES:
        text = (TOP / page).read_text(encoding="utf-8")
        for number, found in enumerate(re.finditer(r"```python\n(.*?)```", text, re.DOTALL)):
            yield pytest.param(found[1], id=f"{page}-{number}")


@pytest.mark.parametrize("block", list(blocks()))
def test_every_block_of_the_documents_runs(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "block", "exec"), {"__name__": "block"})


def test_every_name_has_an_example():
    shown = (TOP / "docs/python.md").read_text(encoding="utf-8")
    calls = set(moonteam.__all__) - {"__version__", "InputError", "Mission", "Scenario"}
    assert calls == set(re.findall(r"^## (\w+)$", shown, re.MULTILINE))


def test_the_face_loads_neither_jax_nor_mujoco():
    code = "import moonteam, sys; print(sorted({'jax', 'mujoco', 'numba'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=True).stdout == "[]\n"


def test_load_tells_missions_scenarios_and_sets_apart(tmp_path):
    assert moonteam.load("outpost").name == "outpost"
    one = moonteam.load("3x7:12")
    assert isinstance(one, moonteam.Scenario)
    assert moonteam.load("3x7")[12] == one
    assert moonteam.load(f"3x7:{one.id}") == one
    files.write_json(tmp_path / "one.json", one)
    assert moonteam.load(tmp_path / "one.json") == one
    with pytest.raises(moonteam.InputError, match="outpost"):
        moonteam.load("nowhere")


def test_plan_and_evaluate_say_what_the_commands_say(capsys):
    assert cli.main(["plan", "3x5:3", "--objective", "moves", "--json"]) == 0
    printed = msgspec.json.decode(capsys.readouterr().out)
    document = moonteam.plan("3x5:3", objective="moves").document()
    assert printed | {"seconds": 0} == msgspec.json.decode(
        msgspec.json.encode(document | {"seconds": 0}))
    words = ["evaluate", "grid", "3x5", "--planner", "greedy", "--planner", "exact", "--limit", "6"]
    assert cli.main([*words, "--json"]) == 0
    printed = msgspec.json.decode(capsys.readouterr().out)
    report = moonteam.evaluate("3x5", ["greedy", "exact"], limit=6)
    assert report["meta"]["command"] == printed["meta"]["command"]
    for mine, theirs in zip(report["rows"], printed["rows"], strict=True):
        assert mine["makespan"] == theirs["makespan"]
    again = moonteam.evaluate(moonteam.load("3x5"), "greedy", limit=6)
    assert [r["moves"] for r in again["rows"]] == [r["moves"] for r in report["rows"][:6]]


def test_plan_follows_the_clock(capsys):
    for which in ("sampling", "peers/mrta-benchmark:0"):
        assert cli.main(["plan", which, "--json"]) == 0
        printed = msgspec.json.decode(capsys.readouterr().out)
        plan = moonteam.plan(which)
        assert plan.makespan == round(1000 * printed["makespan"])
        assert [one.target for one in plan.services] == [
            one["target"] for one in printed["schedule"]]


@pytest.mark.parametrize(("call", "says"), [
    (lambda: moonteam.plan("3x5"), "choose one"),
    (lambda: moonteam.plan("outpost", time_limt=3), "did you mean time_limit"),
    (lambda: moonteam.plan("outpost", "exakt"), "did you mean exact"),
    (lambda: moonteam.plan("outpost", "policy", policy="any_taem"), "any_team"),
    (lambda: moonteam.rollout("outpost", backnd="native"), "did you mean backend"),
    (lambda: moonteam.evaluate("3x5", decod="argmax"), "did you mean decode"),
    (lambda: moonteam.train("smal"), "small"),
    (lambda: moonteam.register(3), "neither"),
    (lambda: moonteam.register(KINDS.get("drone"), "other"), "own name"),
    (lambda: Policy.load("any_taem"), "any_team")])
def test_a_mistake_is_named(call, says):
    with pytest.raises(moonteam.InputError, match=says):
        call()


def test_a_mission_made_in_python_is_driven_and_written(tmp_path):
    demo = moonteam.load("demo")
    mission = msgspec.structs.replace(demo, targets=demo.targets[:1], name="one target")
    report = moonteam.rollout(mission, "exact", backend="native", video=False, out=tmp_path)
    assert report.success
    assert len(report.targets) == 1
    assert moonteam.load(tmp_path / "mission.yaml") == mission
