"""Pipes, devices, links and huge pictures in the place of archives and of the files of captures."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.base.reading import FileSource
from rebar_depth_bench.captures.images import read_image_shape
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.submission import EntryError, SubmissionReader
from tests.bench.captures.example_capture import write_capture

VIEWS = {"walk/a": (3, 4), "walk/b": (3, 4)}

Replace = Callable[[Path], None]


def to_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def to_device(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


def to_link(path: Path) -> None:
    path.rename(path.with_name(f"{path.name}-elsewhere"))
    path.symlink_to(path.with_name(f"{path.name}-elsewhere"))


def to_nothing(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("nowhere")


def locations(problems: tuple[Problem, ...]) -> list[tuple[str, str]]:
    return [(problem.code, problem.where) for problem in problems]


@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_archive_that_is_no_file_is_refused(replace: Replace, tmp_path: Path) -> None:
    replace(tmp_path / "a.zip")
    with pytest.raises(OSError, match="not a regular file"):
        FileSource(tmp_path / "a.zip")
    with SubmissionReader(tmp_path / "a.zip", VIEWS) as reader:
        assert locations(reader.structure_problems) == [("unreadable", "")]


@pytest.mark.parametrize("replace", [to_pipe, to_device, to_nothing])
def test_capture_refuses_pictures_that_are_no_file(replace: Replace, tmp_path: Path) -> None:
    root = write_capture(tmp_path / "c", views=2)
    for eye in ("left", "right"):
        replace(root / eye / "000001.png")
    with pytest.raises(InputError) as caught:
        open_capture(root)
    expected = [("unreadable", f"{eye}/000001.png") for eye in ("left", "right")]
    assert locations(caught.value.problems) == expected


@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_capture_refuses_calibration_that_is_no_file(replace: Replace, tmp_path: Path) -> None:
    root = write_capture(tmp_path / "c", views=1)
    replace(root / "calibration.conf")
    with pytest.raises(InputError, match=r"calibration\.conf") as caught:
        open_capture(root)
    assert locations(caught.value.problems) == [("unreadable", "")]


def test_links_in_capture_are_followed(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "c", views=2)
    for path in (root / "left" / "000001.png", root / "calibration.conf"):
        to_link(path)
    assert len(open_capture(root).view_ids) == 2


def png_header(width: int, height: int) -> bytes:
    chunk = b"IHDR" + struct.pack(">2I5B", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n\0\0\0\r" + chunk + zlib.crc32(chunk).to_bytes(4, "big")


def jpeg_header(width: int, height: int) -> bytes:
    return b"\xff\xd8\xff\xc0\0\x0b\x08" + struct.pack(">2H", height, width) + b"\x01\x01\x11\0"


@pytest.mark.parametrize("content", [png_header(20_000, 20_000), jpeg_header(50_000, 50_000)])
def test_huge_picture_is_refused_before_decoding(content: bytes, tmp_path: Path) -> None:
    root = write_capture(tmp_path / "c", views=1)
    (root / "left" / "000000.png").write_bytes(content)
    with pytest.raises(InputError, match="REBAR_MAX_IMAGE_PIXELS raises the limit") as caught:
        open_capture(root)
    assert locations(caught.value.problems) == [("size", "left/000000.png")]


def test_pixel_limit_can_be_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_bytes(png_header(20_000, 20_000))
    monkeypatch.setenv("REBAR_MAX_IMAGE_PIXELS", "400000000")
    assert read_image_shape(tmp_path / "a.png") == (20_000, 20_000)
    monkeypatch.setenv("REBAR_MAX_IMAGE_PIXELS", "399999999")
    with pytest.raises(EntryError, match="20000 x 20000"):
        read_image_shape(tmp_path / "a.png")


@pytest.mark.parametrize(
    "options",
    [
        {"format": "PNG"},
        {"format": "PNG", "pnginfo": None, "dpi": (300, 300)},
        {"format": "JPEG"},
        {"format": "JPEG", "progressive": True},
        {"format": "JPEG", "exif": b"Exif\0\0" + bytes(60_000), "icc_profile": bytes(200_000), "comment": "c"},
        {"format": "JPEG", "dpi": (300, 300), "quality": 1, "restart_marker_blocks": 1},
    ],
)
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_picture_sizes_agree_with_pillow(options: dict[str, object], mode: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    Image.new(mode, (65, 36)).save(path, **options)  # type: ignore[arg-type]
    assert read_image_shape(path) == (36, 65)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"GIF89a" + bytes(100),
        png_header(0, 5),
        png_header(5, 5)[:-1] + b"\0",
        png_header(5, 5)[:-1],
        jpeg_header(5, 0),
        jpeg_header(5, 5)[:9],
        b"\xff\xd8" + b"\xff" * 100_000,
        b"\xff\xd8" + b"\xff\xe0\0\0" * 100_000,
        b"\xff\xd8" + b"\xff\xe0\0\2" * 100_000,
    ],
)
def test_damaged_header_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(EntryError) as caught:
        read_image_shape(tmp_path / "a")
    assert caught.value.problem.code == "damaged"
