"""Elevation models taken apart: TIFF tags and headers of arrays, put together wrongly."""

from __future__ import annotations

import ast
import io
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine

from moonteam.problem.piece import Piece
from moonteam.terrain import dem
from moonteam.terrain.site import import_dem
from tests.fuzz.mutation import Pairs, harmed, put, tree_of, written

MOON = "+proj=stere +lat_0=-85 +R=1737400 +units=m +no_defs"
LETTERS = {1: "B", 2: "B", 3: "H", 4: "I", 6: "b", 7: "B", 8: "h", 9: "i", 11: "f", 12: "d",
           16: "Q"}
"""struct's, by TIFF's types of values."""
ROWS, COLUMNS = 20, 24


def seeds(folder: Path) -> list[Any]:
    """Models of several makes, taken apart."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    heights = np.sin(x / 5) + 0.1 * y
    found = []
    for number, more in enumerate((
            {"dtype": "float32"}, {"dtype": "int16", "nodata": -32768, "compress": "deflate"},
            {"dtype": "float64", "tiled": True, "blockxsize": 16, "blockysize": 16},
            {"dtype": "float32", "compress": "lzw", "predictor": 3,
             "transform": Affine(0.8, 0.3, 0, -0.3, 0.8, 0)})):
        path = folder / f"{number}.tif"
        with rasterio.open(path, "w", **{
                "driver": "GTiff", "width": COLUMNS, "height": ROWS, "count": 1, "crs": MOON,
                "transform": Affine(1, 0, 50, 0, -1, 90)} | more) as out:
            out.write((heights * 100 if more["dtype"] == "int16" else heights).astype(
                more["dtype"]), 1)
            if more["dtype"] == "int16":
                out.scales, out.offsets, out.units = (0.01,), (3.0,), ("m",)
        found.append(_tags(path.read_bytes()))
    for array in (heights, heights.astype("<f4"), (2 * heights).astype(">i2")):
        buffer = io.BytesIO()
        np.save(buffer, array)
        data = buffer.getvalue()
        length = struct.unpack("<H", data[8:10])[0]
        found.append(Pairs([
            ["header", tree_of(ast.literal_eval(data[10:10 + length].decode()))],
            ["version", 1], ["data", data[10 + length:].hex()]]))
    return found


def _tags(data: bytes) -> Pairs:
    """A little-endian TIFF: the values of each tag, and all bytes."""
    assert data[:4] == b"II*\0"
    at = struct.unpack("<I", data[4:8])[0]
    tags = Pairs()
    for k in range(struct.unpack("<H", data[at:at + 2])[0]):
        tag, kind, count, _ = struct.unpack("<HHII", data[at + 2 + 12 * k:at + 14 + 12 * k])
        form = f"<{count}{LETTERS[kind]}"
        size = struct.calcsize(form)
        start = at + 10 + 12 * k
        start = start if size <= 4 else struct.unpack("<I", data[start:start + 4])[0]
        values = struct.unpack(form, data[start:start + size])
        tags.append([str(tag), [kind, bytes(values).decode("latin1") if kind == 2
                                else list(values)]])
    return Pairs([["tags", tags], ["data", data.hex()]])


def write(folder: Path, tree: Any, harm: int) -> Path:
    """The file of what `seeds` took apart, whatever has become of it."""
    held = {key: value for key, value in tree if isinstance(key, str)} \
        if isinstance(tree, Pairs) else {"header": tree}
    try:
        data = bytes.fromhex(held["data"])
    except (KeyError, TypeError, ValueError):
        data = b"II*\0\x08\0\0\0" + b"\0" * 99
    if "header" in held or "version" in held:
        text = written(held.get("header")).replace("false", "False").replace("[", "(").replace(
            "]", ",)").encode("utf-8", "replace")
        version = held.get("version")
        version = version if isinstance(version, int) and 0 <= version < 256 else 3
        form = "<H" if version == 1 else "<I"
        data = (b"\x93NUMPY" + bytes([version, 0]) + struct.pack(form, len(text) % 2**16)
                + text + data)
        path = folder / "input.npy"
    else:
        data = _with_tags(data, held.get("tags"))
        path = folder / "input.tif"
    return put(path, harmed(data, harm))


def _with_tags(data: bytes, tags: Any) -> bytes:
    """The bytes with a new directory of tags at their end."""
    entries, tail = [], bytearray(data + b"\0" * (len(data) % 2))
    for entry in tags if isinstance(tags, Pairs) else ():
        tag = int(entry[0]) % 2**16 if entry[0].isdecimal() and len(entry[0]) < 20 else 256
        kind, values = entry[1] if isinstance(entry[1], list) and len(entry[1]) == 2 else (3, [1])
        kind = kind % 2**16 if isinstance(kind, int) else 3
        count, packed = _packed(LETTERS.get(kind, "I"), values)
        if len(packed) > 4:
            at = len(tail)
            tail += packed + b"\0" * (len(packed) % 2)
            packed = struct.pack("<I", at)
        entries.append(struct.pack("<HHI", tag, kind, count) + packed.ljust(4, b"\0"))
    start = len(tail)
    tail[4:8] = struct.pack("<I", start)
    return bytes(tail) + struct.pack("<H", len(entries)) + b"".join(entries) + b"\0" * 4


def _packed(letter: str, values: Any) -> tuple[int, bytes]:
    """The number of values and their bytes, every number made to fit."""
    if isinstance(values, str):
        text = values.encode("utf-8", "replace")
        return len(text), text
    found = [v if isinstance(v, int | float) else 7
             for v in (values if isinstance(values, list) else [values])]
    if letter in "fd":
        return len(found), struct.pack(f"<{len(found)}{letter}", *(
            math.inf if abs(v) > 3e38 else float(v) for v in found))
    bits = 8 * struct.calcsize(letter)
    whole = [int(v) if math.isfinite(v) else 0 for v in found]
    if letter.islower():
        whole = [(v + 2**(bits - 1)) % 2**bits - 2**(bits - 1) for v in whole]
    return len(whole), struct.pack(f"<{len(whole)}{letter}", *(
        v if letter.islower() else v % 2**bits for v in whole))


def read(path: Path) -> None:
    """As a mission's site and `moonteam site` do."""
    pixel = 1.0 if path.suffix == ".npy" else None
    found = dem.window(path, Piece(8.0), pixel=pixel)
    assert np.isfinite(found.heights).all()
    site = import_dem(path, Piece(8.0), pixel=pixel, spacing=0.5)
    assert site.heights.shape == (17, 17)
    assert np.isfinite(site.heights).all()
