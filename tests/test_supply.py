"""What comes from others: known by name, version and licence, and nothing runs that was read."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from functools import cache
from importlib import metadata
from pathlib import Path

import msgspec
import pytest
from packaging.utils import canonicalize_name

from moonteam import cli
from moonteam.report import licences

TOP = Path(__file__).parents[1]
SOURCES = [path for folder in ("src", "training", "sim2grid")
           for path in sorted((TOP / folder).rglob("*.py"))]
EXTRAS = {"ortools", "ray", "onnx", "onnxruntime", "tensorboardx", "chex", "jaxmarl", "gymnax"}
"""Imported where they are there: extras, and peers that are only measured."""
CODE = {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "torch", "jsonpickle"}
"""Modules that run what they read."""
TRANSPORT = (TOP / "src" / "moonteam" / "cluster.py", TOP / "sim2grid" / "show" / "studio.py")
"""Pickles go between processes of one's own, those of a Ray cluster and those that draw a film; no
file is read."""
CUT = """
import sys

def hook(event, args):
    if event in {"socket.connect", "socket.getaddrinfo", "socket.gethostbyname", "socket.sendto",
                 "socket.sendmsg", "socket.bind"}:
        with open(%r, "a") as file:
            print(event, args[1:], file=file)
        raise OSError(101, "the network is cut")

sys.addaudithook(hook)
"""
COMMANDS = (["plan", "outpost", "--planner", "exact", "--out", "plan"],
            ["evaluate", "grid", "2x3", "--limit", "2", "--planner", "greedy", "--planner",
             "policy", "--out", "grid"],
            ["doctor"], ["doctor", "--licences"])


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imported(path: Path) -> set[str]:
    """Top-level names of what a file imports."""
    found = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            found |= {one.name.split(".")[0] for one in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add((node.module or "").split(".")[0])
    return found


def test_licences_of_all_that_is_imported(capsys):
    """What the sources import is on the list, whatever the list was made from."""
    assert cli.main(["doctor", "--licences", "--json"]) == 0
    listed = {one["name"]: one for one in msgspec.json.decode(capsys.readouterr().out)}
    assert all(one["licence"] for one in listed.values()), listed
    homes = metadata.packages_distributions()
    names = set().union(*map(imported, SOURCES)) - set(sys.stdlib_module_names)
    needed = {canonicalize_name(home) for name in names for home in homes.get(name, [])[:1]}
    assert needed - EXTRAS <= set(listed), needed - EXTRAS - set(listed)
    assert len(needed - EXTRAS) > 15


def test_the_list_is_closed_and_pinned():
    """Whatever a listed package needs is listed, in the version that constraints.txt names."""
    listed = {one.name: one.version for one in licences.packages()}
    for name in set(listed) - {"moonteam"}:
        for line in metadata.requires(name) or ():
            if ";" not in line:
                assert canonicalize_name(re.split(r"[^\w.-]", line)[0]) in listed, (name, line)
    pins = dict(line.split("==") for line in (TOP / "constraints.txt").read_text().split())
    pinned = {canonicalize_name(name): version for name, version in pins.items()}
    assert {name: pinned.get(name) for name in listed if name != "moonteam"} == {
        name: version for name, version in listed.items() if name != "moonteam"}


def test_nothing_that_is_read_is_run():
    """No pickle nor its kin, no eval, arrays without objects, YAML without constructors."""
    for path in SOURCES:
        assert path in TRANSPORT or not imported(path) & CODE, path
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                given = {word.arg: ast.unparse(word.value) for word in node.keywords}
                assert harmless(called, given), f"{path}:{node.lineno}: {called}"
                assert path not in TRANSPORT or called not in {"open", "files.read_bytes"}, called


def harmless(called: str, given: dict[str | None, str]) -> bool:
    if called in {"eval", "exec", "compile", "__import__", "yaml.unsafe_load", "yaml.full_load"}:
        return False
    if called in {"np.load", "numpy.load"} or "allow_pickle" in given:
        return given.get("allow_pickle") == "False"
    return called != "yaml.load" or given["Loader"] == "loader"  # CSafeLoader or SafeLoader


@pytest.mark.parametrize("line", [
    "eval(text)", "exec(open(path).read())", "np.load(path)", "np.load(path, allow_pickle=True)",
    "yaml.load(text, Loader=yaml.Loader)", "np.save(path, array, allow_pickle=True)"])
def test_what_would_run_is_seen(line):
    node = ast.parse(line, mode="eval").body
    assert isinstance(node, ast.Call)
    assert not harmless(ast.unparse(node.func),
                        {word.arg: ast.unparse(word.value) for word in node.keywords})


def test_no_command_needs_the_network(tmp_path):
    """Every process, children too, has no sockets to the outside, and asks for none."""
    (tmp_path / "sitecustomize.py").write_text(CUT % str(tmp_path / "asked"))
    run = f"import sys; from moonteam.cli import main; sys.exit(max(map(main, {COMMANDS})))"
    where = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    done = subprocess.run([sys.executable, "-c", run], cwd=tmp_path, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": where}, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "plan" / "plan.png").stat().st_size > 0
    assert not (tmp_path / "asked").exists(), (tmp_path / "asked").read_text()
    probe = "import socket; socket.create_connection(('192.0.2.1', 9), 1)"
    cut = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True,
                         env=os.environ | {"PYTHONPATH": where}, check=False)
    assert "the network is cut" in cut.stderr
