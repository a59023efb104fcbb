"""Depth maps as other programs write them: types of values, marks of missing depth, and limits."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import plan_import
from dataset_builder.importing.import_layout import DepthTable
from dataset_builder.importing.source_files import DepthTally, read_depth
from rebar_depth_bench.base.errors import EntryError, InputError
from tests.builder.importing import source_data as data

VALUES = np.array([[300, 301, 302, 303, 304], [400, 401, 402, 403, 404], [500, 501, 502, 503, 504]])
"""An asymmetric picture: rows and columns that are exchanged or turned show."""
PFM = "Pf\n5 3\n{}\n"


def tiff(values: np.ndarray, order: str = "<", tags: dict[int, int] | None = None) -> bytes:
    """Return a TIFF file of two strips, as the specification TIFF 6.0 (section 8) and tifffile lay it out."""
    height, width = values.shape
    sample_format = {"u": 1, "i": 2, "f": 3}[values.dtype.kind]
    strips = [
        values[:2].astype(values.dtype.newbyteorder(order)),
        values[2:].astype(values.dtype.newbyteorder(order)),
    ]
    sizes = [strip.nbytes for strip in strips]
    start = 8 + 16
    fields: dict[int, int | None] = {256: width, 257: height, 258: 8 * values.dtype.itemsize, 259: 1, 262: 1}
    fields |= {273: None, 277: 1, 278: 2, 279: None, 339: sample_format, **(tags or {})}
    entries = b""
    for tag, value in sorted(fields.items()):
        kind, count, stored = (4, 1, value) if value is not None else (4, 2, 8 if tag == 273 else 16)
        entries += struct.pack(order + "HHII", tag, kind, count, stored)
    offset = start + sum(sizes)
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", offset)
    arrays = struct.pack(order + "4I", start, start + sizes[0], *sizes)
    directory = struct.pack(order + "H", len(fields)) + entries + struct.pack(order + "I", 0)
    return head + arrays + b"".join(strip.tobytes() for strip in strips) + directory


def saved(image: Image.Image, form: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, form, **options)
    return stream.getvalue()


def npz(values: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez_compressed(stream, depth=values)
    return stream.getvalue()


def read(folder: Path, name: str, content: bytes, table: DepthTable | None = None) -> np.ndarray:
    (folder / name).write_bytes(content)
    return read_depth(folder / name, (3, 5), table or DepthTable(), DepthTally())


READ: dict[str, tuple[str, bytes]] = {
    **{
        f"TIFF {kind} {order}": ("a.tif", tiff(VALUES.astype(kind), order))
        for kind in ("u2", "i2", "u4", "i4", "f4")
        for order in "<>"
        if (kind, order) != ("u4", ">")  # Pillow does not know it.
    },
    "TIFF int32 of OpenCV": ("a.tiff", data.opencv(VALUES.astype(np.int32), ".tiff")),
    **{
        f"npy {kind}": ("a.npy", data.npy(VALUES.astype(kind)))
        for kind in ("<u2", ">u2", "<i4", ">i8", "<u8", "<f2", ">f8")
    },
    "npy of columns": ("a.npy", data.npy(np.asfortranarray(VALUES.astype(np.int32)))),
    "npz of integers": ("a.npz", npz(VALUES.astype(np.uint16))),
    "PNG": ("a.png", data.png(VALUES.astype(np.uint16))),
    "EXR half": ("a.exr", b""),
    # Rows from bottom to top; a negative scale means little-endian values (Debevec's description of PFM).
    "PFM little-endian": ("a.pfm", PFM.format(-1).encode() + VALUES[::-1].astype("<f4").tobytes()),
    "PFM big-endian": ("a.pfm", PFM.format(1).encode() + VALUES[::-1].astype(">f4").tobytes()),
    "PFM with CR LF": ("a.pfm", b"Pf\r\n5 3\r\n-1\r\n" + VALUES[::-1].astype("<f4").tobytes()),
    "PFM with CR": ("a.pfm", b"Pf\r5 3\r-1\r" + VALUES[::-1].astype("<f4").tobytes()),
    "PFM of Middlebury": ("a.pfm", PFM.format(-0.003922).encode() + VALUES[::-1].astype("<f4").tobytes()),
}


@pytest.mark.parametrize("name", READ)
def test_values_are_those_that_were_written(name: str, tmp_path: Path) -> None:
    file, content = READ[name]
    if name == "EXR half":
        content = data.exr(tmp_path, {"V": VALUES.astype(np.float16)})
    assert np.array_equal(read(tmp_path, file, content), VALUES)


@pytest.mark.parametrize("table", [DepthTable(), DepthTable(channel="V")], ids=["one channel", "named channel"])
def test_exr_whose_pixels_begin_beside_the_picture_is_refused(table: DepthTable, tmp_path: Path) -> None:
    depth, window = {"V": VALUES.astype(np.float32)}, ((10, 0), (14, 2))
    content = data.exr(tmp_path, depth, dataWindow=window, displayWindow=((0, 0), (4, 2)))
    with pytest.raises(EntryError, match=r"columns 10 to 14 and rows 0 to 2.*columns 0 to 4 and rows 0 to 2"):
        read(tmp_path, "a.exr", content, table)
    content = data.exr(tmp_path, depth, dataWindow=window, displayWindow=window)
    assert np.array_equal(read(tmp_path, "a.exr", content, table), VALUES)


def test_unsigned_integers_of_32_bits_are_no_signed_ones(tmp_path: Path) -> None:
    content = tiff(np.full((3, 5), 4_000_000_000, np.uint32))
    assert (read(tmp_path, "a.tif", content) == 4_000_000_000).all()


GREY = Image.fromarray(VALUES.astype(np.uint8))
REFUSED: dict[str, tuple[str, bytes, str]] = {
    "PNG of 8 bits": ("a.png", saved(GREY, "PNG"), "8-bit greyscale, expected 16-bit"),
    "PNG of a palette": ("a.png", saved(GREY.convert("P"), "PNG"), "palette, expected 16-bit"),
    "PNG in colour": ("a.png", data.opencv(np.zeros((3, 5, 3), np.uint16), ".png"), "RGB, expected 16-bit"),
    "PNG with alpha": ("a.png", saved(GREY.convert("RGBA"), "PNG"), "RGBA, expected 16-bit"),
    "TIFF of a palette": ("a.tif", saved(GREY.convert("P"), "TIFF"), "mode P, expected one channel of numbers"),
    "TIFF of bits": ("a.tif", saved(GREY.convert("1"), "TIFF"), "mode 1, expected one channel of numbers"),
    "TIFF in colour": ("a.tif", saved(GREY.convert("RGB"), "TIFF"), "expected one channel"),
    "TIFF turned": ("a.tif", saved(Image.fromarray(VALUES.astype(np.float32)), "TIFF", tiffinfo={274: 3}), "EXIF"),
    **{
        f"TIFF {kind}": ("a.tif", tiff(VALUES.astype(kind)), "expected TIFF of float32 or")
        for kind in ("f2", "f8", "u8", "i8")
    },
    "TIFF float64 of OpenCV": (
        "a.tif",
        data.opencv(VALUES.astype(np.float64), ".tiff"),
        "a type that Pillow knows",
    ),
    "TIFF of four bits": ("a.tif", tiff(VALUES.astype("u1"), tags={258: 4}), "grey shades of 4 bits"),
    "TIFF with white as zero": ("a.tif", tiff(VALUES.astype("u1"), tags={262: 0}), "grey shades of 8 bits"),
    "TIFF cut off": ("a.tif", tiff(VALUES.astype("f4"))[:60], "cannot be read"),
    "npy of truth values": ("a.npy", data.npy(VALUES > 400), "expected integers, float16"),
    "npy of complex numbers": ("a.npy", data.npy(VALUES.astype(complex)), "expected integers, float16"),
    "PFM in colour": ("a.pfm", b"PF\n5 3\n-1\n" + bytes(180), "cannot be read"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_file_that_may_be_misread_is_refused_in_words(name: str, tmp_path: Path) -> None:
    file, content, words = REFUSED[name]
    with pytest.raises(EntryError, match=words):
        read(tmp_path, file, content)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8", "u2", "i4"])
def test_invalid_values_are_compared_in_the_type_of_the_file(kind: str, tmp_path: Path) -> None:
    """65.535 has no exact float16 or float32, and 65535 rounds to infinity in float16."""
    mark = 65.535 if kind.startswith("f") else 65000
    values = VALUES.astype(kind)
    values[1, 2] = mark
    tally = DepthTally()
    (tmp_path / "a.npy").write_bytes(data.npy(values))
    table = DepthTable(invalid=(mark, 7.0, -1.0))
    units = read_depth(tmp_path / "a.npy", (3, 5), table, tally)
    assert np.flatnonzero(np.isnan(units)).tolist() == [7]
    assert tally.invalid == {mark}


LARGEST: dict[str, tuple[str, Callable[[np.ndarray], bytes], type]] = {
    "PNG": ("a.png", data.png, np.uint16),
    "npy uint8": ("a.npy", data.npy, np.uint8),
    "npy uint16": ("a.npy", data.npy, np.uint16),
    "npy float16": ("a.npy", data.npy, np.float16),
    "npy int32": ("a.npy", data.npy, np.int32),
    "npy int64": ("a.npy", data.npy, np.int64),
    "TIFF int16": ("a.tif", tiff, np.int16),
    "TIFF int32": ("a.tif", tiff, np.int32),
    "TIFF uint32": ("a.tif", tiff, np.uint32),
}


@pytest.mark.parametrize("name", LARGEST)
@pytest.mark.parametrize("unit", ["m", "mm"])
def test_largest_integer_or_half_float_has_to_be_listed(name: str, unit: str, tmp_path: Path) -> None:
    file, encode, kind = LARGEST[name]
    largest = int(np.finfo(kind).max if kind is np.float16 else np.iinfo(kind).max)
    values: np.ndarray = np.full((3, 5), 100, kind)
    values[0, :2] = largest
    with pytest.raises(EntryError, match=rf"2 pixels have {largest}.* expected depth.invalid with {largest}"):
        read(tmp_path, file, encode(values), DepthTable(unit=unit))
    units = read(tmp_path, file, encode(values), DepthTable(unit=unit, invalid=(float(largest),)))
    assert np.isnan(units[0, :2]).all()
    assert (units[1:] == 100).all()


def layout(folder: Path, table: str, depth: dict[str, bytes], *, suffix: str = ".npy", rest: str = "") -> Path:
    """Write a layout of views of 160 x 120 pixels with these depth maps."""
    for name, content in depth.items():
        data.write(folder / f"d/{name}{suffix}", content)
    path = folder / "layout.toml"
    path.write_text(
        f'truth_sigma_m = 0.001\nwidth = 160\nheight = 120\n[files]\nleft_depth = "d/{{view}}{suffix}"\n[depth]\n'
        f"{table}\n[cameras.left]\nfx = 150\nfy = 150\ncx = 79.5\ncy = 59.5\ndistortion = [0, 0, 0, 0]\n{rest}"
    )
    return path


def background(value: float, kind: type = np.float32) -> np.ndarray:
    """Return depth of 2, and of ``value`` in the upper third, as Blender has 1e10 where no surface is."""
    depth: np.ndarray = np.full((120, 160), 2, kind)
    depth[:40] = value
    return depth


FAR: dict[str, tuple[str, np.ndarray, str]] = {
    "Blender": ("", background(1e10), "1e+10"),
    "megametre": ("", background(1e6), "1000000"),
    "largest float32": ("", background(float(np.finfo(np.float32).max)), "3.40282347e+38"),
    "largest float64": (
        "unit = 'ft'",
        background(float(np.finfo(np.float64).max), np.float64),
        "1.7976931348623157e+308",
    ),
    "millimetres": ("", background(2000.5) * 1000, "2000"),
    "range": ("kind = 'range'", background(1e10), "1e+10"),
}


@pytest.mark.parametrize("name", FAR)
def test_depth_beyond_a_kilometre_is_refused_with_its_value(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table, depth, value = FAR[name]
    path = layout(tmp_path, table, {"0": data.npy(np.full_like(depth, 2)), "a": data.npy(depth)})
    assert main(["import", str(path), "--out", str(tmp_path / "out"), "--config", "mock-up"]) == 2
    message = capsys.readouterr().err
    assert f"a.npy: {19200 if name == 'millimetres' else 6400} pixels have depth beyond 1000 m" in message
    assert f"the value {value}, expected" in message
    assert "depth.invalid" in message
    assert "depth.max_m" in message
    assert not list((tmp_path / "out").rglob("*"))


def test_huge_disparity_is_refused_as_depth_that_no_camera_measures(tmp_path: Path) -> None:
    rest = data.STEREO.replace("87.5", "150").replace("44.5", "59.5")
    path = layout(tmp_path, "kind = 'disparity'", {"a": data.npy(background(1e10))}, rest=rest)
    path.write_text(path.read_text().replace("[depth]", 'right_depth = "d/{view}.npy"\n[depth]'))
    with pytest.raises(InputError, match=r"6400 pixels have depth below 0\.1 mm, most often the value 1e\+10"):
        plan_import(path, "mock-up").views.decode("a")


def test_largest_depth_drops_and_counts_what_lies_beyond(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Values without depth that no view has are named once, those of another view are not."""
    depth = {"a": data.npy(background(1e10)), "b": data.npy(background(5.5))}
    path = layout(tmp_path, "max_m = 3\ninvalid = [5.5, 65.535]", depth)
    assert main(["import", str(path), "--out", str(tmp_path / "out"), "--config", "mock-up"]) == 0
    printed = capsys.readouterr()
    assert "beyond depth.max_m = 3 m: 6400 pixels left out" in printed.out
    notes = [line for line in printed.err.splitlines() if line.startswith("depth.invalid")]
    assert notes == ["depth.invalid: no pixel of any view has the value 65.535, in units of the files"]
    for row in rdb.load(tmp_path / "out", "mock-up"):
        assert np.array_equal(row["left_depth"], background(0))


def test_range_is_converted_with_the_camera_of_each_view(tmp_path: Path) -> None:
    """The plane z = 2 + 0.2 X + 0.1 Y has z = 2 / (1 - 0.2 x - 0.1 y) on the ray (x, y, 1)."""
    expected, depth = {}, {}
    for name, focal_px in (("a", 150.0), ("b", 90.0)):
        v, u = np.mgrid[:120, :160]
        x, y = (u - 79.5) / focal_px, (v - 59.5) / focal_px
        expected[name] = 2 / (1 - 0.2 * x - 0.1 * y)
        depth[name] = data.npy((expected[name] * np.sqrt(x**2 + y**2 + 1)).astype(np.float32))
        data.write(tmp_path / f"k/{name}.txt", f"{focal_px} 0 79.5 0 {focal_px} 59.5 0 0 1".encode())
    path = layout(tmp_path, "kind = 'range'", depth, rest='[intrinsics]\nfile = "k/{view}.txt"\n')
    views = plan_import(path, "mock-up").views
    for name in depth:
        columns = views.decode(name)
        assert columns["left_K"][0, 0] == {"a": 150, "b": 90}[name]
        assert np.abs(columns["left_depth"] - expected[name]).max() < 1e-6
    assert views.decode("b")["left_depth"][0, 0] == pytest.approx(1.6092981)


MATRIX = {
    "one line": b"1 0 0 0.5 0 1 0 -1 0 0 1 2e-1 0 0 0 1",
    "commas": b"1,0,0,0.5\n0,1,0,-1\n0,0,1,0.2\n0,0,0,1\n",
    "commas and blanks": b"1, 0, 0, 0.5\n0, 1, 0, -1\n0, 0, 1, 0.2\n",
    "byte order mark and CRLF": b"\xef\xbb\xbf# pose\r\n1\t0\t0\t0.5\r\n0\t1\t0\t-1\r\n0\t0\t1\t0.2\r\n",
}
NO_MATRIX = {
    "UTF-16": ("1 0 0 0.5".encode("utf-16"), "the text is UTF-16, expected UTF-8"),
    "decimal commas": (b"1 0 0 0,5 0 1 0 -1 0 0 1 0,2 0 0", "expected a rotation, a translation, and 0 0 0 1"),
    "decimal commas and semicolons": (b"1;0;0;0,5\n0;1;0;-1\n0;0;1;0,2\n0;0;0;1", "numbers with decimal points"),
    "words": (b"pose 1 0 0 0", "'pose'"),
    "other number": (b"1 0 0 0.5 0 1 0 -1", "holds 8 numbers, expected 4 x 4"),
}


@pytest.mark.parametrize("name", [*MATRIX, *NO_MATRIX])
def test_matrices_in_text_files(name: str, tmp_path: Path) -> None:
    content, words = NO_MATRIX[name] if name in NO_MATRIX else (MATRIX[name], "")
    data.write(tmp_path / "p/a.txt", content)
    path = layout(tmp_path, "", {"a": data.npy(background(2))}, rest='[poses]\nfile = "p/{view}.txt"\n')
    views = plan_import(path, "mock-up").views
    if words:
        with pytest.raises(InputError, match=words):
            views.decode("a")
    else:
        expected = np.array([[1, 0, 0, 0.5], [0, 1, 0, -1], [0, 0, 1, 0.2], [0, 0, 0, 1]])
        assert np.array_equal(views.decode("a")["left_cam_from_world"], expected)
