import math

import numpy as np
import pytest

from moonteam.cli import main
from moonteam.errors import InputError
from moonteam.problem import mission as missions
from moonteam.problem.mission import Map, Mission, Robot, Target
from moonteam.problem.mission import Site as MissionSite
from moonteam.problem.piece import Piece
from moonteam.robots import KINDS, OWN
from moonteam.robots.team import limits
from moonteam.terrain import generate
from moonteam.terrain.measure import crater_counts, measure, poisson_interval, slope_map
from moonteam.terrain.site import for_mission, import_dem, make_site
from moonteam.terrain.traversability import passable_cells

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
    for back in (import_dem(tmp_path / "a.tif"), import_dem(tmp_path / "a.npy", pixel=0.25)):
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
    raw = import_dem(path, Piece(40.0), pixel=2.0)
    level = import_dem(path, Piece(40.0), pixel=2.0, detrend=True)
    assert np.ptp(raw.heights) > 3.5
    assert 0.2 < np.ptp(level.heights) < 1.5


def test_detail_is_finer_than_the_model_and_seeded(tmp_path):
    path = coarse(tmp_path)
    made = [import_dem(path, Piece(30.0), pixel=2.0, detail=d, seed=s).heights
            for d, s in ((False, 1), (True, 1), (True, 1), (True, 2))]
    curvature = [np.abs(np.diff(h, 2, axis=0)).mean() for h in made]
    assert curvature[1] > 1.5 * curvature[0]
    assert made[1].tobytes() == made[2].tobytes()
    assert made[1].tobytes() != made[3].tobytes()


def test_the_window_is_where_it_is_asked_for(tmp_path):
    y, x = np.mgrid[0:41, 0:41].astype(float)
    np.save(tmp_path / "d.npy", (0.2 * np.exp(-((x - 30) ** 2 + (y - 10) ** 2) / 4)))
    # Column 30 is 10 m east of the middle; row 10 of a picture is 10 m north of it.
    site = import_dem(tmp_path / "d.npy", Piece(8.0, (10.0, 10.0)), pixel=1.0)
    assert np.unravel_index(site.heights.argmax(), site.heights.shape) == (16, 16)


def test_small_holes_are_filled(tmp_path):
    heights = np.full((40, 40), 5.0)
    heights[10:13, 20:22] = np.nan
    np.save(tmp_path / "h.npy", heights)
    assert np.ptp(import_dem(tmp_path / "h.npy", pixel=1.0).heights) < 1e-3


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
        ("ok.tif", {"size": 100.0}, "too small"),
        ("ok.tif", {"size": 10.0, "centre": (18.0, 0.0)}, "too small"),
        ("holes.npy", {"pixel": 1.0}, "no data"),
        ("cube.npy", {"pixel": 1.0}, "rows, columns"),
        ("text.npy", {"pixel": 1.0}, "rows, columns"),
        ("cliff.npy", {"pixel": 1.0}, "not in metres"),
        ("flat.npy", {"pixel": 1e6}, "0.01 to 1000"),
        ("flat.npy", {}, "metres a pixel"),
        ("tiny.npy", {"pixel": 1.0}, "too small"),
        ("flat.npy", {"pixel": 10.0, "size": 5.0}, "too coarse"),
        ("flat.npy", {"pixel": math.nan}, "0.01 to 1000"),
        ("flat.npy", {"pixel": 1.0, "size": math.nan}, "not allowed"),
        ("flat.npy", {"pixel": 1.0, "size": 10.0, "centre": (math.nan, 0.0)},
         "finite"),
        ("flat.npy", {"pixel": 1.0, "scale": math.inf}, "finite"),
        ("nothing.tif", {}, "no data"),
    ]


@pytest.mark.parametrize("index", range(19))
def test_bad_elevation_models_get_one_line_and_exit_code_2(tmp_path, capsys, index):
    name, arguments, words = bad_models(tmp_path)[index]
    given = dict(arguments)
    piece = Piece(given.pop("size", None), given.pop("centre", None))
    with pytest.raises(InputError, match=words) as caught:
        import_dem(tmp_path / name, piece, **given)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)
    asked = [word for key, value in arguments.items() for word in (
        f"--{key}", *map(str, value if isinstance(value, tuple) else (value,)))]
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


def mission_on(folder, heights, site, size="[8, 8]"):
    """A mission's file with its model of 1 m pixels beside it."""
    np.save(folder / "moon.npy", heights)
    path = folder / "mission.yaml"
    path.write_text(f"""
map: {{size: {size}}}
site: {{dem: moon.npy, pixel: 1.0, {site}}}
robots: [{{name: r, kind: wheeled, skills: [A], start: [0, 0]}}]
targets: [{{at: [3, 3], skills: [A]}}]
""")
    return path


def test_a_mission_says_which_piece_of_a_model_it_stands_on(tmp_path, monkeypatch):
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0)[::-1])
    heights = 0.1 * x + 0.01 * (y - 5) ** 2
    monkeypatch.chdir(tmp_path.parent)  # the file is beside the mission, not here
    site = for_mission(missions.load(mission_on(
        tmp_path, heights, "units: pixels, centre: [12, 9], rotation: 90, detail: false")))
    assert site.meta["centre_m"] == [2.5, 0.5]
    assert site.meta["made_up_m"] == 0.5
    assert site.extent == (8.0, 8.0)
    middle = site.heights.shape[0] // 2
    # Its north is the model's east, which rises by a tenth, and its east the model's south.
    north = site.heights[middle + 12, middle] - site.heights[middle - 12, middle]
    east = site.heights[middle, middle + 12] - site.heights[middle, middle - 12]
    assert north == pytest.approx(0.1 * 6, abs=0.01)
    assert east == pytest.approx(0.01 * (2 ** 2 - 8 ** 2), abs=0.01)


def test_a_mission_chooses_whether_detail_is_added_and_slopes_are_taken_out(tmp_path):
    y, x = np.mgrid[:40, :40] * 1.0
    heights = 0.2 * x + 0.3 * np.sin(x / 2) * np.cos(y / 3)
    made = {site: for_mission(missions.load(mission_on(tmp_path, heights, site))).heights
            for site in ("seed: 1", "seed: 1, detail: false", "seed: 2, detail: false",
                         "detail: false, detrend: true")}
    plain, rough = made["seed: 1, detail: false"], made["seed: 1"]
    np.testing.assert_array_equal(plain, made["seed: 2, detail: false"])
    assert 1e-4 < np.abs(plain - rough).max() < 0.5
    assert np.ptp(made["detail: false, detrend: true"]) < np.ptp(plain) - 2.0


@pytest.mark.parametrize(("site", "size", "words"), [
    ("detail: false", "[12, 9]", "site.dem: {dem}: is too small: 12 by 9 m of ground are needed "
     "around 0 m east, 0 m north of its centre; it is 8 by 8 m and lacks 2 m in the west, 2 m in "
     "the east, 0.5 m in the north, 0.5 m in the south"),
    ("size: 6", "[8, 8]", "site.size: {dem}: 6 by 6 m is not allowed; the map alone is 8 by 8 m"),
    ("centre: [1, 0]", "[8, 8]", "site.dem: {dem}: is too small: 8 by 8 m of ground are needed "
     "around 1 m east, 0 m north of its centre; it is 8 by 8 m and lacks 1 m in the east"),
    ("units: degrees, centre: [1, 0]", "[8, 8]", "site.units: {dem}: says nothing of latitude"),
    ("band: 0", "[1024, 1024]", "site.dem: {dem}: is too small"),
])
def test_ground_that_a_model_cannot_give_is_said_of_the_mission(tmp_path, capsys, site, size,
                                                               words):
    path = mission_on(tmp_path, np.zeros((8, 8)), site, size)
    out = tmp_path / "out"
    for command in (["rollout", str(path), "--planner", "greedy", "--out", str(out)],
                    ["evaluate", "execution", "--mission", str(path), "--planner", "greedy",
                     "--out", str(out)]):
        assert main(command) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1
        assert words.format(dem=tmp_path / "moon.npy") in told
        assert str(path.name) in told
        assert not out.exists() or [*out.iterdir()] == []


def test_a_map_as_large_as_its_model_is_open_to_its_edge(tmp_path):
    """8 m of ground for 8 m: no robot is kept off the outermost cells."""
    found = missions.load(mission_on(tmp_path, np.zeros((8, 8)), "detail: false"))
    kinds = {name: KINDS.get(name) for name in OWN}
    site = for_mission(found)
    for name, cells in passable_cells(site, found, limits(kinds, site)).items():
        assert cells.all(), name
