"""Tests of the formats .npy, .npz, .exr and .png of a view: decoding, and problems of invalid data."""

from __future__ import annotations

import io
import pickle
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image

from rebar_depth_bench.submission.formats import FORMATS
from tests.bench.submission import zips
from tests.bench.submission.conftest import Check
from tests.bench.submission.zips import DEPTH, SHAPE, Array, chunk, npy, npy_header, npz, png, with_view

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


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (
            npy(np.array([[{}]], object), allow_pickle=True),
            "pickled Python objects (dtype object), expected float16/32/64",
        ),
        (pickle.dumps(DEPTH), "a Python pickle was found, expected a .npy array"),
        (npy(DEPTH.astype(int)), "the dtype is <i8, expected float16, float32 or float64"),
        (npy(DEPTH.astype(complex)), "the dtype is <c16, expected float16"),
        (npy(np.zeros(SHAPE, [("z", "<f4")])), "the dtype is structured, expected float16"),
        (npy(DEPTH.T), "the shape is 4 x 3, expected 3 x 4 (H x W)"),
        (npy(DEPTH[None]), "the shape is 1 x 3 x 4, expected 3 x 4"),
        (npy(np.array(3.0)), "the shape is a single value, expected 3 x 4"),
        (
            npy_header(HEADER.format("'<f4'", "(400000, 400000)")) + VALUES,
            "the shape is 400000 x 400000, expected",
        ),
        (npy(DEPTH)[:-1], "47 bytes of values follow the header, expected 48 for 3 x 4 float32"),
        (npy(DEPTH) + b"x", "49 bytes of values follow the header, expected 48"),
        (npy(DEPTH)[:40], "the .npy header is cut off at 40 bytes, expected 128"),
        (npy(DEPTH)[:8], "the .npy header"),
        (npy_header(" " * 4090, b"\2\0"), "the .npy header declares 4090 bytes, expected at most 4084"),
        (npy_header("", b"\2\0")[:8] + b"\xff\xff\xff\xff", "declares 4294967295 bytes, expected at most"),
        (
            npy_header("__import__('os')"),
            "the .npy header is __import__('os'), expected descr, fortran_order and shape",
        ),
        (
            npy_header(HEADER.format("'<f4'", "(3, 4)") + "; x") + VALUES,
            "expected descr, fortran_order and shape",
        ),
        (npy_header("{'shape': (3, 4)}" + VALUES.hex()), "expected descr, fortran_order and shape"),
        (b"\x93NUMPY\x09\0" + VALUES, "expected a .npy array of version 1, 2 or 3"),
        (b"", "bytes that start with b'' was found, expected a .npy array"),
    ],
)
def test_invalid_npy_is_rejected(check: Check, data: bytes, words: str) -> None:
    (problem,) = check(with_view(".npy", data))
    assert problem.startswith("lattice/0000.npy: ")
    assert words in problem


INNER = zips.Record(b"depth.npy", npy(DEPTH))


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (npz(a=DEPTH, b=DEPTH), "the .npz holds 2 arrays (a.npy, b.npy), expected exactly one"),
        (npz(), "the .npz holds 0 arrays, expected exactly one"),
        (npz(a=DEPTH.T), "(a.npy): the shape is 4 x 3, expected 3 x 4"),
        (
            npz(a=np.zeros((300, 300))),
            "inside the .npz, a.npy: the declared size is 720128 bytes, expected at most",
        ),
        (b"not a zip at all, nor long", "inside the .npz, the file is not a zip"),
        (npz(a=DEPTH)[:-5], "inside the .npz, the zip has no end record"),
        (zips.build([INNER, INNER]), "the .npz holds 2 arrays (depth.npy, depth.npy), expected exactly one"),
        (zips.build([zips.Record(b"a.txt", b"x")]), "the .npz holds a.txt, expected one .npy array"),
        (
            zips.build([replace(INNER, flags=1)]),
            "depth.npy: the entry is encrypted, expected plain data",
        ),
        (zips.build([replace(INNER, crc=1)]), "inside the .npz, depth.npy: the data is corrupt"),
        (zips.build([replace(INNER, name=b"../a.npy")]), "the name escapes the archive"),
        (zips.build([INNER], count=7), "inside the .npz, the zip directory holds 1 entries"),
    ],
)
def test_invalid_npz_is_rejected(check: Check, data: bytes, words: str) -> None:
    (problem,) = check(with_view(".npz", data))
    assert problem.startswith("lattice/0000.npz")
    assert words in problem


ROWS = b"".join(b"\0" + row.astype(">u2").tobytes() for row in UNITS)
GOOD_PNG = png(UNITS)
IEND = chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (png(UNITS, bits=8), "the PNG is 8-bit greyscale, expected 16-bit greyscale"),
        (png(UNITS, colour=2), "the PNG is 16-bit RGB, expected 16-bit greyscale"),
        (png(UNITS.T), "the image is 4 x 3, expected 3 x 4 (H x W)"),
        (png(UNITS, interlace=3), "interlace 3, expected 0, 0 and 0 or 1"),
        (GOOD_PNG[:-20], "the PNG is truncated at"),
        (GOOD_PNG[:20], "the PNG is truncated at 20 bytes"),
        (GOOD_PNG + b"x", "1 bytes follow the PNG's end, expected none"),
        (GOOD_PNG[:50] + b"\xff" + GOOD_PNG[51:], "the PNG chunk at byte 33 is corrupt"),
        (
            png(UNITS, idat=zlib.compress(ROWS[:-9])),
            "the PNG image data inflates to 18 bytes, expected 27 and a complete stream",
        ),
        (png(UNITS, idat=zlib.compress(ROWS)[:-4]), "inflates to 27 bytes, expected 27 and a complete stream"),
        (png(UNITS, idat=zlib.compress(bytes(10**6))), "inflates to more than 27 bytes, expected 27"),
        (png(UNITS, idat=b"nonsense"), "the PNG image data is corrupt"),
        (png(UNITS, idat=zlib.compress(b"\x07" + ROWS[1:])), "the PNG data is corrupt"),
        (GOOD_PNG[:33] + IEND, "the PNG has 0 image chunks, expected one run of IDAT"),
        (GOOD_PNG[:8] + GOOD_PNG[33:], "the PNG does not start with its header chunk"),
        (b"GIF89a..", "the bytes start with b'GIF89a..', expected a PNG file"),
    ],
)
def test_invalid_png_is_rejected(check: Check, data: bytes, words: str) -> None:
    (problem,) = check(with_view(".png", data))
    assert problem.startswith("lattice/0000.png: ")
    assert words in problem


def test_png_ancillary_chunks_never_reach_pillow(check: Check) -> None:
    bomb = chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(10**7))) + chunk(b"acTL", struct.pack(">2I", 9, 9))
    assert check(with_view(".png", GOOD_PNG[:33] + bomb + GOOD_PNG[33:])) == []


def test_invalid_exr_is_rejected(check: Check, tmp_path: Path) -> None:
    def exr(channels: dict[str, Array], **header: object) -> bytes:
        return zips.exr(tmp_path / "a.exr", channels, **header)

    flat, good = exr({"Z": np.ones_like(DEPTH)}), exr({"Z": DEPTH})
    window = struct.pack("<4i", 0, 0, 3, 2)
    channel_list = b"Z\0" + struct.pack("<iI2i", 2, 0, 1, 1)
    OpenEXR.File([OpenEXR.Part({}, {"Z": DEPTH}, "a"), OpenEXR.Part({}, {"Z": DEPTH}, "b")]).write(
        str(tmp_path / "b")
    )
    cases = [
        (exr({"R": DEPTH, "G": DEPTH, "B": DEPTH}), "has 3 channels (B, G, R), expected one"),
        (exr({"Z": DEPTH.astype(np.uint32)}), "the channel Z is UINT, expected HALF or FLOAT"),
        (exr({"Z": np.ascontiguousarray(DEPTH.T)}), "the data window is 4 x 3, expected 3 x 4 (H x W)"),
        ((tmp_path / "b").read_bytes(), "the OpenEXR file is multi-part, expected one flat image"),
        (good[:5] + b"\x08" + good[6:], "the OpenEXR file is deep, expected one flat image"),
        (good[:4] + b"\x01" + good[5:], "the OpenEXR version field is 0x1, expected version 2"),
        (good.replace(window, struct.pack("<4i", 0, 0, 2**31 - 2, 2**31 - 2), 1), "expected 3 x 4"),
        (
            good.replace(channel_list, b"Z\0" + struct.pack("<iI2i", 2, 0, 2, 2), 1),
            "is subsampled 2 x 2, expected 1 x 1",
        ),
        (good.replace(b"dataWindow", b"dataWindov", 1), "the OpenEXR header is damaged"),
        (good[:60], "the OpenEXR header is damaged"),
        (good[:-3], "the OpenEXR data is corrupt or truncated"),
        (flat[:-8] + b"\xff" * 8, "the OpenEXR data is corrupt or truncated"),
        (b"nothing", "the bytes start with b'nothing', expected an OpenEXR file"),
    ]
    for data, words in cases:
        (problem,) = check(with_view(".exr", data))
        assert problem.startswith("lattice/0000.exr: ")
        assert words in problem
