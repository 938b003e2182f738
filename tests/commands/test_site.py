import json

import numpy as np
import pytest

from moonteam.cli import main


def test_a_site_is_made_measured_and_drawn(tmp_path, capsys):
    out = tmp_path / "site"
    assert main(["site", "--preset", "mare", "--seed", "3", "--size", "14", "--json",
                 "--out", str(out)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads((out / "site.json").read_text())
    assert report["seed"] == 3
    assert report["slope_deg"]["p50"] < 10
    assert set(report["traversable"]) == {"drone", "legged", "wheeled"}
    for name in ("hillshade", "slope", "roughness", "traversability"):
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    heights = np.load(out / "heights.npy")
    assert heights.shape == (57, 57)
    maps = np.load(out / "maps.npz")
    for kind, share in report["traversable"].items():
        able, seconds = maps[f"open_{kind}"], maps[f"seconds_{kind}"]
        assert able.shape == seconds.shape == (12, 12)
        assert able.mean() == pytest.approx(share, abs=1e-4)
        np.testing.assert_array_equal(np.isfinite(seconds), able)
        assert seconds[able].max() == pytest.approx(report["seconds_per_cell"][kind]["most"],
                                                    abs=1e-3)

    assert main(["site", "--dem", str(out / "heights.tif"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["relief_m"] == pytest.approx(report["relief_m"], abs=1e-4)


def test_travel_is_told_and_drawn(tmp_path, capsys):
    words = ["site", "--preset", "mare", "--seed", "3", "--size", "18", "--travel", "wheeled",
             "--to", "2", "-3"]
    assert main([*words, "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["files"][-1] == str(tmp_path / "travel.png")
    assert (tmp_path / "travel.png").read_bytes().startswith(b"\x89PNG")
    travel = report["travel"]
    assert 0.5 < travel["reached"] <= 1.0
    assert len(travel["ways"]) == 4
    for way in travel["ways"]:
        assert way["points"][-1] == [2.0, -3.0]
        assert way["arrivals"][-1] == pytest.approx(way["seconds"], abs=2e-3)
        assert way["metres"] / 0.5 <= way["seconds"] * 1.001 <= travel["most_seconds"] * 1.05
    assert main([*words, "--start", "-6", "5"]) == 0
    assert "from -6, 5 m: " in capsys.readouterr().out


def test_light_and_shadow_are_told_and_drawn(tmp_path, capsys):
    words = ["site", "--preset", "polar", "--seed", "13", "--size", "24"]
    assert main([*words, "--sun", "45", "4", "--json", "--out", str(tmp_path)]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["files"][-1] == str(tmp_path / "light.png")
    assert (tmp_path / "light.png").read_bytes().startswith(b"\x89PNG")
    light = report["light"]
    assert (light["azimuth_deg"], light["elevation_deg"]) == (45.0, 4.0)
    assert 0.05 < light["lit"] < light["panels_lit"] < 0.95
    assert main([*words, "--sun-at", "-89.5", "12", "2027-03-20T12:00"]) == 0
    assert "degrees high at azimuth" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "told"), [
    (["--sun", "45", "99"], "--sun: elevation 99 is not allowed"),
    (["--sun-at", "-89", "0", "soon"], "--sun-at: time 'soon' is not allowed"),
    (["--sun", "45", "9", "--sun-at", "0", "0", "2027-03-20"], "not both"),
    (["--travel", "mule"], "mule"), (["--travel", "drone", "--to", "90", "0"], "off the map"),
    (["--travel", "drone", "--start", "0", "-90"], "off the map"),
    (["--size", "1"], "4 to 1000"), (["--seed", "-1"], "--seed"), (["--cell", "0"], "--cell"),
    (["--dem", "nowhere.tif"], "no such file"),
])
def test_bad_input_is_one_line_and_writes_nothing(tmp_path, capsys, words, told):
    out = tmp_path / "none"
    assert main(["site", *words, "--out", str(out)]) == 2
    message = capsys.readouterr().err
    assert told in message
    assert message.count("\n") == 1
    assert not out.exists()
