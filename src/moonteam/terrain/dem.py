"""A window of an elevation model: heights in metres on a grid whose rows lead north.

Rasterio reads what agencies publish: whatever way its rows and columns run, whatever its pixels'
shape, units, masks, special values, scale and offset are. A model on a straight grid of square
pixels comes as it is; any other is resampled by cubic splines. Only the window is read.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from moonteam.errors import InputError
from moonteam.problem.piece import WHOLE, Piece

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

    def metres(self, column: Any, row: Any) -> tuple[Any, Any]:
        """East and north of so many columns and rows."""
        return (column * self.column[0] + row * self.row[0],
                column * self.column[1] + row * self.row[1])

    def steps(self, east: Any, north: Any) -> tuple[Any, Any]:
        """Columns and rows that lead so many metres east and north."""
        (a, d), (b, e) = self.column, self.row
        area = a * e - b * d
        return (e * east - b * north) / area, (a * north - d * east) / area

    @property
    def square(self) -> bool:
        """Whether it also has square pixels: then nothing has to be resampled."""
        return self.upright and abs(self.wide / self.high - 1.0) <= _STRAIGHT


class Window(NamedTuple):
    """What was asked for, and `AROUND` pixels on each side, past the model's edge made up."""

    heights: Heights  # [rows, columns] m, row 0 in the south
    pixel: float  # m
    shift: tuple[float, float]  # m east and north, from the middle of `heights` to the centre asked
    about: Heights  # [rows, columns] m at the same pixel, more of the model, NaN where it has none
    scale: float  # that elevations were multiplied by, of the file's own or as given
    sides: tuple[float, float]  # m (x, y) of the ground asked for, its margin included
    centre: tuple[float, float]  # m east and north of the model's centre
    made_up: float  # m by which these sides reach past the model's edge, at most

    @property
    def core(self) -> Heights:
        """The window alone."""
        return self.heights[AROUND:-AROUND, AROUND:-AROUND]


Read = Callable[[slice, slice], Heights]
Place = Callable[[Heights, Heights], tuple[Heights, Heights]]


class _Model(NamedTuple):
    """A model that can be cut from."""

    path: Named
    shape: tuple[int, int]  # rows, columns
    grid: _Grid
    read: Read  # heights m of rows and columns of the file, NaN where it has none
    scale: float
    place: Place  # columns and rows of latitudes and longitudes in degrees


class _Asked(NamedTuple):
    """A piece of a model in metres."""

    centre: tuple[float, float]  # east and north of the model's centre
    sides: tuple[float, float]  # (x, y) that the model must have
    whole: tuple[float, float]  # (x, y) with the margin
    turn: float  # rad, clockwise from the model's north to the piece's

    def corners(self, sides: tuple[float, float]) -> tuple[Heights, Heights]:
        """m east and north of the model's centre [4]."""
        return self.points(sides[0] / 2 * np.array((-1, 1, -1, 1)),
                           sides[1] / 2 * np.array((-1, -1, 1, 1)))

    def points(self, x: Heights, y: Heights) -> tuple[Heights, Heights]:
        """m east and north of the model's centre, of places m from the piece's."""
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        return self.centre[0] + x * cos + y * sin, self.centre[1] - x * sin + y * cos


def window(path: Named, piece: Piece = WHOLE, *, need: tuple[float, float] | None = None,
           margin: float = 0.0, pixel: float | None = None, band: int = 0,
           scale: float | None = None) -> Window:
    """Heights of a part of a model.

    Args:
      path: of a raster in metres, or an .npy array [rows, columns], row 0 in the north.
      piece: which part.
      need: (x, y) sides m that it must have at least, and has if `piece` says no size.
      margin: m kept around what is needed, past the model's edge going on as the ground does there.
      pixel: metres a pixel, where the file does not say or is wrong.
      band: counted from 0.
      scale: metres a unit of elevation; None: as the file says, else 1.

    Raises InputError: not readable, not in metres, too little of it, too many holes.
    """
    piece.check(lambda key, problem: InputError(path, problem, key))
    if scale is not None and not math.isfinite(scale):
        raise InputError(path, f"{scale} is not allowed; a finite number is needed", "scale")
    if not Path(path).is_file():
        raise InputError(path, "is a folder" if Path(path).is_dir() else "no such file")

    def cut(model: _Model) -> Window:
        asked = _ask(model, piece, need, margin)
        _check_inside(model, asked)
        if model.grid.square and not asked.turn:
            return _straight(model, asked)
        return _resampled(model, asked)

    if Path(path).suffix.lower() == ".npy":
        return cut(_array(path, pixel, 1.0 if scale is None else scale))
    return _raster(path, band, scale, pixel, cut)


def _array(path: Named, pixel: float | None, scale: float) -> _Model:
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
    side = _pixel(path, pixel)

    def read(rows: slice, columns: slice) -> Heights:
        return _float64(heights[rows, columns]) * scale

    def place(latitudes: Heights, longitudes: Heights) -> tuple[Heights, Heights]:
        raise InputError(path, "says nothing of latitude and longitude; metres or pixels are "
                         "needed", "units")

    return _Model(path, (int(heights.shape[0]), int(heights.shape[1])),
                  _Grid((side, 0.0), (0.0, -side)), read, scale, place)


def _float64(stored: npt.NDArray[Any]) -> Heights:
    with np.errstate(invalid="ignore"):  # of NaNs some signal
        return stored.astype(np.float64)


def _pixel(path: Named, pixel: float | None) -> float:
    if pixel is None or not math.isfinite(pixel):
        raise InputError(path, "does not say how many metres a pixel is (0.01 to 1000); give it",
                         "pixel")
    if not 0.01 <= pixel <= 1000:
        raise InputError(path, f"{pixel:g} m a pixel is not allowed; 0.01 to 1000", "pixel")
    return pixel


def _raster(path: Named, band: int, scale: float | None, pixel: float | None,
            cut: Callable[[_Model], Window]) -> Window:
    import rasterio
    from rasterio.errors import CRSError, NotGeoreferencedWarning, RasterioError

    with warnings.catch_warnings(), rasterio.Env(CPL_VSIL_CURL_ALLOWED_EXTENSIONS="none"):
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            source = rasterio.open(path)
        except (RasterioError, CRSError) as error:
            raise InputError(path, f"is not a GeoTIFF, nor another elevation model, that can be "
                             f"read: {_short(error)}") from None
        with source:
            if source.driver not in DRIVERS:  # a list of other files, or of addresses, is none
                raise InputError(path, f"is not a GeoTIFF, nor another elevation model that can be "
                                 f"read, but {source.driver}; of GDAL: {', '.join(DRIVERS)}")
            if not 0 <= band < source.count:
                raise InputError(path, f"has no band {band}; it has {source.count}, counted from 0")
            grid = _grid(path, source, pixel)
            unit = _unit(path, source, band) if scale is None else scale

            def read(rows: slice, columns: slice) -> Heights:
                return _values(path, source, band, unit, rows, columns)

            def place(latitudes: Heights, longitudes: Heights) -> tuple[Heights, Heights]:
                return _placed(path, source, latitudes, longitudes)

            return cut(_Model(path, (source.height, source.width), grid, read, unit, place))


def _placed(path: Named, source: Any, latitudes: Heights, longitudes: Heights
            ) -> tuple[Heights, Heights]:
    """Columns and rows, counted from the middle of the first pixel, by PROJ."""
    from rasterio.crs import CRS
    from rasterio.warp import transform

    crs = source.crs
    if crs is None or not crs.is_projected:
        raise InputError(path, "has no projection, which latitude and longitude need; metres or "
                         "pixels are needed", "units")
    body = {key: value for key, value in crs.to_dict().items()
            if key in ("R", "a", "b", "f", "rf", "ellps", "datum", "pm")} or {"R": _radius(crs)}
    try:
        found = transform(CRS.from_dict({"proj": "longlat", **body}), crs, longitudes.tolist(),
                          latitudes.tolist())
    except Exception:  # GDAL's, of many kinds
        found = [[math.inf]] * 2
    east, north = (np.array(values) for values in found[:2])
    if not np.isfinite([east, north]).all():
        raise InputError(path, f"latitude {latitudes[0]:g}, longitude {longitudes[0]:g} is not on "
                         "its projection", "centre")
    back = ~source.transform
    return (back.a * east + back.b * north + back.c - 0.5,
            back.d * east + back.e * north + back.f - 0.5)


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:120]


def _back(index: slice, count: int) -> slice:
    """The same places counted from the other end."""
    return slice(count - index.stop, count - index.start)


def _grid(path: Named, source: Any, pixel: float | None) -> _Grid:
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
        side = _pixel(path, pixel)
        return _Grid((side, 0.0), (0.0, -side))
    factor = 1.0 if crs is None else _linear(path, crs)
    grid = _Grid((move.a * factor, move.d * factor), (move.b * factor, move.e * factor))
    if min(grid.wide, grid.high) <= 0 or abs(move.determinant) <= 1e-12 * (
            math.hypot(move.a, move.d) * math.hypot(move.b, move.e)):
        raise InputError(path, "has pixels without an area")
    if pixel is not None:  # as wide as that; their shape stays
        factor = _pixel(path, pixel) / grid.wide
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
    raw = _float64(stored)
    known &= np.isfinite(raw) & (np.abs(raw) < _HUGE)
    heights = (raw * source.scales[band] + source.offsets[band]) * unit
    return np.where(known, heights, np.nan)


def _ask(model: _Model, piece: Piece, need: tuple[float, float] | None, margin: float) -> _Asked:
    """The piece in metres. Raises InputError."""
    path, (rows, columns), grid = model.path, model.shape, model.grid
    if min(rows, columns) < 4:
        raise InputError(path, f"is too small: {columns} by {rows} pixels; at least 4 by 4")
    centre, turn = _centre(model, piece), math.radians(piece.rotation % 360)
    sides = _sides(model, piece)
    if sides is None and need is None:
        if piece.centre is not None or turn or not grid.upright:
            raise InputError(path, "how large a piece of it is needed must be said, since it is "
                             "turned on its map or not all of it is wanted", "size")
        sides = ((columns - 1) * grid.wide, (rows - 1) * grid.high)
    elif sides is None:
        sides = need
    assert sides is not None
    if need is None:
        return _Asked(centre, sides, sides, turn)
    if min(side - least for side, least in zip(sides, need, strict=True)) < -1e-6:
        raise InputError(path, f"{sides[0]:g} by {sides[1]:g} m is not allowed; the map alone is "
                         f"{need[0]:g} by {need[1]:g} m", "size")
    x, y = (max(side, least + 2 * margin) for side, least in zip(sides, need, strict=True))
    return _Asked(centre, sides, (x, y), turn)


def _centre(model: _Model, piece: Piece) -> tuple[float, float]:
    """m east and north of the model's centre."""
    if piece.centre is None:
        return 0.0, 0.0
    if piece.units == "metres":
        return piece.centre
    if piece.units == "pixels":
        column, row = piece.centre
    else:
        column, row = (float(found[0]) for found in model.place(
            *(np.array([value]) for value in piece.centre)))
    rows, columns = model.shape
    east, north = model.grid.metres(column - (columns - 1) / 2, row - (rows - 1) / 2)
    return float(east), float(north)


def _sides(model: _Model, piece: Piece) -> tuple[float, float] | None:
    """(x, y) m; None if it is not said."""
    if piece.sides is None:
        return None
    x, y = piece.sides
    if piece.units == "metres":
        return x, y
    if piece.units == "pixels":
        return x * model.grid.wide, y * model.grid.high
    assert piece.centre is not None
    (latitude, longitude), high, wide = piece.centre, x, y
    if not (abs(latitude) + high / 2 <= 90 and wide <= 360):
        raise InputError(model.path, f"{high:g} degrees of latitude and {wide:g} of longitude "
                         f"about latitude {latitude:g} reach past a pole or around the Moon",
                         "size")
    column, row = model.place(latitude + high / 2 * np.array((0, 0, -1, 1)),
                              longitude + wide / 2 * np.array((-1, 1, 0, 0)))
    east, north = model.grid.metres(column, row)
    return (math.hypot(east[1] - east[0], north[1] - north[0]),
            math.hypot(east[3] - east[2], north[3] - north[2]))


def _beyond(model: _Model, asked: _Asked, sides: tuple[float, float]) -> dict[str, float]:
    """m by which the piece with these sides reaches past each side of the model; negative within.

    A model ends where its outermost pixels do.
    """
    (rows, columns), grid = model.shape, model.grid
    column, row = grid.steps(*asked.corners(sides))
    names = ["before its first column", "after its last column", "before its first row",
             "after its last row"]
    if grid.upright:
        names = [f"in the {name}" for name in (
            *("west", "east")[::1 if grid.column[0] > 0 else -1],
            *("north", "south")[::1 if grid.row[1] < 0 else -1])]
    reach = (-column.min() - columns / 2, column.max() - columns / 2,
             -row.min() - rows / 2, row.max() - rows / 2)
    metres = (grid.wide, grid.wide, grid.high, grid.high)
    return {name: float(r * m) for name, r, m in zip(names, reach, metres, strict=True)}


def _check_inside(model: _Model, asked: _Asked) -> None:
    """Raises InputError with what the model lacks."""
    lacks = [f"{metres:.3g} m {name}" for name, metres
             in _beyond(model, asked, asked.sides).items() if metres > 1e-6 * model.grid.wide]
    if not lacks:
        return
    (rows, columns), turned = model.shape, ""
    if asked.turn:
        turned = f", turned by {math.degrees(asked.turn):g} degrees"
    raise InputError(model.path, f"is too small: {asked.sides[0]:g} by {asked.sides[1]:g} m of "
                     f"ground are needed around {asked.centre[0]:g} m east, {asked.centre[1]:g} m "
                     f"north of its centre{turned}; it is {columns * model.grid.wide:g} by "
                     f"{rows * model.grid.high:g} m and lacks {', '.join(lacks)}")


def _check_size(path: Named, columns: int, rows: int, pixel: float | None = None) -> None:
    """Raises InputError for too many pixels, or of a window of this `pixel` m for too few."""
    if pixel is not None and min(columns, rows) < 4:
        raise InputError(path, f"is too coarse: the window spans {columns} by {rows} pixels of "
                         f"{pixel:g} m; at least 4 by 4")
    if columns * rows > MAX_PIXELS:
        raise InputError(path, f"{columns:,} by {rows:,} pixels are too many; at most "
                         f"{MAX_PIXELS:,} in all: a smaller window is needed", "size")


def _straight(model: _Model, asked: _Asked) -> Window:
    """The model's own pixels."""
    path, (rows, columns), grid = model.path, model.shape, model.grid
    pixel = _pixel(path, grid.wide)
    south, west = grid.row[1] < 0, grid.column[0] < 0

    def part(rows_: slice, columns_: slice) -> Heights:
        """Rows counted from the south, columns from the west."""
        found = model.read(_back(rows_, rows) if south else rows_,
                           _back(columns_, columns) if west else columns_)
        return found[::-1 if south else 1, ::-1 if west else 1]

    slices, shift = [], []
    for count, side, at in zip((columns, rows), asked.whole, asked.centre, strict=True):
        middle = (count - 1) / 2 + at / pixel
        reach = side / 2 / pixel
        first, last = math.floor(middle - reach + 1e-9), math.ceil(middle + reach - 1e-9)
        slices.append(slice(first, last + 1))
        shift.append((middle - (first + last) / 2) * pixel)
    across, along = slices
    _check_size(path, across.stop - across.start, along.stop - along.start, pixel)
    heights = _with_edges(path, part, model.shape, _wider(along, AROUND), _wider(across, AROUND))
    about = part(_known(along, rows), _known(across, columns))
    return Window(heights, pixel, (shift[0], shift[1]), about, model.scale, asked.whole,
                  asked.centre, _made_up(model, asked))


def _made_up(model: _Model, asked: _Asked) -> float:
    return round(max(0.0, *_beyond(model, asked, asked.whole).values()), 3)


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


def _resampled(model: _Model, asked: _Asked) -> Window:
    """The window on upright square pixels, as fine as the file's are along their finer side."""
    from scipy.ndimage import map_coordinates

    path, grid, (rows, columns) = model.path, model.grid, model.shape
    pixel = _pixel(path, min(grid.wide, grid.high))
    wide, high = (math.ceil(side / pixel - 1e-6) + 1 for side in asked.whole)
    _check_size(path, wide, high, pixel)
    x, y = np.meshgrid(*(pixel * (np.arange(n + 2 * AROUND, dtype=np.float64) - AROUND
                                  - (n - 1) / 2) for n in (wide, high)))
    column, row = grid.steps(*asked.points(x, y))
    column, row = column + (columns - 1) / 2, row + (rows - 1) / 2
    first = [math.floor(float(found.min())) - 8 for found in (row, column)]
    last = [math.ceil(float(found.max())) + 9 for found in (row, column)]
    _check_size(path, last[1] - first[1], last[0] - first[0])
    stored = _with_edges(path, model.read, model.shape, *map(slice, first, last))
    heights = map_coordinates(stored, np.stack([row - first[0], column - first[1]]), order=3,
                              mode="nearest")
    return Window(heights, pixel, (0.0, 0.0), heights, model.scale, asked.whole, asked.centre,
                  _made_up(model, asked))


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
                         "are not in metres (see scale and pixel)")


def plane(heights: Heights) -> Heights:
    """The plane of best fit, sampled like the heights."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in heights.shape)
    # The axes are centred, so the three coefficients are independent.
    gx = (heights * x[None, :]).sum() / (x**2).sum() / len(y)
    gy = (heights * y[:, None]).sum() / (y**2).sum() / len(x)
    return heights.mean() + gx * x[None, :] + gy * y[:, None]
