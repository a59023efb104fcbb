"""Pictures that are refused where images are looked for: turned by EXIF, or of formats that are not read.

EXIF data are built from the header of TIFF 6.0 and one directory entry, tag 274 (Orientation), as cameras write
them into JPEG (APP1, "Exif" and two zeros) and exiftool into PNG (chunk eXIf, PNG 1.5 extensions).
"""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.base.errors import EntryError, InputError
from rebar_depth_bench.captures.images import check_upright
from rebar_depth_bench.captures.views import is_capture, open_capture
from tests.bench.captures.example_capture import write_capture, write_images

XMP = b"http://ns.adobe.com/xap/1.0/\0<x:xmpmeta xmlns:x='adobe:ns:meta/'/>"
SHORT, LONG = 3, 4


def directory(orientation: int, order: str = "<", kind: int = SHORT) -> bytes:
    """Return TIFF data with a directory of one tag."""
    head = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8)
    value = struct.pack(f"{order}H2x" if kind == SHORT else f"{order}I", orientation)
    return head + struct.pack(f"{order}HHHI", 1, 274, kind, 1) + value + bytes(4)


def jpeg(*segments: bytes, after_frame: bool = False) -> bytes:
    """Return a JPEG picture with APP1 segments, behind its start or between the frame's header and the scan."""
    stream = io.BytesIO()
    Image.new("RGB", (64, 36), "red").save(stream, "JPEG")
    content = stream.getvalue()
    app1 = b"".join(b"\xff\xe1" + struct.pack(">H", len(one) + 2) + one for one in segments)
    place = content.index(b"\xff\xda") if after_frame else 2
    return content[:place] + app1 + content[place:]


def png(exif: bytes, *, late: bool = False) -> bytes:
    """Return a PNG picture with a chunk eXIf before its pixels, or after them."""
    stream = io.BytesIO()
    Image.new("RGB", (64, 36), "red").save(stream, "PNG")
    content = stream.getvalue()
    chunk = struct.pack(">I", len(exif)) + b"eXIf" + exif + struct.pack(">I", zlib.crc32(b"eXIf" + exif))
    place = content.index(b"IEND" if late else b"IDAT") - 4
    return content[:place] + chunk + content[place:]


def tiff(orientation: int) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(np.eye(5, dtype=np.float32)).save(stream, "TIFF", tiffinfo={274: orientation})
    return stream.getvalue()


def of_exif(*data: bytes) -> list[bytes]:
    return [b"Exif\0\0" + one for one in data]


@pytest.mark.parametrize(
    ("content", "orientation"),
    [
        *((jpeg(*of_exif(directory(value))), value) for value in range(2, 9)),
        (jpeg(*of_exif(directory(6, ">"))), 6),
        (jpeg(*of_exif(directory(8, ">", LONG))), 8),
        (jpeg(*of_exif(directory(3, "<", LONG))), 3),
        (jpeg(XMP, *of_exif(directory(6))), 6),
        (jpeg(*of_exif(directory(6)), XMP), 6),
        (jpeg(*of_exif(directory(5)), after_frame=True), 5),
        (png(directory(6)), 6),
        (png(directory(3, ">")), 3),
        (png(directory(6), late=True), 6),
        (tiff(6), 6),
        (tiff(3), 3),
    ],
)
def test_turned_picture_is_refused_with_the_remedy(content: bytes, orientation: int) -> None:
    with pytest.raises(EntryError) as caught:
        check_upright(io.BytesIO(content), "a.jpg")
    assert f"a.jpg: the EXIF orientation is {orientation}: viewers turn the pixels" in str(caught.value)
    assert "mogrify -auto-orient" in str(caught.value)
    assert "exiftool -Orientation=" in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        jpeg(),
        jpeg(XMP),
        *(jpeg(*of_exif(directory(value))) for value in (0, 1, 9, 65535)),
        jpeg(*of_exif(directory(6)[:-8])),
        jpeg(*of_exif(b"")),
        jpeg(*of_exif(b"II*\0" + b"\xff" * 40)),
        jpeg(*of_exif(bytes(60_000))),
        jpeg(directory(6)),
        png(directory(1), late=True),
        png(b"MM\0*"),
        png(b"none", late=True),
        png(directory(6), late=True)[:-30],
        tiff(1),
        tiff(6)[:6],
        b"",
        b"\x93NUMPY",
        b"\x89PNG\r\n\x1a\n" + bytes(100_000),
    ],
)
def test_picture_that_is_not_turned_or_damaged_is_upright(content: bytes) -> None:
    check_upright(io.BytesIO(content))


def test_each_turned_picture_of_a_capture_is_named(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed", views=3)
    for name, content in {
        "left/000001.jpg": jpeg(*of_exif(directory(3))),
        "right/000002.png": png(directory(6)),
    }.items():
        (root / name).with_suffix(".png").unlink()
        (root / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        open_capture(root)
    assert [problem.where for problem in caught.value.problems] == ["left/000001.jpg", "right/000002.png"]


@pytest.mark.parametrize("suffix", ["tif", "TIFF", "bmp", "webp", "ppm", "exr"])
def test_pictures_of_other_formats_are_not_left_out(suffix: str, tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed", views=2)
    for name in "abcd":
        (root / "left" / f"{name}.{suffix}").write_bytes(b"")
    with pytest.raises(InputError) as caught:
        open_capture(root)
    found = f"has 4 pictures of other formats, such as a.{suffix}, b.{suffix}, c.{suffix}"
    [problem] = caught.value.problems
    assert str(problem) == f"left/: {found}, expected PNG or JPEG: save them as PNG"


@pytest.mark.parametrize("folder", ["left", "."])
def test_folder_of_tiff_only_is_a_capture_whose_pictures_are_named(folder: str, tmp_path: Path) -> None:
    root = tmp_path / "mono"
    write_images(root, folder)
    for path in (root / folder).glob("*.png"):
        path.rename(path.with_suffix(".tif"))
    (root / "calibration.toml").write_text("")
    assert is_capture(root)
    with pytest.raises(InputError, match=r"has 2 pictures of other formats, such as 0001\.tif, 0002\.tif"):
        open_capture(root)


def test_hidden_files_and_files_that_are_no_pictures_are_left_out(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed", views=2)
    for name in ("Thumbs.db", ".DS_Store", "._000000.png", ".a.tif", "a.xmp", "a.json", "a.yaml", "a.txt", "a"):
        (root / "left" / name).write_bytes(b"")
        (root / "right" / name).write_bytes(b"")
    (root / "left" / "previous.tif").mkdir()
    assert open_capture(root).view_ids == ("zed/000000", "zed/000001")


def test_the_one_stereolabs_file_of_a_capture_has_any_name(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed", views=1)
    expected = open_capture(root).calibration
    (root / "calibration.conf").rename(root / "SN12345678.conf")
    assert open_capture(root).calibration == expected
    (root / "SN1.CONF").write_text("")
    with pytest.raises(InputError, match=r"calibration files are SN1\.CONF, SN12345678\.conf, expected"):
        open_capture(root)
    (root / "SN1.CONF").rename(root / "stereo.yaml")
    with pytest.raises(InputError, match=r"calibration files are SN12345678\.conf, stereo\.yaml, expected"):
        open_capture(root)
    (root / "SN12345678.conf").rename(root / "calibration.conf")
    assert open_capture(root).calibration == expected
