"""Tests of the formats .npy, .npz, .exr and .png of a view: decoding, and problems of invalid data."""

from __future__ import annotations

import io
import pickle
import struct
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from rebar_depth_bench.submission.entries import FORMATS
from tests.bench.submission import zips
from tests.bench.submission.zips import (
    DEPTH,
    SHAPE,
    Array,
    chunk,
    npy,
    npy_header,
    npz,
    png,
    problems_of,
    with_view,
)

NAME = "lattice/0000"
UNITS = np.arange(12, dtype=np.uint16).reshape(SHAPE) * 5000
HEADER = "{{'descr': {}, 'fortran_order': False, 'shape': {}, }}"
VALUES = DEPTH.tobytes()
shapes = st.tuples(st.integers(1, 9), st.integers(1, 9))


def decode(suffix: str, data: bytes, shape: tuple[int, int], scale: float = 1.0) -> Array:
    return FORMATS[suffix].decode(NAME + suffix, memoryview(data), shape, scale)


@settings(max_examples=60)
@given(data=st.data(), code=st.sampled_from(["<f2", ">f2", "<f4", ">f4", "<f8", ">f8"]), fortran=st.booleans())
def test_npy_and_npz_preserve_floats(data: st.DataObject, code: str, fortran: bool) -> None:
    shape = data.draw(shapes)
    array = np.array(data.draw(arrays.arrays(np.dtype(code), shape)), order="F" if fortran else "C")
    for suffix, content in ((".npy", npy(array)), (".npz", npz(anything=array))):
        decoded = decode(suffix, content, shape)
        assert decoded.dtype == array.dtype.newbyteorder("=")
        assert decoded.dtype.isnative
        np.testing.assert_array_equal(decoded, array)


@pytest.mark.parametrize("version", [b"\1\0", b"\2\0", b"\3\0"])
def test_npy_versions_1_to_3(version: bytes) -> None:
    content = npy_header(HEADER.format("'<f4'", "(3, 4)"), version) + VALUES
    np.testing.assert_array_equal(decode(".npy", content, SHAPE), DEPTH)


def test_npy_headers_of_other_writers_are_read() -> None:
    for text in (
        "{'descr':'<f4','fortran_order':False,'shape':(3,4)}",
        "{'shape': (3L, 4L), 'fortran_order': False, 'descr': '<f4'}\n",
    ):
        np.testing.assert_array_equal(decode(".npy", npy_header(text) + DEPTH.tobytes(), SHAPE), DEPTH)


@settings(max_examples=40)
@given(data=st.data(), interlace=st.booleans(), scale=st.floats(1e-6, 1.0), level=st.sampled_from([0, 1, 9]))
def test_png_is_value_times_scale(data: st.DataObject, interlace: bool, scale: float, level: int) -> None:
    units = data.draw(arrays.arrays(np.uint16, data.draw(shapes)))
    if interlace:
        content = _adam7(units)
    else:
        buffer = io.BytesIO()
        Image.fromarray(units).save(buffer, "PNG", compress_level=level)
        content = buffer.getvalue()
    decoded = decode(".png", content, (units.shape[0], units.shape[1]), scale)
    assert decoded.dtype == np.float64
    np.testing.assert_array_equal(decoded, units.astype(np.float64) * scale)


def _adam7(units: Array) -> bytes:
    steps = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    passes = (units[y::y_step, x::x_step] for x, y, x_step, y_step in steps)
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for part in passes if part.size for row in part)
    return png(units, interlace=1, idat=zlib.compress(rows))


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("channel", ["Z", "R", "depth.Y"])
def test_single_channel_exr_is_decoded(tmp_path: Path, dtype: type, compression: str, channel: str) -> None:
    array: Array = DEPTH.astype(dtype)
    array[0, :3] = np.nan, np.inf, -1
    method = getattr(OpenEXR, f"{compression}_COMPRESSION")
    content = zips.exr(tmp_path / "a.exr", {channel: array}, compression=method)
    decoded = decode(".exr", content, SHAPE)
    assert decoded.dtype == dtype
    np.testing.assert_array_equal(decoded, array)


def test_tiled_exr_is_decoded(tmp_path: Path) -> None:
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 16
    content = zips.exr(tmp_path / "a.exr", {"Z": DEPTH}, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_array_equal(decode(".exr", content, SHAPE), DEPTH)


HEIGHT, WIDTH = SHAPE


@pytest.mark.parametrize("corner", [(10, 0), (0, -3), (-2, 5)])
def test_exr_whose_pixels_begin_beside_the_picture_is_rejected_with_both_windows(
    corner: tuple[int, int], tmp_path: Path
) -> None:
    (left, top), last = corner, (WIDTH - 1, HEIGHT - 1)
    header: dict[str, Any] = {
        "dataWindow": (corner, (left + last[0], top + last[1])),
        "displayWindow": ((0, 0), last),
    }
    (problem,) = problems_of(with_view(".exr", zips.exr(tmp_path / "a.exr", {"Z": DEPTH}, **header)))
    assert (problem.code, problem.where) == ("invalid", "lattice/0000.exr")
    for x, y in (corner, (0, 0)):
        assert f"columns {x} to {x + last[0]} and rows {y} to {y + last[1]}" in problem.found
    header["displayWindow"] = header["dataWindow"]
    np.testing.assert_array_equal(
        decode(".exr", zips.exr(tmp_path / "a.exr", {"Z": DEPTH}, **header), SHAPE), DEPTH
    )


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (pickle.dumps(DEPTH), "syntax"),
        (npy(DEPTH.astype(int)), "invalid"),
        (npy(DEPTH.astype(complex)), "invalid"),
        (npy(np.zeros(SHAPE, [("z", "<f4")])), "invalid"),
        (npy(DEPTH.T), "invalid"),
        (npy(DEPTH[None]), "invalid"),
        (npy(np.array(3.0)), "invalid"),
        (npy_header(HEADER.format("'<f4'", "(400000, 400000)")) + VALUES, "invalid"),
        (npy(DEPTH)[:-1], "size"),
        (npy(DEPTH) + b"x", "size"),
        (npy(DEPTH)[:40], "damaged"),
        (npy(DEPTH)[:8], "damaged"),
        (npy_header(" " * 4090, b"\2\0"), "size"),
        (npy_header("", b"\2\0")[:8] + b"\xff\xff\xff\xff", "size"),
        (npy_header("__import__('os')"), "syntax"),
        (npy_header(HEADER.format("'<f4'", "(3, 4)") + "; x") + VALUES, "syntax"),
        (npy_header("{'shape': (3, 4)}" + VALUES.hex()), "syntax"),
        (b"\x93NUMPY\x09\0" + VALUES, "syntax"),
        (b"", "syntax"),
    ],
)
def test_invalid_npy_is_rejected(data: bytes, code: str) -> None:
    (problem,) = problems_of(with_view(".npy", data))
    assert (problem.code, problem.where) == (code, "lattice/0000.npy")


def test_pickled_objects_are_named() -> None:
    (problem,) = problems_of(with_view(".npy", npy(np.array([[{}]], object), allow_pickle=True)))
    assert (problem.code, problem.where) == ("invalid", "lattice/0000.npy")
    assert "pickled Python objects" in problem.found


INNER = zips.Record(b"depth.npy", npy(DEPTH))


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (npz(a=DEPTH, b=DEPTH), "invalid"),
        (npz(), "invalid"),
        (npz(a=DEPTH.T), "invalid"),
        (npz(a=np.zeros((300, 300))), "size"),
        (b"not a zip at all, nor long", "syntax"),
        (npz(a=DEPTH)[:-5], "damaged"),
        (zips.build([INNER, INNER]), "invalid"),
        (zips.build([zips.Record(b"a.txt", b"x")]), "invalid"),
        (zips.build([replace(INNER, flags=1)]), "kind"),
        (zips.build([replace(INNER, crc=1)]), "damaged"),
        (zips.build([replace(INNER, name=b"../a.npy")]), "name"),
        (zips.build([INNER], count=7), "damaged"),
    ],
)
def test_invalid_npz_is_rejected(data: bytes, code: str) -> None:
    (problem,) = problems_of(with_view(".npz", data))
    assert problem.code == code
    assert problem.where.startswith("lattice/0000.npz")


ROWS = b"".join(b"\0" + row.astype(">u2").tobytes() for row in UNITS)
GOOD_PNG = png(UNITS)
IEND = chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (png(UNITS, bits=8), "invalid"),
        (png(UNITS, colour=2), "invalid"),
        (png(UNITS.T), "invalid"),
        (png(UNITS, interlace=3), "invalid"),
        (GOOD_PNG[:-20], "damaged"),
        (GOOD_PNG[:20], "damaged"),
        (GOOD_PNG + b"x", "damaged"),
        (GOOD_PNG[:50] + b"\xff" + GOOD_PNG[51:], "damaged"),
        (png(UNITS, idat=zlib.compress(ROWS[:-9])), "size"),
        (png(UNITS, idat=zlib.compress(ROWS)[:-4]), "size"),
        (png(UNITS, idat=zlib.compress(bytes(10**6))), "size"),
        (png(UNITS, idat=b"nonsense"), "damaged"),
        (png(UNITS, idat=zlib.compress(b"\x07" + ROWS[1:])), "damaged"),
        (GOOD_PNG[:33] + IEND, "damaged"),
        (GOOD_PNG[:8] + GOOD_PNG[33:], "damaged"),
        (b"GIF89a..", "syntax"),
    ],
)
def test_invalid_png_is_rejected(data: bytes, code: str) -> None:
    (problem,) = problems_of(with_view(".png", data))
    assert (problem.code, problem.where) == (code, "lattice/0000.png")


def test_png_ancillary_chunks_never_reach_pillow() -> None:
    bomb = chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(10**7))) + chunk(b"acTL", struct.pack(">2I", 9, 9))
    assert problems_of(with_view(".png", GOOD_PNG[:33] + bomb + GOOD_PNG[33:])) == []


def test_invalid_exr_is_rejected(tmp_path: Path) -> None:
    def exr(channels: dict[str, Array], **header: object) -> bytes:
        return zips.exr(tmp_path / "a.exr", channels, **header)

    flat, good = exr({"Z": np.ones_like(DEPTH)}), exr({"Z": DEPTH})
    window = struct.pack("<4i", 0, 0, 3, 2)
    channel_list = b"Z\0" + struct.pack("<iI2i", 2, 0, 1, 1)
    OpenEXR.File([OpenEXR.Part({}, {"Z": DEPTH}, "a"), OpenEXR.Part({}, {"Z": DEPTH}, "b")]).write(
        str(tmp_path / "b")
    )
    cases = [
        (exr({"R": DEPTH, "G": DEPTH, "B": DEPTH}), "invalid"),
        (exr({"Z": DEPTH.astype(np.uint32)}), "invalid"),
        (exr({"Z": np.ascontiguousarray(DEPTH.T)}), "invalid"),
        ((tmp_path / "b").read_bytes(), "invalid"),
        (good[:5] + b"\x08" + good[6:], "invalid"),
        (good[:4] + b"\x01" + good[5:], "invalid"),
        (good.replace(window, struct.pack("<4i", 0, 0, 2**31 - 2, 2**31 - 2), 1), "invalid"),
        (good.replace(channel_list, b"Z\0" + struct.pack("<iI2i", 2, 0, 2, 2), 1), "invalid"),
        (good.replace(b"dataWindow", b"dataWindov", 1), "damaged"),
        (good[:8] + b"twice\0int\0\4\0\0\0\1\0\0\0" * 2 + good[8:], "damaged"),
        (good[:8] + b"long\0int\0\xff\xff\xff\x7f" + good[8:], "damaged"),
        (good[:60], "damaged"),
        (good[:-3], "damaged"),
        (flat[:-8] + b"\xff" * 8, "damaged"),
        (b"nothing", "syntax"),
    ]
    for data, code in cases:
        (problem,) = problems_of(with_view(".exr", data))
        assert (problem.code, problem.where) == (code, "lattice/0000.exr")
