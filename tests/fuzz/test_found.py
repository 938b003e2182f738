"""What was found once: each a file that came out as something else than one line."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from moonteam import files, loading
from moonteam.errors import InputError
from moonteam.policies.policy import Policy
from moonteam.terrain import dem
from tests.fuzz import policies, states
from tests.fuzz.watch import answer
from training.run import checkpoints

DEMO = {"map": {"size": [8, 8]}, "robots": [
    {"name": "a", "kind": "drone", "skills": ["A"], "start": [0, 0]}],
    "targets": [{"name": "t", "at": [3, 3], "skills": ["A"]}]}
CLOCKED = DEMO | {"clock": "seconds"}
STEPS = {"size": [8, 8], "agents": [{"at": [0, 0], "skills": ["A"]}],
         "targets": [{"at": [3, 3], "skills": ["A"], "type": "OR"}]}
TIMED = {"clock": "seconds", "agents": [{"at": [0.0, 0.0], "skills": ["A"]}],
         "targets": [{"at": [3.0, 3.0], "skills": ["A"]}]}


def refusal(read, path):
    """The line, given within a second and without much memory."""
    assert answer(lambda: read(path)) == "refused"
    with pytest.raises(InputError) as refused:
        read(path)
    return str(refused.value)


def many(value, key, count, **each):
    """The value with its first `key` so many times."""
    one = value[key][0]
    return value | {key: [one | {name: make(i) for name, make in each.items()}
                          for i in range(count)]}


def more(value, key, **said):
    return value | {key: [value[key][0] | said]}


@pytest.mark.parametrize(("value", "line"), [
    (DEMO | {"map": {"size": [10**9, 10**9]}}, "map.size: [1000000000, 1000000000] is not allowed"),
    (DEMO | {"max_steps": 10**18}, "max_steps: 1000000000000000000 is not allowed; 1 to 100000"),
    (many(DEMO, "robots", 257, name=lambda i: f"r{i}"), "robots: is too long; at most 256"),
    (DEMO | {"targets": [{}] * 1025}, "targets: is too long; at most 1024"),
    (DEMO | {"events": [{}] * 1025}, "events: is too long; at most 1024"),
    (DEMO | {"site": {"preset": "mare", "seed": 2**31}}, "site.seed: 2147483648 is not allowed"),
    (more(DEMO, "robots", skills=["A"] * 65), "robots[0].skills: is too long; at most 64"),
    (more(DEMO, "robots", skills=["A" * 101]), "robots[0].skills[0]: is too long; at most 100"),
    (more(DEMO, "targets", skills=["\x1b[31m"]), r"no robot has skill \x1b[31m; the team has A"),
    (DEMO | {"a\u2028b": 1}, "unknown key `a b`"),
    (DEMO | {"a\0b": 1}, r"unknown key `a\x00b`"),
    (more(CLOCKED, "robots", speed=1e-300), "robots[0].speed: 1e-300 is not allowed; at least"),
    (CLOCKED | {"max_seconds": 1e300}, "max_seconds: 1e+300 is not allowed; above 0, at most"),
    (CLOCKED | {"events": [{"at_s": 1e300, "lost": "a"}]}, "events[0].at_s: 1e+300 is not allow"),
    (CLOCKED | {"events": [{"at_s": 1, "target": {"at": [1, 1], "skills": ["A"],
                                                  "service": 1e300}}]},
     "events[0].target.service: 1e+300 is not allowed"),
    (CLOCKED | {"events": [{"at_s": 1, "target": {"at": [1, 1], "coalition": {"A": 2}}}]},
     "events[0].target.coalition.A: 2 robots with it are needed; the team has 1"),
    (DEMO | {"map": {"size": [1024, 1024]}, "targets": [
        {"at": [i % 30, i // 30], "skills": ["A"]} for i in range(300)]}, "map.size: [1024, 1024]"),
    (DEMO | {"events": [{"at_decision": 10**30, "lost": "a"}]}, "1 to 100000"),
    (more(DEMO, "targets", at=[10**400, 15]), "the number 100000000000..., 401 characters is too"),
], ids=lambda value: value[:30] if isinstance(value, str) else "")
def test_missions(tmp_path, value, line):
    path = tmp_path / "m.yaml"
    path.write_text(json.dumps(value))
    assert line in refusal(loading.load, path)


def test_a_mission_is_written_as_it_was_read(tmp_path):
    """A name that YAML would take for two lines."""
    odd = "a\x85b\u2028c\x7fd\ufeff"
    (tmp_path / "m.yaml").write_text(json.dumps(DEMO | {"site": {"preset": odd}}))
    found = loading.load(tmp_path / "m.yaml")
    assert found.site.preset == odd
    files.write_json(tmp_path / "again.yaml", found)
    assert loading.load(tmp_path / "again.yaml") == found


@pytest.mark.parametrize(("text", "line"), [
    (r'name: "\ud800"', "half a character"),
    ("name: " + "x" * (1 << 19), "is too long: 524,294 characters"),
    ("robots: [&a {name: a}" + ", *a" * 131_072 + "]", "is too long"),
])
def test_texts_of_missions(tmp_path, text, line):
    path = tmp_path / "m.yaml"
    path.write_text(text)
    assert line in refusal(loading.load, path)


@pytest.mark.parametrize(("value", "line"), [
    (many(STEPS, "agents", 257), "agents: is too long; at most 256"),
    (STEPS | {"size": [1024, 1024], "blocked": {"*": [[1, 1]]},
              "targets": [STEPS["targets"][0] | {"at": [i, 1]} for i in range(1024)]},
     "is too much for maps of closed cells"),
    (STEPS | {"optimal": {"makespan": 10**30}}, "optimal.makespan: Expected `int` <= 2147483647"),
    (STEPS | {"x" * 100_000: 1}, "xxx ... xxx"),
    (more(STEPS, "agents", at=[[[[]]]]), "agents[0].at: Expected `array` of length 2"),
    (more(TIMED, "agents", home=[3e16, 0.0]), "agents[0].speed: 1 is too slow: ways may take up"),
    (more(TIMED, "agents", speed=1e-300), "agents[0].speed: 1e-300 is too slow"),
    (more(TIMED, "targets", service=1e300), "targets[0].service: 1e+300 is not allowed"),
    (more(TIMED, "targets", lapses=1e300), "targets[0].lapses: 1e+300 is not allowed"),
    (TIMED | {"targets": [TIMED["targets"][0] | {"after": [*range(max(0, j - 1000), j)]}
                          for j in range(1024)] + [{}]}, "targets: is too long"),
], ids=lambda value: value[:30] if isinstance(value, str) else "")
def test_problems(tmp_path, value, line):
    path = tmp_path / "s.json"
    path.write_text(json.dumps(value))
    assert line in refusal(loading.load, path)


def test_texts_of_problems(tmp_path):
    path = tmp_path / "s.jsonl"
    path.write_text('{"a": ' + "[" * 3000)
    assert "nested too deeply" in refusal(loading.load, path)
    path.write_text(json.dumps(STEPS) + '\n{"\\udfff": 1}')
    assert "line 2: holds half a character" in refusal(loading.load, path)


def test_a_thousand_targets_each_after_all_before(tmp_path):
    """Found by thinking: a circle was looked for in time that grew with the cube."""
    chain = [TIMED["targets"][0] | {"at": [float(j), 0.0], "after": [*range(j)]}
             for j in range(300)]
    path = tmp_path / "s.json"
    path.write_text(json.dumps(TIMED | {"targets": chain}))
    assert answer(lambda: loading.load(path)) == "read"


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="no such device")
def test_a_file_without_an_end(tmp_path):
    (tmp_path / "m.yaml").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="is too long: more than 128 MiB"):
        loading.load(tmp_path / "m.yaml")


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """A policy file: the header, what it says of the network, and the arrays' bytes."""
    folder = tmp_path_factory.mktemp("right")
    policies.seeds(folder)
    data = (folder / "pointer.safetensors").read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    return data[8:8 + length].decode(), data[8 + length:]


POLICIES = {
    "length beyond the file": ({"length": 10**6}, "not a policy file (safetensors)"),
    "length of terabytes": ({"length": 2**62}, "not a policy file (safetensors)"),
    "shape overflows": ({"first": {"shape": [2**40, 2**40]}}, "not a policy file (safetensors)"),
    "terabytes": ({"first": {"shape": [10**12], "data_offsets": [0, 4 * 10**12]}},
                  "not a policy file (safetensors)"),
    "unknown kind of numbers": ({"first": {"dtype": "F7"}}, "not a policy file (safetensors)"),
    "whole numbers": ({"first": {"dtype": "I32"}}, "is stored as I32; F32 is needed"),
    "a name twice": ({}, "is given twice"),
    "a branch that is an array": ({}, "is there, and"),
    "no JSON": ({"said": "{"}, "moonteam: is not JSON"),
    "a list": ({"said": "[]"}, "not a policy of format moonteam-policy-1"),
    "a key too many": ({"also": {"a": 1}}, "moonteam: unknown key `a`"),
    "kind is a list": ({"also": {"kind": []}}, "moonteam.kind: Expected `str`"),
    "numbers are a list": ({"also": {"config": []}}, "moonteam.config: Expected `object`"),
    "another network": ({"also": {"kind": "entity"}}, "parameter "),
    "another width": ({"config": {"width": 8}}, "this network needs"),
    "a billion layers": ({"config": {"layers": 10**9}}, "layers (1000000000) is not allowed"),
    "a billion wide": ({"config": {"width": 10**9}}, "width (1000000000) is not allowed"),
    "a billion pairs": ({"config": {"pairs": 10**9}}, "pairs (1000000000) is not allowed"),
    "no heads": ({"config": {"heads": 0}}, "heads (0) is not allowed; 1 to 4096"),
    "a billion robots": ({"also": {"kind": "recurrent", "config": {
        "num_agents": 10**9, "num_targets": 1, "size": [8, 8]}}}, "not the numbers of a policy"),
    "not a number": ({"arrays": True}, "is not all numbers"),
}


@pytest.mark.parametrize("case", POLICIES)
def test_policies(tmp_path, right, case):
    change, line = POLICIES[case]
    text, arrays = right
    header = json.loads(text)
    name = next(name for name in header if name != "__metadata__")
    header[name] |= change.get("first", {})
    said = json.loads(header["__metadata__"]["moonteam"])
    said["config"] |= change.get("config", {})
    header["__metadata__"]["moonteam"] = change.get(
        "said", json.dumps(said | change.get("also", {})))
    if case == "a branch that is an array":
        other = [one for one in header if one != "__metadata__"][1]
        header[f"{name}/x"] = header.pop(other)
    words = json.dumps(header)
    if case == "a name twice":
        words = words[:-1] + f", {json.dumps(name)}: {json.dumps(header[name])}" + "}"
    if "arrays" in change:
        arrays = b"\xff" * len(arrays)
    path = tmp_path / "p.safetensors"
    path.write_bytes(struct.pack("<Q", change.get("length", len(words))) + words.encode() + arrays)
    assert line in refusal(Policy.load, path)


def test_a_policy_file_of_a_terabyte(tmp_path):
    """A file with a hole, which takes no room on the disk."""
    path = tmp_path / "p.safetensors"
    size = 10**12
    words = json.dumps({"x": {"dtype": "F32", "shape": [size // 4], "data_offsets": [0, size]}})
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(words)) + words.encode())
        file.truncate(8 + len(words) + size)
    assert "bytes; at most 268,435,456" in refusal(Policy.load, path)


@pytest.fixture
def place(tmp_path):
    """A checkpoint of three arrays and a key, in a folder of an odd name."""
    states.seeds(tmp_path / "ü %41")
    return tmp_path / "ü %41" / "made" / "00000001"


def signed(place, **said):
    """With the checksums of the files as they are now."""
    about = json.loads((place / "about.json").read_text())
    about |= {"files": checkpoints.checksums(place / "learner")} | said
    (place / "about.json").write_text(json.dumps(about))
    return place


def test_a_right_checkpoint(place):
    assert answer(lambda: states.read(signed(place))) == "read"


def test_a_checkpoint_of_terabytes(place):
    """Its arrays are said to be zeros as far as they are not written."""
    import tensorstore as ts

    store = ts.KvStore.open({"driver": "ocdbt", "base": f"file://{quote(str(place))}/learner/"}).result()
    key = b"['params']['w']/.zarray"
    said = json.loads(store.read(key).result().value)
    said["shape"] = [10**13, 4]
    store.write(key, json.dumps(said).encode()).result()
    assert "['params']['w'] is float32[10000000000000, 4], this run needs float32[3, 4]" in (
        refusal(states.read, signed(place)))


@pytest.mark.parametrize(("said", "line"), [
    ({"update": -1}, "Expected `int` >= 0"), ({"total_updates": 10**30}, "is no whole checkpoint"),
    ({"network": []}, "Expected `object`, got `array`"), ({"seconds": -1.0}, "Expected `float` >="),
])
def test_what_a_checkpoint_says_of_itself(place, said, line):
    assert line in refusal(states.read, signed(place, **said))


@pytest.mark.parametrize("name", ["manifest.ocdbt", "d/*"])
def test_a_checkpoint_whose_parts_are_wrong_though_signed(place, name):
    for path in (place / "learner").glob(name):
        path.write_text("{}")
    assert "is no whole checkpoint" in refusal(states.read, signed(place))


@pytest.mark.parametrize("header", [
    "{'descr': '>i2', 'fortran_order': False, 'shape': (20, -24)}", "{'descr': (", "'a", "[" * 999,
    "{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 9999999999)}",
    "{'descr': '|O', 'fortran_order': False, 'shape': (4, 4)}"])
def test_arrays(tmp_path, header):
    path = tmp_path / "m.npy"
    path.write_bytes(b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode()
                     + bytes(999))
    assert "is not a NumPy array file" in refusal(lambda path: dem.window(path, pixel=1.0), path)


def test_an_archive_of_arrays(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.zeros((9, 9)))
    path = (tmp_path / "a.npz").rename(tmp_path / "a.npy")
    assert "is not a NumPy array file" in refusal(lambda path: dem.window(path, pixel=1.0), path)
