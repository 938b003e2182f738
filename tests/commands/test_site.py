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


@pytest.mark.parametrize(("words", "told"), [
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
