"""Exported policies: the same decisions without JAX, inputs that NumPy alone can build."""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.commands.export import model_of
from moonteam.grid import scenarios
from moonteam.planners import learned
from moonteam.planners.base import Snapshot
from moonteam.planners.learned import LearnedPlanner
from moonteam.policies import entity, recurrent
from moonteam.policies.entity import EntitySpec
from moonteam.policies.export import onboard
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import PolicyFile, save_policy
from moonteam.policies.recurrent import RecurrentSpec

SPEC = EntitySpec(width=16, heads=2, layers=2)
GRU = RecurrentSpec(num_agents=2, num_targets=2, size=(5, 4), width=8)


def random_weights(init):
    shapes = jax.eval_shape(init, jax.random.key(0))
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda x: rng.normal(0, 0.3, x.shape).astype(np.float32), shapes)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "any.safetensors"
    params = random_weights(lambda key: entity.init(SPEC, key))
    save_policy(path, PolicyFile("entity", dataclasses.asdict(SPEC), params))
    return path


def moment(agents, targets, blocked=None):
    kinds = ["drone", "wheeled", "legged"][:agents] if blocked else None
    made = scenarios.generate(agents, num_agents=agents, num_targets=targets, size=(10, 8),
                              num_skills=3, max_steps=40, blocked=blocked, kinds=kinds)
    snapshot = Snapshot.start(made)
    solved = snapshot.solved.copy()
    solved[0] = True
    return dataclasses.replace(snapshot, solved=solved, step=9)


def seen(snapshot, preference=0.0):
    return onboard.inputs(
        snapshot.size, snapshot.cells, snapshot.agent_skills, snapshot.target_cells,
        snapshot.target_skills, snapshot.target_and, snapshot.solved,
        snapshot.max_steps - snapshot.step, preference, snapshot.agent_mask, snapshot.passable,
        snapshot.agent_kinds)


@pytest.mark.parametrize(("agents", "targets", "blocked"), [
    (2, 4, None), (3, 4, {"drone": 0.0, "wheeled": 0.3, "legged": 0.2})])
def test_numpy_alone_builds_what_the_network_sees(agents, targets, blocked):
    snapshot = moment(agents, targets, blocked)
    fields = None if blocked is None else learned.fields_of(snapshot, targets)
    look = jax.jit(entity.look, static_argnums=1)
    view = look(learned.state_of(snapshot), snapshot.max_steps, jnp.float32(0.4), fields)
    found = seen(snapshot, 0.4)
    assert set(found) == set(view.__dataclass_fields__)
    for name, value in found.items():
        np.testing.assert_array_equal(value[0], getattr(view, name), err_msg=name)


def test_the_file_takes_any_team_and_decides_alike(path):
    onnxruntime = pytest.importorskip("onnxruntime")
    policy = Policy.load(path)
    session = onnxruntime.InferenceSession(model_of(policy))
    for agents, targets, blocked in ((1, 1, None), (2, 5, None), (8, 40, None),
                                     (3, 5, {"drone": 0.0, "wheeled": 0.3, "legged": 0.2})):
        snapshot = moment(agents, targets, blocked)
        inputs = seen(snapshot, 0.25)
        log_probs, pointer = session.run(["log_probs", "pointer"], inputs)
        assert pointer.shape == (1, agents, targets + 1)
        planner = LearnedPlanner(policy, preference=0.25, watch=False)
        planner.reset(snapshot)
        assert onboard.choose(log_probs, inputs["allowed"]).tolist() == \
            planner.act(snapshot).tolist()


def test_the_command_prints_the_difference(path, tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    out = tmp_path / "sub" / "any.onnx"
    assert main(["export", str(path), "--out", str(out), "--states", "40", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["states"] >= 40
    assert report["largest"] < 1e-4
    assert report["agree"] == 1.0
    assert report["bytes"] == out.stat().st_size
    # Loaded where there is no JAX at all.
    code = ("import sys; sys.modules['jax'] = None\n"
            "from moonteam.policies.export.onboard import inputs, choose\n"
            "import onnxruntime as ort\n"
            f"session = ort.InferenceSession({str(out)!r})\n"
            "x = inputs((9, 9), [[0, 0], [8, 8]], [1, 2], [[4, 4]], [3], [True], [False], 60)\n"
            "print(choose(session.run(None, x)[0], x['allowed']).shape)\n"
            "print(session.get_modelmeta().custom_metadata_map['kind'])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=True)
    assert done.stdout.split() == ["(2,)", "entity"]


def test_the_recurrent_network_goes_too(tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    for memory in (True, False):
        spec = dataclasses.replace(GRU, memory=memory)
        path = tmp_path / f"{memory}.safetensors"
        config = {**dataclasses.asdict(spec), "size": list(spec.size)}
        params = random_weights(lambda key, spec=spec: recurrent.init(spec, key))
        save_policy(path, PolicyFile("recurrent", config, params))
        out = str(path.with_suffix(".onnx"))
        assert main(["export", str(path), "--out", out, "--states", "20"]) == 0
        assert "100.00%" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "says"), [
    (["--out", "x.bin"], "does not end in .onnx"), (["--states", "0"], "at least 1")])
def test_bad_wishes(path, words, says, capsys):
    assert main(["export", str(path), *words]) == 2
    assert says in capsys.readouterr().err


def test_without_the_extra_one_line_says_so(path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["export", str(path)]) == 2
    assert "pip install 'moonteam[export]'" in capsys.readouterr().err
