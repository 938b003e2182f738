"""Others' formats: tiny folders written here as their repositories have them; shipped sets."""

import json
import math

import pytest
import yaml

from moonteam import paths
from moonteam.errors import InputError
from moonteam.problem import timed
from moonteam.problem.importers import IMPORTERS
from moonteam.problem.timed import Agent, Target

DEPOT, TASKS = (0.5, 0.5), ((0.1, 0.2), (0.9, 0.4), (0.3, 0.8))


def put(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value) if path.suffix == ".json" else yaml.safe_dump(value))


def dcmrta(folder, name="env_0"):
    """Three tasks: nodes 0 to 2, all start at node 3 and end at node 4, both the depot."""
    at = [*TASKS, DEPOT, DEPOT]
    pairs = [(i, j) for i in range(5) for j in range(5)
             if i != j and not (i == 4 or j == 3) and (i, j) != (3, 4)]
    ways = [[i, j, 0, math.dist(at[i], at[j]), 0, math.dist(at[i], at[j]) / 0.2] for i, j in pairs]
    one = folder / name
    put(one / "graph.yaml", {"vehicle0": {f"edge{n}": way for n, way in enumerate(ways)}
                             | {f"node{k}": 1.0 + k for k in range(3)}})
    put(one / "task_param.yaml", {f"task{k}": {"and0": {"or0": {
        "geq": True, "capId": 0, "capReq": k + 1.0, "capVar": 0.0}}} for k in range(3)})
    put(one / "vehicle_param.yaml", {"vehicle0": {"capVector": [1.0], "capVar": [0.0]}})
    put(one / "planner_param.yaml", {"taskNum": 3, "vehNumPerType": [4]})
    (folder / "Quick_9s.csv").write_text(
        ",success_rate,makespan\n0,1.0,12.5\n2,1.0,11.0\n10,0.9,10.0\n")


def heteromrta(folder, name="env_0"):
    spots = [{"x": x, "y": y} for x, y in (*TASKS, DEPOT)]
    put(folder / name / "config.json", {
        "setup": {"robots": 3},
        "tasks": {"0": {"pos": spots[0], "skillset": {"0": 1, "1": 1}, "duration": 2.5},
                  "1": {"pos": spots[1], "skillset": {"0": 0, "1": 2}, "duration": 0.0}},
        "robots": {str(i): {"pose": spots[3], "skillset": {"0": int(i == 0), "1": int(i > 0)}}
                   for i in range(3)}})
    put(folder / name / "results.yaml", {"result": {"timeCost": 2000.0, "flagSuccess": 1},
                                         "timePenalty": 100, "solverMaxTime": 600.0})


def benchmark(folder, name="1p_000000"):
    at = [DEPOT, *TASKS[:2], (0.0, 0.0)]
    put(folder / f"problem_instances/problem_instance_{name}.json", {
        "Q": [[1, 0], [1, 1]], "R": [[0, 0], [1.0, 0.0], [1.0, 1.0], [0, 0]], "T_e": [0, 5, 7, 0],
        "T_t": [[math.dist(a, b) for b in at] for a in at], "task_locations": at,
        "precedence_constraints": [[2, 1]]})
    put(folder / f"solutions/optimal_schedule_{name}.json", {"makespan": 13.25})


WRITERS = {"dcmrta": dcmrta, "heteromrta": heteromrta, "mrta-benchmark": benchmark}


def read(name, folder):
    return IMPORTERS.get(name).read(folder)


def test_dcmrta_is_read_with_places_made_from_distances(tmp_path):
    for name in ("env_10", "env_2", "env_0"):
        dcmrta(tmp_path, name)
    (tmp_path / "env_0.pkl").write_bytes(b"never read")
    found = read("dcmrta", tmp_path)
    assert [one.id for one in found] == ["env_0", "env_2", "env_10"]
    first = found[0]
    assert [first.optimal.published, found[1].optimal.published] == [
        {"Quick 9s": 12.5}, {"Quick 9s": 11.0}]
    assert found[2].optimal is None  # not all of its tasks were done
    agent = first.agents[0]
    assert first.agents == (Agent((0.0, 0.0), ("A",), 0.2, (0.0, 0.0)),) * 4
    assert [one.coalition for one in first.targets] == [{"A": 1}, {"A": 2}, {"A": 3}]
    assert [one.service for one in first.targets] == [1.0, 2.0, 3.0]
    ours, theirs = [agent.at, *(one.at for one in first.targets)], [DEPOT, *TASKS]
    for i in range(4):
        for j in range(4):
            assert math.dist(ours[i], ours[j]) == pytest.approx(
                math.dist(theirs[i], theirs[j]), abs=1e-8)
    assert first.targets[0].at[1] == 0.0
    assert first.targets[0].at[0] > 0 < first.targets[1].at[1]


def test_heteromrta_is_read_as_it_stands(tmp_path):
    heteromrta(tmp_path)
    one, = read("heteromrta", tmp_path)
    assert one.agents == (Agent(DEPOT, ("A",), 0.2, DEPOT), *[Agent(DEPOT, ("B",), 0.2, DEPOT)] * 2)
    assert one.targets == (Target(TASKS[0], ("A", "B"), service=2.5),
                           Target(TASKS[1], coalition={"B": 2}))
    assert one.optimal.published == {"CTAS-D 600s": 20.0}
    assert one.optimal.makespan is None
    put(tmp_path / "env_0/results.yaml", {"result": {"timeCost": 0.0, "flagSuccess": 0}})
    assert read("heteromrta", tmp_path)[0].optimal is None


def test_mrta_benchmark_is_read_with_its_optimum(tmp_path):
    benchmark(tmp_path)
    one, = read("mrta-benchmark", tmp_path)
    assert one.id == "1p_000000"
    assert one.agents == (Agent(DEPOT, ("A",), home=(0.0, 0.0)),
                          Agent(DEPOT, ("A", "B"), home=(0.0, 0.0)))
    assert one.targets == (Target(TASKS[0], ("A",), service=5.0, after=(1,)),
                           Target(TASKS[1], ("A", "B"), service=7.0))
    assert one.optimal == timed.Known(13.25, published={"MILP": 13.25})
    (tmp_path / "solutions/optimal_schedule_1p_000000.json").unlink()
    assert read("mrta-benchmark", tmp_path)[0].optimal is None


def changed(path, change):
    value = json.loads(path.read_text()) if path.suffix == ".json" else yaml.safe_load(
        path.read_text())
    change(value)
    put(path, value)


WRONG = [
    ("dcmrta", "env_0/graph.yaml", lambda v: v["vehicle0"].pop("node1"),
     "graph.yaml: vehicle0.node1: missing"),
    ("dcmrta", "env_0/graph.yaml", lambda v: v["vehicle0"].pop("edge0") and
     v["vehicle0"].pop("edge3"), "no edge between nodes 0 and 1"),
    ("dcmrta", "env_0/graph.yaml", lambda v: v["vehicle0"]["edge0"].__setitem__(5, 99.0),
     "no common speed"),
    ("dcmrta", "env_0/graph.yaml", lambda v: v["vehicle0"].update(edge0=[0, 7, 0, 1, 0, 5.0]),
     "vehicle0.edge0: [0, 7] is not allowed; nodes 0 to 4"),
    ("dcmrta", "env_0/graph.yaml", lambda v: v["vehicle0"].update(edge0="near"),
     "vehicle0.edge0"),
    ("dcmrta", "env_0/graph.yaml", lambda v: [way.__setitem__(slice(3, 6), [0.1, 0, 0.5])
     for key, way in v["vehicle0"].items() if key[:4] == "edge" and 0 in way[:2]],
     "not those of places in a plane"),
    ("dcmrta", "env_0/planner_param.yaml", lambda v: v.update(vehNumPerType=[2, 2]),
     "vehNumPerType: 2 types of robot"),
    ("dcmrta", "env_0/planner_param.yaml", lambda v: v.pop("taskNum"), "taskNum: missing"),
    ("dcmrta", "env_0/task_param.yaml", lambda v: v["task1"]["and0"].update(or1={}),
     "task1.and0: 2 choices"),
    ("dcmrta", "env_0/task_param.yaml", lambda v: v["task1"]["and0"]["or0"].update(capReq=1.5),
     "task1.and0.or0.capReq: 1.5 is not allowed"),
    ("dcmrta", "env_0/task_param.yaml", lambda v: v["task2"]["and0"]["or0"].update(capReq=5.0),
     "targets[2].coalition.A: 5 agents with it are needed; the team has 4"),
    ("heteromrta", "env_0/config.json", lambda v: v["tasks"]["0"].pop("pos"), "`pos`"),
    ("heteromrta", "env_0/config.json", lambda v: v["tasks"].update(x=v["tasks"]["0"]),
     "tasks: 'x' is not allowed; a number"),
    ("heteromrta", "env_0/config.json", lambda v: v["robots"].pop("0"), "no agent has A"),
    ("heteromrta", "env_0/results.yaml", lambda v: v["result"].pop("timeCost"),
     "result.timeCost: missing"),
    ("mrta-benchmark", "problem_instances/problem_instance_1p_000000.json",
     lambda v: v["T_t"][1].__setitem__(2, 9.0), "T_t[1][2]: 9 is not the straight way"),
    ("mrta-benchmark", "problem_instances/problem_instance_1p_000000.json",
     lambda v: v["R"].pop(), "R: 3 rows; T_e has 4"),
    ("mrta-benchmark", "problem_instances/problem_instance_1p_000000.json",
     lambda v: v["precedence_constraints"].append([0, 1]), "precedence_constraints[1]: [0, 1]"),
    ("mrta-benchmark", "problem_instances/problem_instance_1p_000000.json",
     lambda v: v["precedence_constraints"].append([1, 2]), "circle"),
    ("mrta-benchmark", "problem_instances/problem_instance_1p_000000.json",
     lambda v: v.pop("Q"), "`Q`"),
    ("mrta-benchmark", "solutions/optimal_schedule_1p_000000.json",
     lambda v: v.pop("makespan"), "optimal_schedule_1p_000000.json: makespan: missing"),
]


@pytest.mark.parametrize(("name", "file", "change", "said"), WRONG)
def test_what_is_wrong_in_a_file_is_named(tmp_path, name, file, change, said):
    WRITERS[name](tmp_path)
    changed(tmp_path / file, change)
    with pytest.raises(InputError) as caught:
        read(name, tmp_path)
    assert said in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_that_is_missing_or_holds_something_else(tmp_path, name):
    with pytest.raises(InputError, match="no such folder"):
        read(name, tmp_path / "nowhere")
    (tmp_path / "problem_instances").mkdir()
    (tmp_path / "env_0.txt").write_text("")
    with pytest.raises(InputError, match="holds no"):
        read(name, tmp_path)


def test_a_missing_file_and_a_broken_one_are_named(tmp_path):
    dcmrta(tmp_path)
    (tmp_path / "env_0/graph.yaml").write_text("vehicle0: [1, 2\n")
    with pytest.raises(InputError, match=r"graph\.yaml: is not YAML \(line 2\)"):
        read("dcmrta", tmp_path)
    (tmp_path / "env_0/graph.yaml").unlink()
    with pytest.raises(InputError, match=r"graph\.yaml: no such file"):
        read("dcmrta", tmp_path)
    dcmrta(tmp_path)
    (tmp_path / "Quick_9s.csv").write_text(",makespan\n0,1.0\n")
    with pytest.raises(InputError, match=r"Quick_9s\.csv: success_rate: missing column"):
        read("dcmrta", tmp_path)


SHIPPED = {"dcmrta": (20, 50, 5), "heteromrta": (15, 20, 5), "mrta-benchmark": (3, 8, 5)}


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_beginnings_say_where_they_come_from(name):
    folder = paths.assets() / "testsets" / "peers"
    assert {path.stem for path in folder.iterdir()} == set(SHIPPED)
    found = timed.load_set(folder / f"{name}.jsonl")
    assert SHIPPED[name] == (len(found[0].agents), len(found[0].targets), len(found))
    for one in found:
        assert any(licence in one.source for licence in ("MIT", "Apache", "CC BY 4.0"))
        assert one.optimal.published
        assert all(agent.home is not None for agent in one.agents)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 200_000
