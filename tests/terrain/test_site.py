import math

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.problem.mission import Map, Mission, Robot, Target
from moonteam.problem.mission import Site as MissionSite
from moonteam.terrain import generate
from moonteam.terrain.measure import crater_counts, measure, poisson_interval, slope_map
from moonteam.terrain.site import for_mission, import_dem, make_site

PRESETS = list(generate.PRESETS)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_same_seed_gives_the_same_bits_and_another_does_not(preset):
    one, two, other = (make_site(preset, seed, 16.0) for seed in (5, 5, 6))
    assert one.heights.dtype == np.float32
    assert one.heights.tobytes() == two.heights.tobytes()
    assert [b.centre.tobytes() + b.vertices.tobytes() for b in one.boulders] == [
        b.centre.tobytes() + b.vertices.tobytes() for b in two.boulders]
    assert np.abs(one.heights - other.heights).max() > 0.05


def test_presets_differ_in_slope_as_they_should():
    def median(preset: str) -> float:
        return float(np.mean([np.degrees(np.median(slope_map(make_site(preset, s, 32.0), 1.0)))
                              for s in range(2)]))

    mare, highland, polar = median("mare"), median("highland"), median("polar")
    assert 1.0 < mare < 5.0
    assert 4.5 < highland < 12.0
    assert 4.0 < polar < 12.0


def test_mare_is_mostly_gentle_and_nowhere_past_the_angle_of_repose():
    for seed in range(3):
        degrees = np.degrees(slope_map(make_site("mare", seed, 32.0), 0.5))
        assert np.percentile(degrees, 75) < 8.0
        assert degrees.max() < 37.0


def test_the_middle_of_a_crater_rim_is_a_crest():
    site = make_site("crater_rim", 2, 32.0)
    rim = [i for i, r in enumerate(site.meta["craters"]["rim"]) if r]
    assert len(rim) == 1
    assert site.heights[64, 64] > np.percentile(site.heights, 80)


def test_craters_are_counted_within_what_the_law_allows():
    counted = expected = 0.0
    for seed in range(4):
        rows = crater_counts(make_site("highland", seed, 32.0))
        counted += sum(row["counted"] for row in rows)
        expected += sum(row["expected"] for row in rows)
    low, high = poisson_interval(expected)
    assert low <= counted <= high


def test_poisson_interval_holds_its_share():
    assert poisson_interval(0.01) == [0, 0]
    assert poisson_interval(10.0) == [4, 17]


def test_boulders_stand_out_of_the_ground_where_they_should():
    site = make_site("crater_rim", 3, 32.0)
    assert len(site.boulders) >= 3
    for boulder in site.boulders:
        ground = float(site.surface.height(np.array(boulder.centre[:2], np.float32)))
        top = boulder.centre[2] + boulder.radius
        assert 0.1 < top - ground < 1.2 * boulder.radius + boulder.radius
        assert boulder.reach(ground) * 2 >= 0.99 * generate.OBSTACLE_DIAMETER
        reach = np.linalg.norm(boulder.vertices, axis=1)
        assert 0.9 * boulder.radius < reach.min() <= reach.max() < 1.15 * boulder.radius


def test_a_missions_ground_covers_its_map_about_the_centre():
    mission = Mission(Map((10, 6), 1.5), (Robot("a", "drone", ("A",), (0, 0)),),
                      (Target((1, 1), ("A",)),), MissionSite(preset="flat"))
    site = for_mission(mission)
    assert site.extent[0] >= 7.5 + 2
    assert site.extent[1] >= 4.5 + 2
    assert site.heights.shape[1] > site.heights.shape[0]


@pytest.mark.parametrize(("kwargs", "word"), [
    ({"preset": "venus"}, "mare"), ({"extent_m": 1.0}, "4 to 1000"),
    ({"extent_m": 900.0}, "too many"), ({"spacing": 5.0}, "0.05 to 2"),
])
def test_sites_that_cannot_be_made_get_a_line(kwargs, word):
    with pytest.raises(InputError, match=word):
        make_site(**({"preset": "mare", "seed": 0, "extent_m": 16.0} | kwargs))


def test_a_written_model_comes_back_as_it_was(tmp_path):
    site = make_site("mare", 7, (20.0, 12.0))
    generate.write_dem(tmp_path / "a.tif", site.heights, site.spacing)
    np.save(tmp_path / "a.npy", site.heights[::-1])
    level = site.heights - site.heights.mean()
    for back in (import_dem(tmp_path / "a.tif"), import_dem(tmp_path / "a.npy", pixel_m=0.25)):
        assert back.heights.shape == site.heights.shape
        assert np.abs(back.heights - level).max() < 1e-5


def coarse(tmp_path, pixel=2.0):
    """A 2 m model of rough ground on a slope, and its file."""
    random = np.random.default_rng(3)
    y, x = np.mgrid[0:40, 0:40] * pixel
    heights = 0.1 * x + 0.3 * np.sin(x / 5) * np.cos(y / 7)
    heights += random.normal(scale=0.03, size=heights.shape)
    np.save(tmp_path / "c.npy", heights)
    return tmp_path / "c.npy"


def test_detrending_takes_the_slope_out_and_keeps_the_relief(tmp_path):
    path = coarse(tmp_path)
    raw = import_dem(path, pixel_m=2.0, extent_m=40.0)
    level = import_dem(path, pixel_m=2.0, extent_m=40.0, detrend=True)
    assert np.ptp(raw.heights) > 3.5
    assert 0.2 < np.ptp(level.heights) < 1.5


def test_detail_is_finer_than_the_model_and_seeded(tmp_path):
    path = coarse(tmp_path)
    made = [import_dem(path, pixel_m=2.0, extent_m=30.0, detail=d, seed=s).heights
            for d, s in ((False, 1), (True, 1), (True, 1), (True, 2))]
    curvature = [np.abs(np.diff(h, 2, axis=0)).mean() for h in made]
    assert curvature[1] > 1.5 * curvature[0]
    assert made[1].tobytes() == made[2].tobytes()
    assert made[1].tobytes() != made[3].tobytes()


def test_the_window_is_where_it_is_asked_for(tmp_path):
    y, x = np.mgrid[0:41, 0:41].astype(float)
    np.save(tmp_path / "d.npy", (0.2 * np.exp(-((x - 30) ** 2 + (y - 10) ** 2) / 4)))
    # Column 30 is 10 m east of the middle; row 10 of a picture is 10 m north of it.
    site = import_dem(tmp_path / "d.npy", pixel_m=1.0, extent_m=8.0, centre_m=(10.0, 10.0))
    assert np.unravel_index(site.heights.argmax(), site.heights.shape) == (16, 16)


def test_small_holes_are_filled(tmp_path):
    heights = np.full((40, 40), 5.0)
    heights[10:13, 20:22] = np.nan
    np.save(tmp_path / "h.npy", heights)
    assert np.ptp(import_dem(tmp_path / "h.npy", pixel_m=1.0).heights) < 1e-3


def bad_models(folder):
    """name -> (file, arguments, words of the message)."""
    flat = np.zeros((40, 40), np.float32)
    files = {"holes": np.where(np.eye(40) > 2, 0.0, np.nan), "cube": np.zeros((3, 3, 3)),
             "cliff": flat + 1000 * np.arange(40)[None, :], "tiny": np.zeros((3, 3)),
             "flat": flat, "text": np.array(["a", "b"])}
    for name, values in files.items():
        np.save(folder / f"{name}.npy", values)
    (folder / "words.tif").write_text("not a picture")
    (folder / "words.npy").write_text("not an array")
    generate.write_dem(folder / "ok.tif", flat, 1.0)
    generate.write_dem(folder / "nothing.tif", flat + np.nan, 1.0)
    return [
        ("missing.tif", {}, "no such file"),
        ("words.tif", {}, "not a GeoTIFF"),
        ("words.npy", {}, "not a NumPy"),
        ("ok.tif", {"band": 3}, "no band 3"),
        ("ok.tif", {"extent_m": 100.0}, "too small"),
        ("ok.tif", {"extent_m": 10.0, "centre_m": (18.0, 0.0)}, "too small"),
        ("holes.npy", {"pixel_m": 1.0}, "no data"),
        ("cube.npy", {"pixel_m": 1.0}, "rows, columns"),
        ("text.npy", {"pixel_m": 1.0}, "rows, columns"),
        ("cliff.npy", {"pixel_m": 1.0}, "not in metres"),
        ("flat.npy", {"pixel_m": 1e6}, "0.01 to 1000"),
        ("flat.npy", {}, "metres a pixel"),
        ("tiny.npy", {"pixel_m": 1.0}, "too small"),
        ("flat.npy", {"pixel_m": 10.0, "extent_m": 5.0}, "too coarse"),
        ("flat.npy", {"pixel_m": math.nan}, "0.01 to 1000"),
        ("flat.npy", {"pixel_m": 1.0, "extent_m": math.nan}, "not allowed"),
        ("flat.npy", {"pixel_m": 1.0, "extent_m": 10.0, "centre_m": (math.nan, 0.0)},
         "finite"),
        ("flat.npy", {"pixel_m": 1.0, "scale": math.inf}, "finite"),
        ("nothing.tif", {}, "no data"),
    ]


OPTIONS = {"pixel_m": "--pixel", "extent_m": "--size", "centre_m": "--centre",
           "band": "--band", "scale": "--scale"}


@pytest.mark.parametrize("index", range(19))
def test_bad_elevation_models_get_one_line_and_exit_code_2(tmp_path, capsys, index):
    name, arguments, words = bad_models(tmp_path)[index]
    with pytest.raises(InputError, match=words) as caught:
        import_dem(tmp_path / name, **arguments)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)
    asked = [word for key, value in arguments.items() for word in (
        OPTIONS[key], *map(str, value if isinstance(value, tuple) else (value,)))]
    assert main(["site", "--dem", str(tmp_path / name), *asked]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.count("\n") == 1
    assert words in told.err


def test_measure_reports_what_the_ground_is():
    report = measure(make_site("flat", 0, 12.0))
    assert report["slope_deg"]["p100"] == 0
    assert report["relief_m"] == 0
    report = measure(make_site("highland", 1, 24.0))
    assert report["samples"] == [97, 97]
    assert 0.5 < report["roughness"]["hurst"] <= 1.0
    assert report["slope_deg"]["p50"] < report["slope_deg"]["p95"] < report["slope_deg"]["p100"]
