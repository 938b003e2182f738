"""A window of an elevation model: heights in metres on a grid whose rows lead north.

Rasterio reads what agencies publish: whatever way its rows and columns run, whatever its pixels'
shape, units, masks, special values, scale and offset are. A model on a straight grid of square
pixels comes as it is; any other is resampled by cubic splines. Only the window is read.
"""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError

Heights = npt.NDArray[np.float64]
Named = str | os.PathLike[str]

MAX_MISSING = 0.05
"""Largest share of a window without data."""
AROUND = 4
"""Pixels that resampling looks at beside those that it is between, and some."""
MAX_PIXELS = 50_000_000
"""Of a window."""
MOST_KNOWN = 1024
"""Pixels a side that a spectrum is taken from."""
DRIVERS = ("GTiff", "ISIS3", "ISIS2", "PDS", "PDS4", "VICAR", "AAIGrid", "ENVI", "EHdr", "HFA")
"""Of GDAL: those of elevation models in one file of their own."""
HEIGHT_UNITS = {
    "": 1.0, "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0, "km": 1000.0,
    "kilometre": 1000.0, "kilometres": 1000.0, "kilometer": 1000.0, "kilometers": 1000.0,
    "cm": 0.01, "centimetre": 0.01, "centimeter": 0.01, "mm": 0.001, "dm": 0.1, "ft": 0.3048,
    "foot": 0.3048, "feet": 0.3048, "us survey foot": 1200 / 3937, "us-ft": 1200 / 3937,
    "ftus": 1200 / 3937}
"""m, by what a band says that its heights are in."""
_HUGE = 1e30  # special values of float models: ISIS writes about -3.4e38 for what is no height
_SPECIAL = {"int16": (-32752, 32767), "uint16": (3, 65533), "uint8": (1, 254)}
"""By ISIS, what is a height, lowest and highest; the rest says why there is none."""
_STRAIGHT = 1e-6  # of a pixel a pixel, that rows and columns may be off the axes, or off square


class Window(NamedTuple):
    """What was asked for, and `AROUND` pixels on each side, past the model's edge made up."""

    heights: Heights  # [rows, columns] m, row 0 in the south
    pixel: float  # m
    shift: tuple[float, float]  # m east and north, from the middle of `heights` to the centre asked
    about: Heights  # [rows, columns] m at the same pixel, more of the model, NaN where it has none
    scale: float  # that elevations were multiplied by, of the file's own or as given

    @property
    def core(self) -> Heights:
        """The window alone."""
        return self.heights[AROUND:-AROUND, AROUND:-AROUND]


def window(path: Named, *, band: int = 0, scale: float | None = None,
           pixel_m: float | None = None, extent_m: float | tuple[float, float] | None = None,
           centre_m: tuple[float, float] = (0.0, 0.0)) -> Window:
    """Heights of a part of a model.

    Args:
      path: of a raster in metres, or an .npy array [rows, columns], row 0 in the north.
      band: counted from 0.
      scale: metres a unit of elevation; None: as the file says, else 1.
      pixel_m: metres a pixel, where the file does not say or is wrong.
      extent_m: side, or (x, y) sides, m; None: all of it.
      centre_m: the window's centre from the model's centre, m east and north.

    Raises InputError: not readable, not in metres, too little of it, too many holes.
    """
    if not Path(path).is_file():
        raise InputError(path, "no such file")
    if Path(path).suffix.lower() == ".npy":
        return _array(path, pixel_m, extent_m, centre_m, 1.0 if scale is None else scale)
    return _raster(path, band, scale, pixel_m, extent_m, centre_m)


def _array(path: Named, pixel_m: float | None, extent_m: Any, centre_m: tuple[float, float],
           scale: float) -> Window:
    try:
        with Path(path).open("rb") as file:
            np.lib.format.read_magic(file)  # an archive of arrays begins otherwise
        with np.errstate(all="ignore"):
            heights = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception:  # of the header, which is Python's own grammar: anything at all
        raise InputError(path, "is not a NumPy array file") from None
    if heights.ndim != 2 or heights.dtype.kind not in "fiu":
        raise InputError(path, f"holds {heights.dtype} of shape {heights.shape}; "
                         "numbers [rows, columns] are needed")
    pixel = _pixel(path, pixel_m)

    def part(rows: slice, columns: slice) -> Heights:
        return heights[::-1][rows, columns].astype(np.float64) * scale

    return _straight(path, part, heights.shape, pixel, extent_m, centre_m, scale)


def _pixel(path: Named, pixel: float | None) -> float:
    if pixel is None or not math.isfinite(pixel):
        raise InputError(path, "does not say how many metres a pixel is (0.01 to 1000); give it",
                         "pixel_m")
    if not 0.01 <= pixel <= 1000:
        raise InputError(path, f"{pixel:g} m a pixel is not allowed; 0.01 to 1000", "pixel_m")
    return pixel


@dataclass(frozen=True)
class _Grid:
    """Where pixels are: m east and north that a column and a row lead to."""

    column: tuple[float, float]
    row: tuple[float, float]

    @property
    def wide(self) -> float:
        """m a column."""
        return math.hypot(*self.column)

    @property
    def high(self) -> float:
        """m a row."""
        return math.hypot(*self.row)

    @property
    def upright(self) -> bool:
        """Whether rows lead east or west and columns north or south."""
        return (abs(self.column[1]) <= _STRAIGHT * self.wide
                and abs(self.row[0]) <= _STRAIGHT * self.high)

    @property
    def square(self) -> bool:
        """Whether it also has square pixels: then nothing has to be resampled."""
        return self.upright and abs(self.wide / self.high - 1.0) <= _STRAIGHT


def _raster(path: Named, band: int, scale: float | None, pixel_m: float | None, extent_m: Any,
            centre_m: tuple[float, float]) -> Window:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings(), rasterio.Env(CPL_VSIL_CURL_ALLOWED_EXTENSIONS="none"):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            source = rasterio.open(path)
        except RasterioError as error:
            raise InputError(path, f"is not a GeoTIFF, nor another elevation model, that can be "
                             f"read: {_short(error)}") from None
        with source:
            if source.driver not in DRIVERS:  # a list of other files, or of addresses, is none
                raise InputError(path, f"is not a GeoTIFF, nor another elevation model that can be "
                                 f"read, but {source.driver}; of GDAL: {', '.join(DRIVERS)}")
            if not 0 <= band < source.count:
                raise InputError(path, f"has no band {band}; it has {source.count}, counted from 0")
            grid = _grid(path, source, pixel_m)
            unit = _unit(path, source, band) if scale is None else scale

            def part(rows: slice, columns: slice) -> Heights:
                return _values(path, source, band, unit, rows, columns)

            shape = (source.height, source.width)
            if grid.square:
                pixel = _pixel(path, grid.wide)
                south, west = grid.row[1] < 0, grid.column[0] < 0

                def turned(rows: slice, columns: slice) -> Heights:
                    found = part(_back(rows, shape[0]) if south else rows,
                                 _back(columns, shape[1]) if west else columns)
                    return found[::-1 if south else 1, ::-1 if west else 1]

                return _straight(path, turned, shape, pixel, extent_m, centre_m, unit)
            return _resampled(path, part, shape, grid, extent_m, centre_m, unit)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _back(index: slice, count: int) -> slice:
    """The same places counted from the other end."""
    return slice(count - index.stop, count - index.start)


def _grid(path: Named, source: Any, pixel_m: float | None) -> _Grid:
    """Raises InputError where it is in degrees, bent, or does not say."""
    crs, move = source.crs, source.transform
    if crs is not None and crs.is_geographic:
        west, south, east, north = source.bounds
        raise InputError(path, "is in degrees of longitude and latitude; project it to metres, "
                         "such as by: gdalwarp -r cubic -t_srs \"+proj=stere "
                         f"+lat_0={(south + north) / 2:.6g} +lon_0={(west + east) / 2:.6g} "
                         f"+R={_radius(crs):.0f}\" {Path(path).name} projected.tif")
    if source.gcps[0] and move.is_identity:
        raise InputError(path, "is tied to the ground by control points; resample it first, such "
                         f"as by: gdalwarp -r cubic {Path(path).name} straight.tif")
    if move.is_identity:
        side = _pixel(path, pixel_m)
        return _Grid((side, 0.0), (0.0, -side))
    factor = 1.0 if crs is None else _linear(path, crs)
    grid = _Grid((move.a * factor, move.d * factor), (move.b * factor, move.e * factor))
    if min(grid.wide, grid.high) <= 0 or abs(move.determinant) <= 1e-12 * (
            math.hypot(move.a, move.d) * math.hypot(move.b, move.e)):
        raise InputError(path, "has pixels without an area")
    if pixel_m is not None:  # as wide as that; their shape stays
        factor = _pixel(path, pixel_m) / grid.wide
        grid = _Grid((grid.column[0] * factor, grid.column[1] * factor),
                     (grid.row[0] * factor, grid.row[1] * factor))
    return grid


def _radius(crs: Any) -> float:
    """m, of the body; the Moon's if it does not say."""
    return float(crs.to_dict().get("R", crs.to_dict().get("a", 1_737_400.0)))


def _linear(path: Named, crs: Any) -> float:
    """m a unit of length of the projection."""
    try:
        name, factor = crs.linear_units_factor
    except Exception:  # rasterio raises CRSError, of several kinds, where there is none
        return 1.0
    if not (math.isfinite(factor) and factor > 0):
        raise InputError(path, f"is in {name}, which is no length")
    return float(factor)


def _unit(path: Named, source: Any, band: int) -> float:
    """m a unit of elevation, as the band says."""
    said = (source.units[band] or "").strip().lower()
    if said not in HEIGHT_UNITS:
        raise InputError(path, f"has elevations in {said!r}, which is not known; metres a unit "
                         "are needed", "scale")
    return HEIGHT_UNITS[said]


def _values(path: Named, source: Any, band: int, unit: float, rows: slice,
            columns: slice) -> Heights:
    """Heights m of some of the file's own rows and columns; NaN where it has none."""
    from rasterio.errors import RasterioError

    part = ((rows.start, rows.stop), (columns.start, columns.stop))
    try:
        stored = source.read(band + 1, window=part)
        known = source.read_masks(band + 1, window=part) > 0
    except RasterioError as error:
        raise InputError(path, f"is not a GeoTIFF that can be read to its end: {_short(error)}"
                         ) from None
    if source.driver.startswith("ISIS") and stored.dtype.name in _SPECIAL:
        low, high = _SPECIAL[stored.dtype.name]
        known &= (stored >= low) & (stored <= high)
    raw = stored.astype(np.float64)
    known &= np.isfinite(raw) & (np.abs(raw) < _HUGE)
    heights = (raw * source.scales[band] + source.offsets[band]) * unit
    return np.where(known, heights, np.nan)


def _sides(path: Named, extent_m: float | tuple[float, float]) -> tuple[float, float]:
    sides = extent_m if isinstance(extent_m, tuple) else (extent_m, extent_m)
    if not all(math.isfinite(side) and side > 0 for side in sides):
        raise InputError(path, f"{sides[0]:g} by {sides[1]:g} m is not allowed", "size")
    return sides


def _check_size(path: Named, columns: int, rows: int) -> None:
    if columns * rows > MAX_PIXELS:
        raise InputError(path, f"{columns:,} by {rows:,} pixels are too many; at most "
                         f"{MAX_PIXELS:,} in all: a smaller window is needed", "size")


def _straight(path: Named, part: Any, shape: tuple[int, ...], pixel: float, extent_m: Any,
              centre_m: tuple[float, float], scale: float) -> Window:
    """The pixels of the window.

    `part(rows, columns)` gives heights, rows counted from the south, columns from the west.
    """
    rows, columns = shape
    if min(rows, columns) < 4:
        raise InputError(path, f"is too small: {columns} by {rows} pixels; at least 4 by 4")
    if extent_m is None:
        extent_m, centre_m = ((columns - 1) * pixel, (rows - 1) * pixel), (0.0, 0.0)
    slices, shift = [], []
    for name, count, side, at in zip(("wide", "high"), (columns, rows), _sides(path, extent_m),
                                     centre_m, strict=True):
        middle = (count - 1) / 2 + at / pixel
        reach = side / 2 / pixel
        first, last = math.floor(middle - reach + 1e-9), math.ceil(middle + reach - 1e-9)
        if first < 0 or last > count - 1:
            raise InputError(path, f"is too small: it is {(count - 1) * pixel:g} m {name}, the "
                             f"window needs {side:g} m around {at:g} m from the centre")
        slices.append(slice(first, last + 1))
        shift.append((middle - (first + last) / 2) * pixel)
    across, along = slices
    wide, high = (s.stop - s.start for s in slices)
    if min(wide, high) < 4:
        raise InputError(path, f"is too coarse: the window spans {wide} by {high} pixels of "
                         f"{pixel:g} m; at least 4 by 4")
    _check_size(path, wide, high)
    heights = _with_edges(path, part, shape, _wider(along, AROUND), _wider(across, AROUND))
    about = part(_known(along, rows), _known(across, columns))
    return Window(heights, pixel, (shift[0], shift[1]), about, scale)


def _wider(index: slice, by: int) -> slice:
    return slice(index.start - by, index.stop + by)


def _known(index: slice, count: int) -> slice:
    """`MOST_KNOWN` places about the middle of it, or as many as there are."""
    first = max(0, min((index.start + index.stop - MOST_KNOWN) // 2, count - MOST_KNOWN))
    return slice(first, min(count, first + MOST_KNOWN))


def _with_edges(path: Named, part: Any, shape: tuple[int, ...], rows: slice,
                columns: slice) -> Heights:
    """Heights without holes; places outside the model go on as the ground does at its edge."""
    inside = [slice(max(0, index.start), min(count, index.stop))
              for index, count in zip((rows, columns), shape, strict=True)]
    beyond = [(known.start - index.start, index.stop - known.stop)
              for known, index in zip(inside, (rows, columns), strict=True)]
    found = fill_holes(path, part(*inside))
    return np.pad(found, beyond, mode="reflect", reflect_type="odd")


def _resampled(path: Named, part: Any, shape: tuple[int, int], grid: _Grid, extent_m: Any,
               centre_m: tuple[float, float], scale: float) -> Window:
    """The window on upright square pixels, as fine as the file's are along their finer side."""
    from scipy.ndimage import map_coordinates

    pixel = _pixel(path, min(grid.wide, grid.high))
    rows, columns = shape
    if extent_m is None:
        if not grid.upright:
            raise InputError(path, "is turned on its map; how large a window is needed must be "
                             "said", "size")
        extent_m, centre_m = ((columns - 1) * grid.wide, (rows - 1) * grid.high), (0.0, 0.0)
    sides = _sides(path, extent_m)
    counts = [math.ceil(side / pixel - 1e-6) + 1 for side in sides]
    if min(counts) < 4:
        raise InputError(path, f"is too coarse: the window spans {counts[0]} by {counts[1]} pixels "
                         f"of {pixel:g} m; at least 4 by 4")
    _check_size(path, *counts)
    (a, d), (b, e) = grid.column, grid.row
    area = a * e - b * d

    def places(east: Any, north: Any) -> tuple[Any, Any]:
        """Row and column of points, m from the model's centre."""
        return ((a * north - d * east) / area + (rows - 1) / 2,
                (e * east - b * north) / area + (columns - 1) / 2)

    corners = places(*(at + side / 2 * np.array(sign) for at, side, sign in zip(
        centre_m, sides, ((-1, 1, -1, 1), (-1, -1, 1, 1)), strict=True)))
    for name, found, count in zip(("high", "wide"), corners, shape, strict=True):
        if found.min() < -1e-6 or found.max() > count - 1 + 1e-6:
            raise InputError(path, f"is too small: the window reaches over its edge, where it is "
                             f"{count} pixels {name}")
    east, north = np.meshgrid(*(at + pixel * (np.arange(n + 2 * AROUND) - AROUND - (n - 1) / 2)
                                for n, at in zip(counts, centre_m, strict=True)))
    row, column = places(east, north)
    first = [math.floor(float(found.min())) - 8 for found in (row, column)]
    last = [math.ceil(float(found.max())) + 9 for found in (row, column)]
    _check_size(path, last[1] - first[1], last[0] - first[0])
    stored = _with_edges(path, part, shape, *map(slice, first, last))
    heights = map_coordinates(stored, np.stack([row - first[0], column - first[1]]), order=3,
                              mode="nearest")
    return Window(heights, pixel, (0.0, 0.0), heights, scale)


def fill_holes(path: Named, heights: Heights) -> Heights:
    """Small holes take the mean of their surroundings, from the edge inwards.

    Raises InputError where too much is missing.
    """
    heights = heights.copy()
    missing = ~np.isfinite(heights)
    share = missing.mean()
    if share > MAX_MISSING:
        raise InputError(path, f"has no data in {100 * share:.0f} % of the window; at most "
                         f"{100 * MAX_MISSING:.0f} %")
    while missing.any():
        padded = np.pad(heights, 1, constant_values=np.nan)
        around = np.stack([padded[1 + dy:1 + dy + len(heights), 1 + dx:1 + dx + heights.shape[1]]
                           for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        known = np.isfinite(around)
        mean = np.where(known, around, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        reached = missing & known.any(axis=0)
        heights[reached] = mean[reached]
        missing &= ~reached
    return heights


def check_relief(path: Named, heights: Heights, pixel: float) -> None:
    """Raises InputError where elevations cannot be metres of ground."""
    relief, width = float(np.ptp(heights)), pixel * (min(heights.shape) - 1)
    if not np.isfinite(relief) or relief > width:
        raise InputError(path, f"rises {relief:g} m within {width:g} m: elevations or pixels "
                         "are not in metres (see scale and pixel_m)")


def plane(heights: Heights) -> Heights:
    """The plane of best fit, sampled like the heights."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in heights.shape)
    # The axes are centred, so the three coefficients are independent.
    gx = (heights * x[None, :]).sum() / (x**2).sum() / len(y)
    gy = (heights * y[:, None]).sum() / (y**2).sum() / len(x)
    return heights.mean() + gx * x[None, :] + gy * y[:, None]
