"""What the environment of a process does to a command: one line, or no difference."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

BY_HAND = """
import jax
import jax.numpy as jnp

assert jax.config.jax_enable_x64
from moonteam.grid import env
from moonteam.grid.config import EnvConfig
from moonteam.grid.macro import draw, world

key, replanning = jax.random.key(0), EnvConfig(num_buffer=5)
state, _ = env.reset(replanning, key)
after = env.step(replanning, state, jnp.zeros(3, jnp.int32)).state
assert jax.tree.map(lambda x: x.dtype, after) == jax.tree.map(lambda x: x.dtype, state)


def played(key):
    state = world.reset(draw.draw(draw.Draw(), key))
    logits = jnp.zeros((3, state.goal.shape[0] + 5))
    choice, _ = world.choose(state, logits, logits)
    return state, world.loosen(world.step(state, choice).state, choice >= 0)


before, after = jax.eval_shape(played, key)
assert before == after

import moonteam

for policy in ("any_team", "any_team_imitated"):
    assert moonteam.plan("outpost", "policy", policy=policy).makespan <= 50
"""


def run(words, **environment):
    return subprocess.run(words, env=os.environ | environment, capture_output=True, text=True,
                          check=False)


def moonteam(*words, **environment):
    return run([sys.executable, "-m", "moonteam.cli", *words], **environment)


def test_a_process_of_64_bits():
    """Worlds keep their kinds of numbers and policies plan; a command does as it always does."""
    done = run([sys.executable, "-c", BY_HAND], JAX_ENABLE_X64="1")
    assert done.returncode == 0, done.stderr
    words = ["replay", "--help"]
    assert moonteam(*words, JAX_ENABLE_X64="1").stdout == moonteam(*words).stdout


@pytest.mark.parametrize(("name", "value", "words", "line"), [
    ("JAX_PLATFORMS", "cuda", ["plan", "outpost", "--planner", "policy"],
     "moonteam: JAX_PLATFORMS: there is no device of 'cuda' here"),
    ("MUJOCO_GL", "bogus", ["check", "robot", "wheeled"],
     "moonteam: MUJOCO_GL: 'bogus' is not allowed; one of: egl, osmesa, glfw, disable\n"),
])
def test_what_lets_nothing_run_is_named(name, value, words, line):
    done = moonteam(*words, **{name: value})
    assert done.returncode == 2
    assert done.stderr.splitlines(keepends=True)[-1].startswith(line)
    assert "Traceback" not in done.stderr


def test_doctor_says_that_there_is_no_such_device():
    done = moonteam("doctor", JAX_PLATFORMS="cuda")
    assert done.returncode == 0, done.stderr
    assert "none of JAX_PLATFORMS=cuda" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device")
def test_a_full_disk_and_a_file_in_the_way(tmp_path):
    file = tmp_path / "file"
    file.write_text("mine")
    for out, line in ((file / "run", f"{file}/run: Not a directory"),
                      (file, f"--out: {file} is a file; a folder is needed")):
        done = moonteam("plan", "outpost", "--planner", "exact", "--out", str(out))
        assert done.returncode == 2
        assert done.stderr.splitlines()[-1] == f"moonteam: {line}"
    assert file.read_text() == "mine"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-m", "moonteam.cli", "--help"], stdout=full,
                              stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "moonteam: No space left on device\n")


def test_a_reader_that_goes_away_is_no_error():
    words = [sys.executable, "-m", "moonteam.cli", "train", "any_team", "--help"]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(words, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")
