"""Exported pointing policies: the same logits, moments and choices without JAX."""

import dataclasses
import json
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from moonteam.cli import main
from moonteam.commands.export import model_of
from moonteam.evaluation import exported
from moonteam.grid.macro import draw, world
from moonteam.grid.macro.draw import Draw
from moonteam.grid.macro.types import FAR
from moonteam.policies import pointer
from moonteam.policies.export import onboard_pointer
from moonteam.policies.pointer import Outlook, PointerSpec
from moonteam.policies.policy import Policy
from moonteam.policies.policy_file import PolicyFile, save_policy

SPEC = PointerSpec(width=16, heads=2, layers=2, pairs=8)
FAMILY = Draw(agents=(2, 4), targets=(3, 7), num_skills=3, metric="either", speeds=(0.5, 1.0),
              unlike=0.5, service=1.0, numbers=2, homes=0.5)
EPISODES = 16


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "points.safetensors"
    shapes = jax.eval_shape(partial(pointer.init, SPEC), jax.random.key(0))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: rng.normal(0, 0.3, x.shape).astype(np.float32), shapes)
    save_policy(path, PolicyFile("pointer", dataclasses.asdict(SPEC), params))
    return path


def outlook(rng, batch, agents, targets, skills):
    """Anything that the types allow, but at least one agent and one target."""
    def flag(*shape):
        return rng.random((batch, *shape)) < 0.6

    def time(*shape):
        values = rng.uniform(0, 4, (batch, *shape)).astype(np.float32)
        return np.where(rng.random(values.shape) < 0.2, np.float32(pointer.LONG), values)

    n, m, s = agents, targets, skills
    view = {
        "agents": flag(n), "targets": flag(m), "free": flag(n), "spare": time(n), "slow": time(n),
        "travel": time(n, m), "between": time(m, m), "goal": flag(n, m), "has": flag(n, s),
        "lacks": rng.integers(0, 3, (batch, m, s)).astype(np.int32), "either": flag(m),
        "service": time(m), "ready": time(m), "left": time(m), "after": flag(m, m),
        "home": time(n, m), "preference": rng.random(batch).astype(np.float32)}
    view["agents"][:, 0] = view["targets"][:, 0] = True
    return view


def test_the_file_takes_any_team_and_any_skills(path):
    onnxruntime = pytest.importorskip("onnxruntime")
    policy = Policy.load(path)
    session = onnxruntime.InferenceSession(model_of(policy))
    assert {one.name for one in session.get_inputs()} == {
        field.name for field in dataclasses.fields(Outlook)} - {"ahead", "worth"}
    rng, point = np.random.default_rng(1), jax.jit(pointer.point, static_argnums=1)
    for batch, agents, targets, skills in ((1, 1, 1, 1), (3, 4, 7, 5), (2, 9, 20, 8)):
        view = outlook(rng, batch, agents, targets, skills)
        known = point(policy.params, SPEC, Outlook(**view)).logits
        said = session.run(["logits"], view)[0]
        np.testing.assert_allclose(said, known, atol=1e-4, rtol=1e-5)


def drawn(kind):
    """Problems [E]: as drawn, with order and windows, or on ground that some cannot cross."""
    keys = jax.random.split(jax.random.key(3), EPISODES)
    made = jax.vmap(partial(draw.draw, FAMILY))(keys)
    rng = np.random.default_rng(3)
    shape = made.service.shape
    if kind == "windows":
        before = np.tril(rng.random((*shape, shape[1])) < 0.15, -1)
        appears = np.where(rng.random(shape) < 0.3, rng.integers(0, 40, shape), 0)
        shown = np.where(rng.random(shape) < 0.5, appears, 0)
        lapses = np.where(rng.random(shape) < 0.3, rng.integers(60, 200, shape), FAR)
        floats = [jnp.asarray(x, jnp.float32) for x in (appears, shown, lapses)]
        made = dataclasses.replace(made, after=jnp.asarray(before), appears=floats[0],
                                   shown=floats[1], lapses=floats[2])
    if kind == "ground":
        lost = jnp.asarray(rng.random(made.start.shape) < 0.15)
        made = dataclasses.replace(
            made, start=jnp.where(lost, FAR, made.start),
            between=jnp.where(lost[:, :, :, None] | lost[:, :, None], FAR, made.between))
    return made


def aboard(state, preference):
    """The moment of one episode as a robot would tell it: from now, in NumPy."""
    state = jax.tree.map(np.asarray, state)
    p, now = state.problem, state.now
    return onboard_pointer.moment(
        np.asarray(world.legs(p, state.node)), p.between, p.has, p.need, goal=state.goal,
        busy=state.busy, solved=state.solved, serving=state.serving, either=p.either,
        known=now >= p.shown - world.SOON, service=p.service, after=p.after,
        appears=p.appears - now, lapses=np.where(p.lapses < FAR, p.lapses - now, FAR),
        home=p.home, team=p.agent_mask, start=p.start, unit=p.unit, preference=preference)


@jax.jit
def decided(state, logits, likings):
    choice, _ = jax.vmap(world.choose)(state, logits, jnp.zeros_like(logits))
    step = jax.vmap(world.step)(state, choice)
    loose = jax.vmap(world.loosen)(step.state, jnp.ones(choice.shape, bool))
    return (jax.vmap(pointer.look)(state, likings), choice, step.state, loose,
            step.terminated | step.truncated)


@pytest.mark.parametrize("kind", ["drawn", "windows", "ground"])
def test_numpy_alone_builds_what_the_network_sees_and_settles_choices_alike(kind):
    rng = np.random.default_rng(5)
    state = jax.jit(jax.vmap(world.reset))(drawn(kind))
    likings = np.linspace(0, 1, EPISODES).astype(np.float32)
    going, moments, turned = np.ones(EPISODES, bool), 0, 0
    for _ in range(8):
        logits = rng.normal(0, 2, (*state.goal.shape, state.solved.shape[1] + 1))
        logits = logits.astype(np.float32)
        view, choice, after, loose, over = jax.device_get(decided(state, logits, likings))
        for e in np.flatnonzero(going).tolist():
            own = aboard(jax.tree.map(lambda x, e=e: x[e], state), likings[e])
            said = onboard_pointer.inputs(own)
            assert [*said, "ahead", "worth"] == list(view.__dataclass_fields__)
            for name, value in said.items():
                want = getattr(view, name)[e]
                assert value[0].dtype == want.dtype, name
                np.testing.assert_allclose(value[0], want, atol=2e-4, rtol=1e-4, err_msg=name)
            assert onboard_pointer.choose(own, logits[e]).tolist() == choice[e].tolist()
            moments += 1
        going = going & ~over
        for e in np.flatnonzero(going).tolist():
            bound, want = (jax.tree.map(lambda x, e=e: x[e], s) for s in (after, loose))
            found = onboard_pointer.loosen(aboard(bound, likings[e]), want.problem.start)
            assert found.goal.tolist() == want.goal.tolist()
            for name, value in onboard_pointer.inputs(found).items():
                expected = onboard_pointer.inputs(aboard(want, likings[e]))[name]
                np.testing.assert_allclose(value, expected, atol=2e-4, rtol=1e-4, err_msg=name)
            turned += int((want.goal != bound.goal).sum())
        state = loose
    assert moments > 60
    assert turned > 20


def test_the_unit_is_that_of_the_drawn_problem():
    made = jax.device_get(drawn("drawn"))
    for e in range(EPISODES):
        unit = onboard_pointer.unit_of(made.start[e], made.has[e], made.need[e])
        assert unit == pytest.approx(float(made.unit[e]), rel=1e-5)
        plain = onboard_pointer.moment(made.start[e], made.between[e], made.has[e], made.need[e])
        assert plain.unit == unit


def test_the_command_prints_the_difference(path, tmp_path, capsys, monkeypatch):
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(exported, "FAMILIES", (FAMILY,))
    out = tmp_path / "points.onnx"
    assert main(["export", str(path), "--out", str(out), "--states", "40", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["kind"] == "pointer"
    assert report["states"] >= 40
    assert report["largest"] < 1e-4
    assert report["agree"] == 1.0
    # Beside a copy of the one file, where there is neither JAX nor moonteam.
    shutil.copy(Path(str(onboard_pointer.__file__)), tmp_path / "onboard_pointer.py")
    code = ("import sys; sys.modules['jax'] = sys.modules['moonteam'] = None\n"
            "from onboard_pointer import moment, inputs, choose\n"
            "import onnxruntime as ort\n"
            f"session = ort.InferenceSession({str(out)!r})\n"
            "now = moment(ways=[[3, 9], [8, 4]], between=[[0, 7], [7, 0]],\n"
            "             has=[[True, False], [False, True]], need=[[1, 1], [0, 1]])\n"
            "choice = choose(now, session.run(['logits'], inputs(now))[0][0])\n"
            "print(choice.shape, set(choice.tolist()) <= {0, 1, 2}, min(choice) < 2)\n"
            "print(session.get_modelmeta().custom_metadata_map['builder'].split()[0])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                          check=True, cwd=tmp_path)
    assert done.stdout.split() == ["(2,)", "True", "True",
                                   "moonteam/policies/export/onboard_pointer.py"]
