"""What `moonteam/__init__.py` names: every block of Python in the documents runs as it stands."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

import moonteam
from moonteam import api, cli, files, results
from moonteam.planners import registry as planners
from moonteam.planners.exact import ExactPlanner
from moonteam.policies.policy import Policy
from moonteam.results import Rollout, Training
from moonteam.robots import KINDS

TOP = Path(__file__).parents[1]
PAGES = ("README.md", "docs/python.md", "docs/api/grid.md", "docs/planners.md")


@pytest.fixture(autouse=True)
def registries(monkeypatch):
    """What a test registers is forgotten after it."""
    for registry in (KINDS, planners._REGISTRY):
        monkeypatch.setattr(registry, "_own", dict(registry._own))


def blocks():
    for page in PAGES:
        text = (TOP / page).read_text(encoding="utf-8")
        for number, found in enumerate(re.finditer(r"```python\n(.*?)```", text, re.DOTALL)):
            needs = "pettingzoo" in found[1] and importlib.util.find_spec("pettingzoo") is None
            yield pytest.param(found[1], id=f"{page}-{number}", marks=pytest.mark.skipif(
                needs, reason="pettingzoo is not installed"))


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


def test_missions_are_evaluated_as_the_command_does(capsys):
    words = ["evaluate", "execution", "--mission", "demo", "--planner", "exact", "greedy",
             "--loop", "grid", "--json"]
    assert cli.main(words) == 0
    printed = msgspec.json.decode(capsys.readouterr().out)
    report = moonteam.evaluate("demo", ["exact", "greedy"], loop="grid")
    assert msgspec.json.decode(files.dump_json(report)) == printed
    assert capsys.readouterr().out == ""
    assert [row["contender"] for row in report.rows] == ["grid exact", "grid greedy"]
    for row in (*report.rows, *report.summary):
        assert all(isinstance(v, (str, int, float, bool, type(None))) for v in row.values())
    best = report.rows[0]
    assert (best["mission"], best["success"], best["cause"]) == ("demo", True, None)
    assert best["decisions"] == moonteam.plan("demo").makespan == report.summary[0]["decisions"]
    page = report._repr_html_()
    assert '<td data-title="contender">grid exact</td>' in page
    assert "over_plan" not in page, "nothing is known of it in steps"
    table = pytest.importorskip("pandas").DataFrame(report.rows)
    assert report.to_pandas().equals(table)
    assert table.groupby("contender").success.mean()["grid greedy"] == 1.0


def test_missions_made_in_python_are_evaluated_and_go_on(tmp_path):
    demo = moonteam.load("demo")
    renamed = tuple(msgspec.structs.replace(r, name=f"{r.name}2") for r in demo.robots)
    several = [demo, msgspec.structs.replace(demo, robots=renamed, targets=demo.targets[:1])]
    report = moonteam.evaluate(several, "exact", loop="grid", out=tmp_path / "run")
    assert [len(one["mission"]["targets"]) for one in report["missions"]] == [3, 1]
    assert [(row["mission"], row["targets"]) for row in report.rows] == [("demo", 3), ("demo", 1)]
    assert report.rows[1]["seconds"] < report.rows[0]["seconds"]
    assert {file.name for file in (tmp_path / "run").iterdir()} == {
        "config.json", "rows.jsonl", "report.json", "report.html", "rows.csv", "table.md"}
    header, *lines = (tmp_path / "run" / "rows.csv").read_text().splitlines()
    assert {"hopper_moves", "hopper2_moves"} <= set(header.split(","))
    assert len(lines) == 2
    assert ",1," in lines[0], "yes is 1"
    again = moonteam.evaluate(several, "exact", loop="grid", out=tmp_path / "run", resume=True)
    assert again["rows"] == report["rows"]
    with pytest.raises(moonteam.InputError, match="other options: made"):
        moonteam.evaluate(several[::-1], "exact", loop="grid", out=tmp_path / "run", resume=True)
    with pytest.raises(moonteam.InputError, match="--force replaces"):
        moonteam.evaluate(demo, "exact", loop="grid", out=tmp_path / "run")
    with pytest.raises(moonteam.InputError, match="no robot has skill Z"):
        moonteam.evaluate(msgspec.structs.replace(demo, targets=(
            msgspec.structs.replace(demo.targets[1], skills=("Z",)),)), loop="grid")


def test_missions_are_drawn_where_none_is_given():
    report = moonteam.evaluate(site="flat", count=2, targets=2, side=6, planner="exact",
                               loop="grid")
    assert [row["mission"] for row in report.rows] == ["flat-0-0", "flat-0-1"]
    assert report["meta"]["command"] == (
        "moonteam evaluate execution --targets 2 --side 6 --site flat --count 2 --loop grid "
        "--planner exact")
    assert report.summary[0]["intervals.success.1"] == 1.0


@pytest.mark.parametrize(("what", "options"), [("demo", {"loop": "grid"}), ("3x5", {"limit": 2})])
def test_an_evaluation_that_is_stopped_saves_what_was_done(what, options, tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(ExactPlanner, "plan", stop)
    with pytest.raises(KeyboardInterrupt):
        moonteam.evaluate(what, ["greedy", "exact"], out=tmp_path, **options)
    report = files.read_json(tmp_path / "report.json")
    assert report["interrupted"]
    assert len(report["rows"]) == options.get("limit", 1), "what greedy made"


def test_plans_are_saved_where_a_folder_is_given(tmp_path):
    few = moonteam.load("3x5")[:2]
    report = moonteam.evaluate(few, "greedy", out=tmp_path / "run")
    assert files.read_json(tmp_path / "run" / "report.json")["rows"] == report["rows"]
    assert (tmp_path / "run" / "gaps.png").exists()
    again = moonteam.evaluate(few, "greedy", out=tmp_path / "run", resume=True)
    assert again["rows"] == report["rows"], "their seconds too: they were not made again"
    with pytest.raises(moonteam.InputError, match="other options: made"):
        moonteam.evaluate(few[:1], "greedy", out=tmp_path / "run", resume=True)


@pytest.mark.parametrize(("call", "says"), [
    (lambda: moonteam.plan("3x5"), "choose one"),
    (lambda: moonteam.plan("outpost", time_limt=3), "did you mean time_limit"),
    (lambda: moonteam.plan("outpost", "exakt"), "did you mean exact"),
    (lambda: moonteam.plan("outpost", "policy", policy="any_taem"), "any_team"),
    (lambda: moonteam.rollout("outpost", backnd="native"), "did you mean backend"),
    (lambda: moonteam.evaluate("3x5", decod="argmax"), "did you mean decode"),
    (lambda: moonteam.evaluate("outpst"), "did you mean outpost"),
    (lambda: moonteam.evaluate("outpost", limit=3), "no such option"),
    (lambda: moonteam.evaluate(["demo", "demo"]), "give each once"),
    (lambda: moonteam.evaluate(["demo", moonteam.load("3x5:0")]), "one or the other"),
    (lambda: moonteam.evaluate("demo", side=8), "is for random missions"),
    (lambda: moonteam.evaluate(site=["flat", "mares"]), "'mares' is not one of .*mare\\?"),
    (lambda: moonteam.evaluate("sampling"), "by the clock"),
    (lambda: moonteam.rollout("demo", mode="asynch"), "did you mean async"),
    (lambda: moonteam.train("smal"), "small"),
    (lambda: moonteam.train("small", sed=1), "no such option; did you mean --seed"),
    (lambda: moonteam.make("MoonGrid"), "did you mean MoonGrid-v0"),
    (lambda: moonteam.make("MoonGrid-v0", confg="pi_5t"), "did you mean config"),
    (lambda: moonteam.make("MoonGrid-v0", config="pi_5"), "pi_5t"),
    (lambda: moonteam.make("MoonGrid-v0", face="gym"), "jaxmarl or pettingzoo"),
    (lambda: moonteam.register(3), "neither"),
    (lambda: moonteam.register(KINDS.get("drone"), "other"), "own name"),
    (lambda: Policy.load("any_taem"), "any_team")])
def test_a_mistake_is_named(call, says):
    with pytest.raises(moonteam.InputError, match=says):
        call()


def test_a_mission_made_in_python_is_driven_and_written(tmp_path):
    demo = moonteam.load("demo")
    mission = msgspec.structs.replace(demo, targets=demo.targets[:1], name="one target")
    driven = moonteam.rollout(mission, "exact", backend="native", out=tmp_path)
    assert driven.success
    assert len(driven.targets) == 1
    assert moonteam.load(tmp_path / "mission.yaml") == mission
    assert driven.folder == tmp_path
    assert driven.report.decisions == len(driven.record.decisions)
    assert driven.seconds == pytest.approx(driven.record.seconds())
    assert not (tmp_path / "video.mp4").exists()
    page = driven._repr_html_()
    assert "one target" in page
    assert "data:image/png;base64," in page, "the map, while there is no film"


def test_a_film_is_made_when_it_is_asked_for(tmp_path):
    """Where it goes, and what a notebook then shows; what is in it is for other tests."""
    drawn = []

    def film(path):
        drawn.append(path)
        path.write_bytes(b"film")

    report = SimpleNamespace(mission="<m>", success=False, detail="a & b", cause="engine",
                             seconds=2.5, planner="exact", targets=(), robots=())
    driven = Rollout(report, None, tmp_path, film)
    assert driven.save_video() == tmp_path / "video.mp4" == driven.video
    assert driven.save_video(tmp_path / "other.mp4") == drawn[1]
    page = driven._repr_html_()
    assert '<video controls style="max-width:640px" src="data:video/mp4;base64,ZmlsbQ=="' in page
    assert "&lt;m&gt;</b>: failed: a &amp; b, 2.5 s" in page
    with pytest.raises(moonteam.InputError, match=r"\.mp4"):
        driven.save_video(tmp_path / "film.avi")
    assert len(drawn) == 2


def test_what_is_evaluated_comes_in_flat_rows():
    report = moonteam.evaluate("3x5", ["greedy", "exact"], limit=3)
    assert isinstance(report, dict), "the document of the command"
    assert len(report.rows) == 6
    for row in (*report.rows, *report.summary):
        assert all(isinstance(v, (str, int, float, bool, type(None))) for v in row.values())
    best = report.summary[1]
    assert best["planner"] == "exact(makespan)"
    assert best["intervals.makespan.0"] <= best["makespan"] <= best["intervals.makespan.1"]
    assert '<td data-title="planner">exact(makespan)</td>' in report._repr_html_()
    table = pytest.importorskip("pandas").DataFrame(report.rows)
    assert table.groupby("planner").makespan.mean()["exact(makespan)"] == best["makespan"]
    assert report.to_pandas().equals(table)


def test_a_run_of_training_is_read_back(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"update": 1, "gap": [0.5, null]}\n{"update": 2}\n')
    files.write_json(tmp_path / "report.json", {"preset": "small", "held_out": {"3x5": 0.25}})
    run = Training.of(tmp_path)
    assert run.rows == [{"update": 1, "gap.0": 0.5, "gap.1": None}, {"update": 2}]
    assert Path(run) == tmp_path
    assert run.policy == tmp_path / "policy.safetensors"
    assert ">held_out.3x5</td><td data-title=\"\">0.25</td>" in run._repr_html_()


def test_without_pandas_it_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(moonteam.InputError, match="pip install pandas"):
        results.frame([])


def test_keywords_of_a_training_are_words_of_the_command():
    assert list(api._words({"seed": 1, "resume": True, "stop_on_collapse": False, "begin": None,
                            "bootstrap": {"num_envs": 32, "lr": 1e-3, "both": (1, 2)}})) == [
        "--seed", "1", "--resume", "--no-stop-on-collapse", "--bootstrap.num-envs", "32",
        "--bootstrap.lr", "0.001", "--bootstrap.both", "1", "2"]


def test_without_pettingzoo_it_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    with pytest.raises(moonteam.InputError, match=r"moonteam\[pettingzoo\]"):
        moonteam.make("MoonGrid-v0", face="pettingzoo")
