"""Real captures and folders of depth maps: reading, and rejection of invalid input."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rebar_depth_bench.studies.depth_source import open_depths

from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.captures.folder import is_capture, open_capture
from rebar_depth_bench.errors import CalibrationError, InputError, ProblemCode, SubmissionError
from rebar_depth_bench.submission import EntryError
from tests.bench.studies.captures import ZED_CALIBRATION, write_capture
from tests.bench.submission.zips import exr, npz, png

DEPTH = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
VIEWS = {"walk/a": (3, 4), "walk/b": (3, 4)}


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


def test_depth_folder_reads_every_format(tmp_path: Path) -> None:
    units = np.round(DEPTH.astype(np.float64) * 1000)
    (tmp_path / "submission.json").write_text('{"method": "mine", "depth_scale": 0.001}')
    (tmp_path / "walk").mkdir()
    files: dict[str, Callable[[Path], object]] = {
        "a.npy": lambda path: np.save(path, DEPTH),
        "a.npz": lambda path: path.write_bytes(npz(depth=DEPTH)),
        "walk/a.exr": lambda path: exr(path, {"Z": DEPTH}),
        "a.png": lambda path: path.write_bytes(png(units)),
    }
    for name, write in files.items():
        path = tmp_path / name
        write(path)
        with open_depths(tmp_path, VIEWS) as source:
            assert (source.method, source.view_ids) == ("mine", ("walk/a",))
            expected = units * 0.001 if name == "a.png" else DEPTH
            assert np.array_equal(source.read("walk/a"), expected), name
        path.unlink()


def test_folder_and_archive_are_read_alike(tmp_path: Path) -> None:
    archive, folder = tmp_path / "a.zip", tmp_path / "method-x"
    folder.mkdir()
    with SubmissionWriter(archive, method="method-y") as writer:
        for view_id in VIEWS:
            writer.add(view_id, DEPTH)
            np.save(folder / f"{view_id.partition('/')[2]}.npy", DEPTH)
    with open_depths(archive, VIEWS) as from_archive, open_depths(folder, VIEWS) as from_folder:
        assert (from_archive.method, from_folder.method) == ("method-y", "method-x")
        assert from_archive.view_ids == from_folder.view_ids == tuple(VIEWS)
        assert np.array_equal(from_archive.read("walk/b"), from_folder.read("walk/b"))
        assert from_archive.sha256() != from_folder.sha256()
        before = from_folder.sha256()
    np.save(folder / "b.npy", 2 * DEPTH)
    with open_depths(folder, VIEWS) as changed:
        assert changed.sha256() != before


@pytest.mark.parametrize(
    ("files", "code", "where"),
    [
        ({}, "missing", ""),
        ({"c.npy": b""}, "missing", ""),
        ({"a.npy": b"", "a.npz": b""}, "duplicate", "walk/a"),
        ({"a.png": b""}, "missing", "submission.json: depth_scale"),
        ({"a.npy": b"", "submission.json": b"{"}, "syntax", "submission.json"),
        ({"a.npy": b"", "submission.json": b'{"method": 1}'}, "invalid", "submission.json: method"),
    ],
)
def test_invalid_depth_folder_raises_on_open(
    files: dict[str, bytes], code: ProblemCode, where: str, tmp_path: Path
) -> None:
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SubmissionError) as caught:
        open_depths(tmp_path, VIEWS)
    assert [(problem.code, problem.where) for problem in caught.value.problems] == [(code, where)]


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("a.npy", b"\x93NUMPY\x01\x00", "damaged"),
        ("a.npz", b"PK\x03\x04", "damaged"),
        ("a.exr", b"none", "syntax"),
        ("a.png", png(np.ones((3, 4)), bits=8), "invalid"),
        ("a.png", png(np.ones((4, 3))), "invalid"),
        ("a.png", bytes(10_000_000), "size"),
    ],
)
def test_damaged_depth_file_raises_on_read(name: str, content: bytes, code: ProblemCode, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with open_depths(tmp_path, VIEWS, png_scale=0.001) as source, pytest.raises(EntryError) as caught:
        source.read("walk/a")
    assert (caught.value.problem.code, caught.value.problem.where) == (code, name)


def test_deleted_depth_file_raises_on_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", DEPTH)
    with open_depths(tmp_path, VIEWS) as source:
        (tmp_path / "a.npy").unlink()
        with pytest.raises(EntryError, match=r"a\.npy: it cannot be read: No such file"):
            source.read("walk/a")
