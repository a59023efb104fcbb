"""Captures: what is read and refused, also pipes, devices, links and huge pictures in the place of their files."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from rebar_depth_bench.base.errors import CalibrationError, InputError, Problem
from rebar_depth_bench.captures.images import read_image_shape
from rebar_depth_bench.captures.views import is_capture, open_capture
from rebar_depth_bench.submission import EntryError
from tests.bench.captures.example_capture import write_capture
from tests.bench.geometry.calibrations import SHIPPED_CALIBRATION

CAMERA = "fx = 50\nfy = 50\ncx = 31.5\ncy = 17.5\ndistortion = [0, 0, 0, 0]\n"
Change = Callable[[Path], object]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "zed", views=2)


def test_capture_lists_views_and_describes_camera(root: Path) -> None:
    assert is_capture(root)
    assert not is_capture(root.parent)
    capture = open_capture(root)
    assert capture.expected_views() == {"zed/000000": (36, 64), "zed/000001": (36, 64)}
    description = capture.describe_camera()
    assert "fx 35.09, fy 35.09" in description  # 701.88 * 64 / 1280, 701.70 * 36 / 720
    assert "baseline 119.98 mm" in description
    assert "not of rectified ones" in description


def test_capture_accepts_toml_and_jpeg(root: Path) -> None:
    (root / "calibration.conf").unlink()
    stereo = "[stereo]\nrotation = [0, 0, 0]\nbaseline_m = 0.1\n"
    (root / "calibration.toml").write_text(f"[left]\n{CAMERA}[right]\n{CAMERA}{stereo}")
    for path in root.glob("*/*.png"):
        Image.open(path).save(path.with_suffix(".JPG"), "JPEG")
        path.unlink()
    description = open_capture(root).describe_camera()
    assert "baseline 100.00 mm" in description
    assert "not of rectified ones" not in description


def rename_with_space(root: Path) -> None:
    for eye in ("left", "right"):
        (root / eye / "000001.png").rename(root / eye / "view one.png")


def delete_all_images(root: Path) -> None:
    for file in root.glob("*/*.png"):
        file.unlink()


@pytest.mark.parametrize(
    ("damage", "beginnings"),
    [
        (lambda root: (root / "right/000001.png").unlink(), ["missing left/000001.png: has no right/000001"]),
        (
            lambda root: Image.new("L", (32, 18)).save(root / "right/000001.png"),
            ["invalid right/000001.png: is 32 x 18, expected 64 x 36"],
        ),
        (
            lambda root: (root / "left/000001.png").write_bytes(b"none"),
            ["damaged left/000001.png: is not a readable image"],
        ),
        (rename_with_space, ["name left/view one.png: ", "name right/view one.png: "]),
        (
            lambda root: Image.new("L", (64, 36)).save(root / "left/000001.jpg"),
            ["duplicate left/000001.png: "],
        ),
        (delete_all_images, ["missing left/: has no images"]),
    ],
    ids=["no right image", "other size", "no image", "name", "two of a name", "no images"],
)
def test_invalid_capture_is_refused_with_the_expected_layout(
    damage: Change, beginnings: list[str], root: Path
) -> None:
    damage(root)
    with pytest.raises(InputError) as caught:
        open_capture(root)
    for problem, beginning in zip(caught.value.problems, beginnings, strict=True):
        assert f"{problem.code} {problem}".startswith(beginning)
    assert "expected a capture (left/<name>.png|jpg" in str(caught.value)


def test_unsuitable_names_and_calibrations_are_refused(root: Path) -> None:
    with pytest.raises(InputError, match="is called 'my capture', expected a name of 1 to 100 letters"):
        open_capture(write_capture(root / "my capture", views=1))
    square = write_capture(root / "square", views=1, size=(64, 64))
    with pytest.raises(CalibrationError, match=r"calibration\.conf: (?s:.)*fx is 0\.563 times fy, expected 1"):
        open_capture(square)
    (root / "calibration.conf").write_text(SHIPPED_CALIBRATION.read_text().replace("fx=701.88", "fx=none"))
    with pytest.raises(CalibrationError, match="fx"):
        open_capture(root)
    (root / "calibration.conf").unlink()
    with pytest.raises(InputError, match=r"the calibration files are none, expected cameras\.toml"):
        open_capture(root)


def to_pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def to_device(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


def to_nothing(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("nowhere")


def locations(problems: tuple[Problem, ...]) -> list[tuple[str, str]]:
    return [(problem.code, problem.where) for problem in problems]


@pytest.mark.parametrize("replace", [to_pipe, to_device, to_nothing])
def test_pictures_and_calibrations_that_are_no_file_are_refused(replace: Change, root: Path) -> None:
    for eye in ("left", "right"):
        replace(root / eye / "000001.png")
    with pytest.raises(InputError) as caught:
        open_capture(root)
    expected = [("unreadable", f"{eye}/000001.png") for eye in ("left", "right")]
    assert locations(caught.value.problems) == expected
    if replace is to_nothing:
        return  # There is no calibration file then.
    other = write_capture(root / "other", views=1)
    replace(other / "calibration.conf")
    with pytest.raises(InputError, match=r"calibration\.conf") as caught:
        open_capture(other)
    assert locations(caught.value.problems) == [("unreadable", "")]


def test_links_in_capture_are_followed(root: Path) -> None:
    for path in (root / "left" / "000001.png", root / "calibration.conf"):
        elsewhere = path.rename(path.with_name(f"{path.name}-elsewhere"))
        path.symlink_to(elsewhere)
    assert len(open_capture(root).view_ids) == 2


def png_header(width: int, height: int) -> bytes:
    chunk = b"IHDR" + struct.pack(">2I5B", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n\0\0\0\r" + chunk + zlib.crc32(chunk).to_bytes(4, "big")


def jpeg_header(width: int, height: int) -> bytes:
    return b"\xff\xd8\xff\xc0\0\x0b\x08" + struct.pack(">2H", height, width) + b"\x01\x01\x11\0"


def test_huge_picture_is_refused_before_decoding_unless_the_limit_is_raised(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = root / "left" / "000000.png"
    for content in (jpeg_header(50_000, 50_000), png_header(20_000, 20_000)):
        picture.write_bytes(content)
        with pytest.raises(InputError, match="REBAR_MAX_IMAGE_PIXELS raises the limit") as caught:
            open_capture(root)
        assert locations(caught.value.problems) == [("size", "left/000000.png")]
    monkeypatch.setenv("REBAR_MAX_IMAGE_PIXELS", "400000000")
    assert read_image_shape(picture) == (20_000, 20_000)
    monkeypatch.setenv("REBAR_MAX_IMAGE_PIXELS", "399999999")
    with pytest.raises(EntryError, match="20000 x 20000"):
        read_image_shape(picture)


@pytest.mark.parametrize(
    "options",
    [
        {"format": "PNG"},
        {"format": "PNG", "dpi": (300, 300)},
        {"format": "JPEG"},
        {"format": "JPEG", "progressive": True},
        {"format": "JPEG", "exif": b"Exif\0\0" + bytes(60_000), "icc_profile": bytes(200_000), "comment": "c"},
        {"format": "JPEG", "dpi": (300, 300), "quality": 1, "restart_marker_blocks": 1},
    ],
)
@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_picture_sizes_agree_with_pillow(options: dict[str, Any], mode: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    Image.new(mode, (65, 36)).save(path, **options)
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
