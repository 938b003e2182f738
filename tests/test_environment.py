"""What the environment of a process does to a command: one line, or no difference."""

import ast
import importlib
import inspect
import io
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from moonteam import cli, compilation, files
from moonteam.commands import options

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
    return subprocess.run(words, env=os.environ | environment, capture_output=True,
                          encoding="utf-8", check=False)


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
     "moonteam: MUJOCO_GL: 'bogus' is not one of egl, osmesa, glfw, disable\n"),
])
def test_what_lets_nothing_run_is_named(name, value, words, line):
    done = moonteam(*words, **{name: value})
    assert done.returncode == 2
    assert done.stderr.splitlines(keepends=True)[-1].startswith(line)
    assert "Traceback" not in done.stderr


def test_doctor_writes_what_it_prints(tmp_path):
    done = moonteam("doctor", "--licences", "--json", "--out", str(tmp_path / "out"))
    assert done.returncode == 0
    (file,) = (tmp_path / "out").iterdir()
    assert file.name == "doctor.json"
    assert json.loads(file.read_text()) == json.loads(done.stdout)


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


OWN = [path for package in ("src/moonteam", "training", "sim2grid")
       for path in sorted((Path(__file__).parents[1] / package).rglob("*.py"))]


def test_no_assert_guards_what_users_do():
    """PYTHONOPTIMIZE leaves them out: each only tells the type checker what is known already."""
    assert len(OWN) > 100
    for path in OWN:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Assert):
                said = ast.unparse(node.test)
                assert said.endswith(" is not None") or said.startswith(
                    ("isinstance(", "all((isinstance(")), f"{path}:{node.lineno}: {said}"


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_help_is_there_without_docstrings(name):
    kind = importlib.import_module(cli.COMMANDS[name][0]).Args
    assert inspect.getdoc(kind)
    assert options._docstring(kind) == inspect.getdoc(kind)


BARE = {"PYTHONOPTIMIZE": "2", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0",
        "PYTHONIOENCODING": "ascii", "COLUMNS": "100"}


def test_without_docstrings_locale_caches_and_home(tmp_path):
    """The same plan, and not a word about caches that cannot be written."""
    (tmp_path / "file").write_text("no folder")
    nowhere = str(tmp_path / "file" / "cache")
    bare = BARE | {"HOME": nowhere, "XDG_CACHE_HOME": nowhere, "XDG_CONFIG_HOME": nowhere,
                   "MOONTEAM_CACHE": nowhere, "MPLCONFIGDIR": nowhere}
    mission = tmp_path / "mond.yaml"
    mission.write_text(MISSION, encoding="utf-8")
    words = ["plan", str(mission), "--planner", "greedy", "--out"]
    plain = moonteam(*words, str(tmp_path / "a"), PYTHONUTF8="1")
    done = moonteam(*words, str(tmp_path / "b"), **bare)
    assert (plain.returncode, done.returncode) == (0, 0), done.stderr
    assert done.stderr == plain.stderr == ""
    assert "makespan 6 steps, 6 moves (Müller 6)" in plain.stdout
    assert "makespan 6 steps, 6 moves (M\\u00fcller 6)" in done.stdout
    assert plan_in(tmp_path / "b") == plan_in(tmp_path / "a")
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == ["plan.json", "plan.png"]


def plan_in(folder):
    return json.loads((folder / "plan.json").read_text(encoding="utf-8")) | {"seconds": None}


MISSION = """
name: Süd
map: {size: [8, 8], cell_m: 1.0}
site: {preset: flat, seed: 0}
max_steps: 50
robots:
  - {name: Müller, kind: wheeled, skills: [A], start: [0, 0]}
targets:
  - {name: Ziel, at: [3, 3], skills: [A], type: OR}
"""


def test_help_in_a_bare_environment():
    words = ["replay", "--help"]
    bare, plain = moonteam(*words, **BARE), moonteam(*words, COLUMNS="100")
    assert bare.returncode == 0, bare.stderr
    about = inspect.getdoc(importlib.import_module("moonteam.commands.replay").Args)
    assert "Print one JSON document and nothing else." in bare.stdout, "of an option"
    for line in about.splitlines():
        assert line.strip() in bare.stdout
        assert line.strip() in plain.stdout


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams(closed):
    words = f"exec '{sys.executable}' -m moonteam.cli --version {closed}"
    done = subprocess.run(["sh", "-c", words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_character_that_the_terminal_lacks_is_written_as_json_would():
    cli._mend_streams()
    text = "Süd 🌕 \udcff"
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="moonteam")
    print(files.dump_json("Süd 🌕"), text, file=out, flush=True)
    written = out.buffer.getvalue().decode("ascii")
    assert written == '"S\\u00fcd \\ud83c\\udf15" S\\u00fcd \\ud83c\\udf15 \\udcff\n'
    assert json.loads(f'"{written.strip().partition(chr(34) + " ")[2]}"') == text


def test_a_name_that_the_file_system_lacks(monkeypatch):
    monkeypatch.setattr(sys, "getfilesystemencoding", lambda: "ascii")
    assert files.safe_name("Mond: Süd", "mission") == "Mond-S-d"


def test_a_process_without_a_home(monkeypatch):
    for name in ("MOONTEAM_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)  # as where there is no such user
    assert compilation.cache_folder() == Path("~/.cache/moonteam")


DOUBLE = """
from moonteam.compilation import njit

@njit(cache=True)
def double(x):
    return 2 * x
"""


def test_numba_where_it_can_keep_nothing(tmp_path):
    """Neither beside the code nor in the user's folder."""
    (tmp_path / "doubled.py").write_text(DOUBLE)
    (tmp_path / "__pycache__").write_text("no folder")
    nowhere = str(tmp_path / "doubled.py" / "cache")
    done = run([sys.executable, "-c", "import doubled; print(doubled.double(21))"],
               HOME=nowhere, XDG_CACHE_HOME=nowhere,
               PYTHONPATH=os.pathsep.join([str(tmp_path), *sys.path]))
    assert (done.returncode, done.stdout) == (0, "42\n"), done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["__pycache__", "doubled.py"]
