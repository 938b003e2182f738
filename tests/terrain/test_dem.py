"""Elevation models as people publish them: one known surface in many files."""

import itertools
import math
import tracemalloc

import numpy as np
import pytest
import rasterio
import rasterio.transform
from affine import Affine
from rasterio.enums import MaskFlags
from rasterio.warp import transform

from moonteam.errors import InputError
from moonteam.problem.piece import Piece
from moonteam.terrain import dem
from moonteam.terrain.site import import_dem

MOON = "+proj=stere +lat_0=-85 +lon_0=10 +R=1737400 +no_defs"
METRES = {"m": 1.0, "km": 1000.0, "us-ft": 1200 / 3937}
TURNS = {  # columns and rows, of unit length, m east and north
    "north up": ((1, 0), (0, -1)), "south up": ((1, 0), (0, 1)), "mirrored": ((-1, 0), (0, -1)),
    "upside down": ((-1, 0), (0, 1)), "on its side": ((0, 1), (1, 0)),
    "turned": ((math.cos(0.5), math.sin(0.5)), (math.sin(0.5), -math.cos(0.5))),
    "sheared": ((1, 0), (0.3, -1)), "turned and mirrored": ((0.6, 0.8), (0.8, -0.6))}
STORED = {  # dtype, elevation units a metre, the same in the band's tags, offset m
    "float32": ("float32", 1.0, "m", 0.0), "float64 km": ("float64", 1e-3, "km", 0.0),
    "float32 ft": ("float32", 1 / 0.3048, "ft", 0.0), "int16": ("int16", 4000.0, None, 0.0),
    "uint16": ("uint16", 4000.0, None, -6.0), "int32 radius": ("int32", 4000.0, None, 1_737_400.0),
    "float64 radius": ("float64", 1.0, "metre", 0.0)}


def surface(x, y):
    """m, smooth, up to about 8° steep."""
    return 2.0 * np.sin(x / 23) * np.cos(y / 17 + 0.3) + 0.03 * x - 0.05 * y


def write(path, turn="north up", shape=(1.0, 1.0), unit="m", stored="float32", compress=None,
          mask=None, crs=True, size=(160, 150)):
    """The surface around a model's centre, pixels of half a metre by `shape`."""
    (a, d), (b, e) = ((np.array(axis) * 0.5 * s).tolist()
                      for axis, s in zip(TURNS[turn], shape, strict=True))
    columns, rows = size
    c, r = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    heights = surface(a * c + b * r, d * c + e * r)
    dtype, per_metre, said, offset = STORED[stored]
    if stored == "float64 radius":
        heights = heights + 1_737_400.0
    values = (heights - (offset if dtype.startswith(("int", "uint")) else 0.0)) * per_metre
    if stored == "int32 radius":
        values = heights * per_metre
    if dtype != "float32" and not dtype.startswith("float"):
        values = np.round(values)
    values = values.astype(dtype)
    hole = np.zeros(values.shape, bool)
    hole[3:6, 4:9] = True  # in a corner, outside the window
    nodata = {"int16": -32768, "uint16": 65535}.get(dtype, -9999)
    if mask is not None:
        values[hole] = nodata
    k = 1 / METRES[unit]
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=mask == "internal"), rasterio.open(
            path, "w", driver="GTiff", width=columns, height=rows, count=1, dtype=dtype,
            compress=compress, nodata=nodata if mask == "nodata" else None,
            crs=f"{MOON} +units={unit}" if crs else None,
            transform=Affine(a * k, b * k, 70_000.0, d * k, e * k, -50_000.0)) as out:
        out.write(values, 1)
        if said:
            out.units = (said,)
        else:
            out.scales, out.offsets = (1 / per_metre,), (offset,)
        if mask in ("internal", "beside"):
            out.write_mask(~hole)
    return path


def check(path, centre=(3.1, -4.2), **more):
    """Heights to 1 mm, slopes to 0.1°, everywhere in a window of 24 by 20 m."""
    site = import_dem(path, Piece((24.0, 20.0), centre), detail=False, **more)
    y, x = (site.spacing * (np.arange(n) - (n - 1) / 2) for n in site.heights.shape)
    want = surface(centre[0] + x[None, :], centre[1] + y[:, None])
    off = site.heights - want
    assert np.abs(off - off.mean()).max() < 1e-3
    slopes = [np.degrees(np.arctan(np.hypot(*np.gradient(h, site.spacing))))
              for h in (site.heights.astype(float), want)]
    assert np.abs(slopes[0] - slopes[1]).max() < 0.1
    return site


CASES = [*itertools.product(TURNS, ((1.0, 1.0), (1.5, 1.0), (0.8, 1.3)))]


@pytest.mark.parametrize("number", range(len(CASES)))
def test_one_surface_in_every_orientation_and_shape(tmp_path, number):
    """Units, kinds of numbers, compression and masks go round with them: each with each turn."""
    turn, shape = CASES[number]
    for k in range(3):
        at = 3 * number + k
        check(write(tmp_path / f"{k}.tif", turn, shape, [*METRES][at % 3],
                    [*STORED][at % len(STORED)], [None, "deflate", "lzw", "zstd"][at % 4],
                    [None, "nodata", "internal", "beside"][(at // 2) % 4]))


@pytest.mark.parametrize("stored", STORED)
@pytest.mark.parametrize("mask", [None, "nodata", "internal", "beside"])
def test_one_surface_in_every_kind_of_numbers(tmp_path, stored, mask):
    path = write(tmp_path / "m.tif", stored=stored, mask=mask, compress="deflate")
    if mask is not None:
        with rasterio.open(path) as source:
            assert MaskFlags.all_valid not in source.mask_flag_enums[0]
    check(path)


def test_a_straight_model_comes_pixel_by_pixel(tmp_path):
    """North up, south up and mirrored give the same bits, and the window is all that is read."""
    found = [dem.window(write(tmp_path / f"{i}.tif", turn, size=(160, 150)), Piece(20.0,
                        (4.25, 2.25)))
             for i, turn in enumerate(("north up", "south up", "mirrored", "upside down"))]
    for other in found[1:]:
        np.testing.assert_allclose(other.heights, found[0].heights, atol=1e-6)
        assert other.pixel == found[0].pixel == 0.5


def test_holes_and_special_values_inside_the_window(tmp_path):
    path = write(tmp_path / "m.tif", stored="float32")
    with rasterio.open(path, "r+") as source:
        values = source.read(1)
        values[70, 80], values[71, 81] = -3.4028226550889044e38, np.nan
        source.write(values, 1)
    window = dem.window(path, Piece(20.0))
    assert np.isnan(window.about).sum() == 2
    assert np.isfinite(window.heights).all()
    assert np.ptp(import_dem(path, Piece(20.0), detail=False).heights) < 5.0


def test_a_reference_system_that_cannot_be_parsed_is_one_line(tmp_path, monkeypatch):
    """Found by the fuzzer; such a file is opened by one GDAL and not by another."""
    def fail(path):
        raise rasterio.errors.CRSError("The WKT could not be parsed. OGR Error code 5")

    path = write(tmp_path / "m.tif")
    monkeypatch.setattr(rasterio, "open", fail)
    with pytest.raises(InputError, match=r"m\.tif: is not a GeoTIFF.*The WKT could not be parsed"):
        dem.window(path, Piece(8.0))


def test_a_hole_that_is_a_signalling_nan_is_a_hole(tmp_path):
    """Found by the fuzzer: NumPy warned of the number, which is none, of another kind."""
    heights = np.full((20, 20), 5.0, np.float32)
    heights.view(np.uint32)[9, 9] = 0x7F800001
    np.save(tmp_path / "h.npy", heights)
    found = dem.window(tmp_path / "h.npy", Piece(10.0), pixel=1.0)
    assert np.allclose(found.heights, 5.0)


def test_an_isis_cube(tmp_path):
    values = np.full((40, 40), 100, np.int16) + np.arange(40, dtype=np.int16)
    values[20, 18:23] = [-32768, -32767, -32766, -32765, -32764]
    with rasterio.open(tmp_path / "m.cub", "w", driver="ISIS3", width=40, height=40, count=1,
                       dtype="int16", transform=Affine(1, 0, 500, 0, -1, 900)) as out:
        out.write(values, 1)
    label = (tmp_path / "m.cub").read_bytes()
    (tmp_path / "m.cub").write_bytes(label.replace(b"Multiplier = 1.0", b"Multiplier = .01"))
    window = dem.window(tmp_path / "m.cub")
    assert np.isnan(window.about).sum() == 5
    np.testing.assert_allclose(window.core[0], 1.0 + 0.01 * np.arange(40), atol=1e-9)


def test_what_is_given_replaces_what_the_file_says(tmp_path):
    path = write(tmp_path / "m.tif", stored="float64 km")
    heights = dem.window(path).heights
    np.testing.assert_allclose(dem.window(path, scale=500.0).heights, heights / 2, rtol=1e-9)
    assert dem.window(path, pixel=1.0).pixel == 1.0
    plain = write(tmp_path / "plain.tif", crs=False)
    check(plain)


def test_a_large_model_is_not_read_as_a_whole(tmp_path):
    """30,000 by 30,000 pixels, of which a window of 160 by 160 is looked at."""
    with rasterio.open(tmp_path / "m.tif", "w", driver="GTiff", width=30_000, height=30_000,
                       count=1, dtype="float32", tiled=True, compress="deflate", sparse_ok=True,
                       crs=MOON, transform=Affine(0.25, 0, 0, 0, -0.25, 0)):
        pass
    tracemalloc.start()
    site = import_dem(tmp_path / "m.tif", Piece(40.0, (3000.0, -3000.0)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.ptp(site.heights) == 0.0
    assert peak < 200e6


@pytest.mark.parametrize(("change", "words"), [
    ({"crs": "+proj=longlat +R=1737400 +no_defs"},
     r"project it to metres, such as by: gdalwarp .*\+lat_0=.* \+R=1737400"),
    ({"units": ("fathom",)}, "elevations in 'fathom', which is not known"),
    ({"turn": "turned", "size": None}, "how large a piece of it is needed"),
    ({"turn": "turned", "size": 70.0}, "is too small: .* and lacks"),
    ({"shape": (1.0, 1.4), "size": 90.0}, "is too small: .* and lacks"),
    ({"size": 1.0, "wide": 5.0}, "is too coarse"),
    ({"shape": (1.0, 2.0), "size": 1.0, "wide": 5.0}, "is too coarse"),
])
def test_what_cannot_be_ground_is_one_line(tmp_path, change, words):
    path = write(tmp_path / "m.tif", turn=change.get("turn", "north up"),
                 shape=change.get("shape", (1.0, 1.0)))
    with rasterio.open(path, "r+") as source:
        if "crs" in change:
            source.crs, source.transform = change["crs"], Affine(1e-5, 0, 10, 0, -1e-5, -85)
        if "units" in change:
            source.units = change["units"]
    with pytest.raises(InputError, match=words) as refused:
        import_dem(path, Piece(change.get("size", 20.0)), pixel=change.get("wide"))
    assert "\n" not in str(refused.value)


def test_points_in_place_of_a_grid_and_other_drivers_are_refused(tmp_path):
    from rasterio.control import GroundControlPoint

    flat = np.zeros((20, 20), np.float32)
    points = [GroundControlPoint(r, c, float(c), float(-r)) for r in (0, 19) for c in (0, 19)]
    with rasterio.open(tmp_path / "p.tif", "w", driver="GTiff", width=20, height=20, count=1,
                       dtype="float32", gcps=points, crs=MOON) as out:
        out.write(flat, 1)
    with pytest.raises(InputError, match="control points; resample it first"):
        import_dem(tmp_path / "p.tif")
    (tmp_path / "far.vrt").write_text(
        '<VRTDataset rasterXSize="9" rasterYSize="9"><VRTRasterBand dataType="Float32" band="1">'
        "<SimpleSource><SourceFilename>/vsicurl/http://example.org/x.tif</SourceFilename>"
        "</SimpleSource></VRTRasterBand></VRTDataset>")
    with pytest.raises(InputError, match="is not a GeoTIFF, nor another"):
        import_dem(tmp_path / "far.vrt")


def test_a_centre_is_said_in_metres_pixels_or_degrees(tmp_path):
    """The same place of one model in each unit, whatever way its rows and columns run."""
    for k, (turn, shape) in enumerate(CASES):
        path = write(tmp_path / f"{k}.tif", turn, shape, [*METRES][k % 3])
        east, north = 3.1, -4.2
        with rasterio.open(path) as source:
            move, factor = source.transform, METRES[[*METRES][k % 3]]
            x, y = rasterio.transform.xy(move, source.height / 2, source.width / 2, offset="ul")
            x, y = x + east / factor, y + north / factor
            row, column = (float(v) - 0.5 for v in rasterio.transform.rowcol(
                move, x, y, op=lambda value: value))
            longitude, latitude = (float(found[0]) for found in transform(
                source.crs, "+proj=longlat +R=1737400", [x], [y])[:2])
        found = [dem.window(path, Piece((24.0, 20.0), (east, north))),
                 dem.window(path, Piece(None, (column, row), "pixels"), need=(24.0, 20.0)),
                 dem.window(path, Piece(None, (latitude, longitude), "degrees"),
                            need=(24.0, 20.0))]
        for one in found:
            np.testing.assert_allclose(one.centre, (east, north), atol=1e-3)
            assert one.sides == (24.0, 20.0)
            np.testing.assert_allclose(one.heights, found[0].heights, atol=1e-3)


def test_a_size_is_said_in_pixels_or_degrees(tmp_path):
    path = write(tmp_path / "m.tif", shape=(1.5, 1.0))  # pixels of 0.75 by 0.5 m
    assert dem.window(path, Piece((40, 60), units="pixels")).sides == (30.0, 30.0)
    with rasterio.open(path) as source:
        longitude, latitude = (float(found[0]) for found in transform(
            source.crs, "+proj=longlat +R=1737400", [70_000.0 + 60], [-50_000.0 - 37])[:2])
    degree = math.radians(1.0) * 1_737_400.0  # m of latitude
    piece = Piece((20 / degree, 16 / degree / math.cos(math.radians(latitude))),
                  (latitude, longitude), "degrees")
    width, height = dem.window(path, piece).sides
    # The projection is true to scale at its own centre, 86 km away.
    assert width == pytest.approx(16.0, rel=2e-3)
    assert height == pytest.approx(20.0, rel=2e-3)


@pytest.mark.parametrize("degrees", [30.0, -90.0, 200.0])
def test_a_window_is_turned_clockwise(tmp_path, degrees):
    path = write(tmp_path / "m.tif", "mirrored", size=(200, 200))
    site = import_dem(path, Piece((24.0, 20.0), (3.1, -4.2), rotation=degrees), detail=False)
    y, x = (site.spacing * (np.arange(n) - (n - 1) / 2) for n in site.heights.shape)
    x, y = np.meshgrid(x, y)
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    want = surface(3.1 + x * cos + y * sin, -4.2 - x * sin + y * cos)
    off = site.heights - want
    assert np.abs(off - off.mean()).max() < 1e-3
    again = dem.window(path, Piece((24.0, 20.0), (3.1, -4.2), rotation=degrees - 360.0 * (
        degrees > 0))).heights
    np.testing.assert_array_equal(
        again, dem.window(path, Piece((24.0, 20.0), (3.1, -4.2), rotation=degrees)).heights)


@pytest.mark.parametrize("turn", ["north up", "upside down", "on its side"])
def test_a_map_needs_its_own_ground_and_no_more(tmp_path, turn):
    """32 m of ground for 32 m; the margin about it goes on as the ground does at the edge."""
    path = write(tmp_path / "m.tif", turn, size=(64, 64))
    found = dem.window(path, need=(32.0, 32.0), margin=4.0)
    assert found.sides == (40.0, 40.0)
    assert found.made_up == 4.0
    y, x = (0.5 * (np.arange(n) - (n - 1) / 2) for n in found.core.shape)
    off = found.core - surface(x[None, :], y[:, None])
    inside = off[9:-9, 9:-9]
    assert np.abs(inside - inside.mean()).max() < 0.01
    # A steep tilt goes on over the edge; without it the margin would be a kink or a terrace.
    up, across = np.gradient(found.core, 0.5)
    slope = np.hypot(up, across)
    assert slope[:8].max() < 1.6 * slope[9:-9, 9:-9].max()
    larger = dem.window(write(tmp_path / "l.tif", turn, size=(80, 80)), need=(32.0, 32.0),
                        margin=4.0)
    assert larger.made_up == 0.0
    with pytest.raises(InputError, match=r"34 by 32 m of ground are needed around 0 m east, 0 m "
                       r"north of its centre; it is 32 by 32 m and lacks 1 m .*, 1 m [^,]*$"):
        dem.window(path, need=(34.0, 32.0), margin=4.0)


def test_what_is_lacking_is_said_by_its_side(tmp_path):
    path = write(tmp_path / "m.tif", "upside down", size=(64, 64))
    with pytest.raises(InputError, match=r"and lacks 8 m in the east, 2 m in the south$"):
        dem.window(path, Piece(20.0, (14.0, -8.0)))
    with pytest.raises(InputError, match=r"turned by 45 degrees; .* lacks 3.8 m in the east, "):
        dem.window(path, Piece(28.0, rotation=45.0))


@pytest.mark.parametrize(("piece", "crs", "words"), [
    (Piece(20.0, (91.0, 0.0), "degrees"), True, "centre: 91, 0 is not allowed; a latitude of -90"),
    (Piece(20.0, None, "degrees"), True, "centre: is needed where units are degrees"),
    (Piece(0.001, (-85.0, 10.0), "degrees"), False, "units: has no projection"),
    (Piece(0.001, (85.0, 190.0), "degrees"), True, "centre: latitude 85, longitude 190 is not on"),
    (Piece(0.001, (-85.0, 10.0), "degrees"), True, "too small: .* and lacks "),
    (Piece(20.0, (-85.0, 10.0), "degrees"), True, "size: 20 degrees of latitude and 20 .* a pole"),
    (Piece(20.0, rotation=400.0), True, "rotation: 400 is not allowed; -360 to 360 degrees"),
    (Piece((20.0, 0.0)), True, "size: 0 is not allowed; above 0 metres"),
    (Piece(None, (1.0, 1.0)), True, "size: how large a piece of it is needed must be said"),
    (Piece(20.0, (math.nan, 1.0), "pixels"), True, "centre: nan, 1 is not allowed; two finite"),
])
def test_a_piece_that_cannot_be_is_one_line(tmp_path, piece, crs, words):
    path = write(tmp_path / "m.tif", crs=crs)
    with pytest.raises(InputError, match=f"^{path}: .*{words}") as refused:
        dem.window(path, piece)
    assert "\n" not in str(refused.value)


def test_an_array_has_pixels_but_no_latitude(tmp_path):
    heights = np.arange(400.0).reshape(20, 20)
    np.save(tmp_path / "h.npy", heights)
    found = dem.window(tmp_path / "h.npy", Piece(4, (10, 5), "pixels"), pixel=10.0)
    assert found.centre == (5.0, 45.0)
    assert found.sides == (40.0, 40.0)
    assert found.heights[found.heights.shape[0] // 2, found.heights.shape[1] // 2] == heights[5, 10]
    with pytest.raises(InputError, match=r"h\.npy: units: says nothing of latitude"):
        dem.window(tmp_path / "h.npy", Piece(4, (10, 5), "degrees"), pixel=10.0)
