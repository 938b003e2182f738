"""The replay in 3-D: what is packed comes back, it stays small, and Chromium plays it."""

import base64
import hashlib
import json
import re
import struct
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from moonteam import paths
from moonteam.problem.mission import Target
from sim2grid.loop.prepare import prepare
from sim2grid.loop.record import Decision, Leg, Loss, Record, Solve
from sim2grid.measure.story import Story
from sim2grid.show import page, replay
from tests.browser import needs_chromium, visit

SECONDS, PERIOD = 20.0, 0.04


def unpacked(text):
    """Head and array reader of a block, written as the page's script reads it."""
    whole = zlib.decompress(base64.b64decode(text))
    length = struct.unpack("<I", whole[:4])[0]

    def array(where):
        kind, at, size = where
        return np.frombuffer(whole, "<" + kind, size, 4 + length + at)

    return json.loads(whole[4:4 + length]), array


def rebuilt(head, array):
    """Poses [K, C] of a block."""
    its = head["poses"]
    numbers = array(its["data"]).reshape(len(its["low"]), -1)
    numbers = np.cumsum(numbers, axis=1, dtype=np.uint64) & 0xffff
    return (np.array(its["low"])[:, None] + np.array(its["step"])[:, None] * numbers).T


@pytest.fixture(scope="module")
def told(mission):
    """A mission and the record of 20 s in which every robot goes 3 m east and turns its joints."""
    spec = mission(["a drone A 1 1", "b wheeled B 1 3", "c legged C 1 5"],
                   ["A OR 4 1", "B OR 4 3", "C OR 4 5"], size=(8, 8),
                   site={"preset": "highland", "seed": 2})
    prepared = prepare(spec, "test")
    times = np.arange(0, SECONDS + 1e-9, PERIOD)
    qpos = np.tile(prepared.scene.qpos0, (len(times), 1))
    for base, robot in zip(prepared.bases, prepared.scene.robots, strict=True):
        qpos[:, base] += 3.0 * times / SECONDS
        qpos[:, base + 7:robot.qpos.stop] += 0.3 * np.sin(times)[:, None]
    record = Record(list(spec.targets), ["one", "two", "three"])
    record.log(times, qpos, np.zeros((len(times), 3)), np.zeros((len(times), 3)))
    start = [prepared.frame.centre(np.array(r.start, float)) for r in spec.robots]
    for i in range(3):
        record.legs.append(Leg(i, 0, 3, (1, 2 * i + 1), (4, 2 * i + 1), start[i],
                               start[i] + [3.0, 0.0], 0.0, 30.0, 18.0, "arrived"))
        record.solves.append(Solve(i, 1, 18.0, (i,), (0.1,)))
    record.solves.pop()
    record.losses.append(Loss(2, "stuck", 1, 19.0))
    return Story(spec, record, prepared.frame, prepared.bases), prepared


def test_three_js_is_the_published_file_and_its_licence_is_kept(told):
    folder = paths.assets() / "replay"
    digest = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest()[:12]
              for name in replay.LIBRARY}
    assert digest == {"three.module.min.js": "08fd7545d13d", "OrbitControls.js": "80efaadea4f8"}
    assert "Copyright © 2010-2024 three.js authors" in replay.replay(*told)


def test_poses_come_back_within_a_millimetre(told):
    story, prepared = told
    head, array = unpacked(replay.mission_data(story, prepared, 25.0))
    keep = replay.kept(story.times, 25.0)
    assert len(keep) == len(story.times) == len(array(head["poses"]["times"]))
    assert np.abs(rebuilt(head, array) - story.qpos[keep]).max() < 1e-3
    assert set(head["robots"][0]) >= {"name", "colour", "legs", "choices", "slip"}
    assert [r["choices"] for r in head["robots"]][1] == [[0.0, "right, to cell 4, 3"]]


def test_ground_and_rocks_come_back(told):
    story, prepared = told
    head, array = unpacked(replay.mission_data(story, prepared, 1.0))
    its = head["ground"]["heights"]
    heights = its["low"][0] + its["step"][0] * array(its["data"]).astype(float)
    assert heights == pytest.approx(prepared.site.heights.ravel(), abs=1e-3)
    assert len(head["boulders"]) == len(prepared.site.boulders) > 0
    assert array(head["ground"]["shut"]).any()


def test_what_is_not_a_number_keeps_its_place(told):
    story, _ = told
    poses = story.qpos[:5].astype(float)
    poses[2:, 3] = np.nan
    assert replay._known(poses)[4, 3] == poses[1, 3]


def test_kept_rows_are_spread_and_hold_both_ends():
    assert replay.kept(np.arange(0, 10.01, 0.01), 2.0).tolist() == list(range(0, 1001, 50))
    assert replay.kept(np.array([0.0, 1.0]), 25.0).tolist() == [0, 1]


def test_a_replay_is_never_larger_than_it_may_be(told, monkeypatch):
    story, prepared = told
    whole = len(replay.replay(story, prepared))
    assert whole < replay.LARGEST
    monkeypatch.setattr(replay, "LARGEST", whole - 500)
    assert len(replay.replay(story, prepared)) <= whole - 500


def test_targets_and_events_say_when(told):
    story, _ = told
    assert [t["solved"] for t in replay._targets(story)] == [18.0, 18.0, None]
    assert [[e[0], e[1]] for e in replay._events(story)] == [
        [18.0, "solved"], [18.0, "solved"], [19.0, "lost"]]
    story.record.targets.append(Target((2, 2), ("A",)))
    story.record.target_names.append("late")
    try:
        assert replay._targets(story)[3]["known"] == 0.0
    finally:
        story.record.targets.pop()
        story.record.target_names.pop()


def test_by_the_clock_a_choice_is_a_target_and_a_service_is_not_left():
    record = Record([Target((4, 1), ("A",), service=6.0), Target((4, 3), ("A",))], ["one", "two"])
    nobody = np.zeros((1, 2), np.int32)
    record.legs.append(Leg(0, 0, 5, (1, 1), (4, 1), np.zeros(2), np.ones(2), 0.0, 30.0,
                           expected_s=5.0))
    record.decisions += [Decision(k, time, nobody, np.array([choice]), np.zeros(2, bool))
                         for k, (time, choice) in enumerate([(0.0, 0), (8.0, -2), (12.0, 1),
                                                             (20.0, -1)])]
    record.solves.append(Solve(0, 1, 12.0, (0,), (0.1,)))
    said = replay._choices(SimpleNamespace(record=record), 0, record.legs)
    assert said == [(0.0, "goes for one"), (12.0, "goes for two"), (20.0, "waits")]


READY = """
  if (!window.moonteamReplay) await new Promise(
    go => document.addEventListener('moonteam-replay', go));
"""
PROBE = READY + """
  const replay = window.moonteamReplay, clock = document.querySelector('.clock');
  const told = () => document.querySelector('.told').textContent;
  const slide = time => { clock.value = time; clock.dispatchEvent(new Event('input')); };
  found.start = replay.positions();
  found.turns = replay.turns();
  found.open = replay.states();
  slide(10);
  found.time = replay.time();
  found.halfway = replay.positions();
  found.turned = replay.turns();
  const canvas = document.querySelector('.replay canvas');
  canvas.scrollIntoView();
  const [clientX, clientY] = replay.seen('b');
  for (const kind of ['pointerdown', 'pointerup']) canvas.dispatchEvent(
    new PointerEvent(kind, { clientX, clientY, button: 0, pointerId: 1 }));
  found.selected = replay.selected();
  found.told = told();
  slide(19.5);
  found.solved = replay.states();
  replay.select('c');
  found.lost = told();
  replay.seek(0);
  replay.play(20);
  const begun = Date.now();
  while (replay.time() <= 1 && Date.now() < begun + 20000)
    await new Promise(go => requestAnimationFrame(go));
  found.played = replay.time();
  replay.pause();
  slide(15);
  await new Promise(go => requestAnimationFrame(() => requestAnimationFrame(go)));
"""


@needs_chromium
def test_chromium_plays_it_from_a_file(told, tmp_path):
    story, prepared = told
    text = page.page("replay", [replay.replay(story, prepared)])
    seen = visit(text, tmp_path, PROBE, size=(900, 640))
    found = seen.found
    assert [c for c in seen.complaints if "GPU stall" not in c] == []
    for i, name in enumerate("abc"):
        where = [found[when][name] for when in ("start", "halfway")]
        assert where[0] == pytest.approx(story.qpos[0, prepared.bases[i]:][:3], abs=2e-3)
        assert where[1][0] - where[0][0] == pytest.approx(1.5, abs=2e-3)
    assert found["turned"] != found["turns"]
    assert found["time"] == 10
    assert found["open"] == {"one": "open", "two": "open", "three": "open"}
    assert found["solved"] == {"one": "solved", "two": "solved", "three": "open"}
    assert found["selected"] == "b"
    assert re.fullmatch(r"b, wheeled B · moving · 0\.15 m/s · slip -?\d\.\d\d · "
                        r"right, to cell 4, 3", found["told"])
    assert "lost: stuck" in found["lost"]
    assert found["played"] > 1.0
    assert seen.fits
    assert seen.picture.stat().st_size > 20_000
    narrow = visit(text, tmp_path / "narrow", READY, size=(390, 640))
    assert narrow.fits
    assert [c for c in narrow.complaints if "GPU stall" not in c] == []
