"""Captures: reading, and rejection of invalid input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from rebar_depth_bench.base.errors import CalibrationError, InputError
from rebar_depth_bench.captures.views import is_capture, open_capture
from tests.bench.captures.example_capture import ZED_CALIBRATION, write_capture


def test_capture_lists_views_and_describes_camera(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed-1", views=2)
    assert is_capture(root)
    assert not is_capture(tmp_path)
    capture = open_capture(root)
    assert capture.expected_views() == {"zed-1/000000": (36, 64), "zed-1/000001": (36, 64)}
    description = capture.describe_camera()
    assert "fx 35.09, fy 35.09" in description  # 701.88 * 64 / 1280, 701.70 * 36 / 720
    assert "baseline 119.98 mm" in description
    assert "not of rectified ones" in description


def test_capture_accepts_toml_and_jpeg(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "c", views=1)
    (root / "calibration.conf").unlink()
    (root / "calibration.toml").write_text(
        "[left]\nfx = 50\nfy = 50\ncx = 31.5\ncy = 17.5\ndistortion = [0, 0, 0, 0]\n"
        "[right]\nfx = 50\nfy = 50\ncx = 31.5\ncy = 17.5\ndistortion = [0, 0, 0, 0]\n"
        "[stereo]\nrotation = [0, 0, 0]\nbaseline_m = 0.1\n"
    )
    for eye in ("left", "right"):
        (root / eye / "000000.png").rename(root / eye / "000000.tmp")
        Image.open(root / eye / "000000.tmp").save(root / eye / "000000.JPG", "JPEG")
    description = open_capture(root).describe_camera()
    assert "baseline 100.00 mm" in description
    assert "not of rectified ones" not in description


def delete_right_image(root: Path) -> None:
    (root / "right" / "000001.png").unlink()


def resize_right_image(root: Path) -> None:
    Image.new("L", (32, 18)).save(root / "right" / "000001.png")


def corrupt_left_image(root: Path) -> None:
    (root / "left" / "000001.png").write_bytes(b"none")


def rename_with_space(root: Path) -> None:
    for eye in ("left", "right"):
        (root / eye / "000001.png").rename(root / eye / "view one.png")


def duplicate_name(root: Path) -> None:
    Image.new("L", (64, 36)).save(root / "left" / "000001.jpg")


def delete_all_images(root: Path) -> None:
    for file in (*(root / "left").iterdir(), *(root / "right").iterdir()):
        file.unlink()


@pytest.mark.parametrize(
    ("damage", "beginnings"),
    [
        (delete_right_image, ["missing left/000001.png: has no right/000001"]),
        (resize_right_image, ["invalid right/000001.png: is 32 x 18, expected 64 x 36"]),
        (corrupt_left_image, ["damaged left/000001.png: is not a readable image"]),
        (rename_with_space, ["name left/view one.png: ", "name right/view one.png: "]),
        (duplicate_name, ["duplicate left/000001.png: "]),
        (delete_all_images, ["missing left/: has no images"]),
    ],
)
def test_invalid_capture_raises_with_expected_layout(
    damage: Callable[[Path], None], beginnings: list[str], tmp_path: Path
) -> None:
    root = write_capture(tmp_path / "c", views=2)
    damage(root)
    with pytest.raises(InputError) as caught:
        open_capture(root)
    for problem, beginning in zip(caught.value.problems, beginnings, strict=True):
        assert f"{problem.code} {problem}".startswith(beginning)
    assert "expected a capture (left/<name>.png|jpg" in str(caught.value)


def test_folder_name_invalid_in_view_id_raises(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the folder is called 'my capture', expected a name of 1 to 100 letters"):
        open_capture(write_capture(tmp_path / "my capture", views=1))


def test_unsuitable_calibration_raises(tmp_path: Path) -> None:
    square = write_capture(tmp_path / "square", views=1, size=(64, 64))
    with pytest.raises(CalibrationError, match=r"calibration\.conf: (?s:.)*fx is 0\.563 times fy, expected 1"):
        open_capture(square)
    without = write_capture(tmp_path / "without", views=1)
    (without / "calibration.conf").unlink()
    with pytest.raises(InputError, match=r"the calibration files are none, expected cameras\.toml"):
        open_capture(without)
    broken = write_capture(tmp_path / "broken", views=1)
    (broken / "calibration.conf").write_text(ZED_CALIBRATION.replace("fx=701.88", "fx=none"))
    with pytest.raises(CalibrationError, match="fx"):
        open_capture(broken)
