"""Pipes, devices, links and huge pictures in the place of the files that studies read."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rebar_depth_bench.studies.depth_source import open_depths
from rebar_depth_bench.studies.kitti import command as kitti_command
from rebar_depth_bench.studies.kitti.ground_truth import find_truth, read_truth

from rebar_depth_bench.captures.folder import open_capture
from rebar_depth_bench.captures.image_header import read_image_shape
from rebar_depth_bench.errors import DatasetError, InputError, Problem, SubmissionError
from rebar_depth_bench.submission import EntryError, open_submission
from rebar_depth_bench.submission.metadata import MAX_METADATA_BYTES
from rebar_depth_bench.submission.zip_directory import FileSource
from tests.bench.studies import kitti_folder as kitti
from tests.bench.studies.captures import write_capture
from tests.bench.studies.commands import run_study

DEPTH = np.ones((3, 4), np.float32)
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


@pytest.fixture
def depths(tmp_path: Path) -> Path:
    """Return a folder of two depth maps and their metadata."""
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, DEPTH)
    (tmp_path / "submission.json").write_text('{"method": "m"}')
    return tmp_path


@pytest.mark.parametrize("replace", [to_pipe, to_device, to_nothing])
def test_depth_folder_refuses_what_is_no_file(replace: Replace, depths: Path) -> None:
    replace(depths / "b.npy")
    replace(depths / "submission.json")
    with pytest.raises(SubmissionError) as caught:
        open_depths(depths, VIEWS)
    assert locations(caught.value.problems) == [("kind", "b.npy"), ("unreadable", "submission.json")]


def test_depth_file_that_becomes_pipe_is_refused(depths: Path) -> None:
    with open_depths(depths, VIEWS) as source:
        to_pipe(depths / "a.npy")
        with pytest.raises(EntryError, match="it is a named pipe"):
            source.read("walk/a")


def test_links_in_depth_folder_are_followed(depths: Path) -> None:
    for name in ("a.npy", "submission.json"):
        to_link(depths / name)
    with open_depths(depths, VIEWS) as source:
        assert (source.method, source.view_ids) == ("m", tuple(VIEWS))
        assert np.array_equal(source.read("walk/a"), DEPTH)


def test_folder_name_that_is_not_text_is_a_printable_method_name(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"a\xff\x1b[2J")
    folder.mkdir()
    np.save(folder / "a.npy", DEPTH)
    with open_depths(folder, VIEWS) as source:
        assert source.method == "a\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}[2J"


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (b'{"method": "m", "x": "' + b"x" * MAX_METADATA_BYTES + b'"}', "size"),
        (b'{"method": "m", "method": "n"}', "duplicate"),
    ],
)
def test_metadata_of_depth_folder_is_limited_and_strict(content: bytes, code: str, depths: Path) -> None:
    (depths / "submission.json").write_bytes(content)
    with pytest.raises(SubmissionError) as caught:
        open_depths(depths, VIEWS)
    assert locations(caught.value.problems) == [(code, "submission.json")]


@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_archive_that_is_no_file_is_refused(replace: Replace, tmp_path: Path) -> None:
    replace(tmp_path / "a.zip")
    with pytest.raises(OSError, match="not a regular file"):
        FileSource(tmp_path / "a.zip")
    with open_submission(tmp_path / "a.zip", VIEWS) as reader:
        assert locations(reader.structure_problems) == [("kind", "")]


@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_kitti_predictions_that_are_no_file_exit_with_status_2(
    replace: Replace, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    kitti.write_raw(tmp_path / "kitti", kitti.first_images(1))
    replace(tmp_path / "a.zip")
    options = ("--predictions", tmp_path / "a.zip", "--kitti", tmp_path / "kitti", "--ground-truth", "raw")
    assert run_study(kitti_command, *options) == 2
    assert "not a regular file" in capsys.readouterr().err


def kitti_files(root: Path) -> list[Path]:
    image = kitti.first_images(1)[0]
    day = root / image.date
    return [kitti.scan_path(root, image), day / "calib_cam_to_cam.txt", day / "calib_velo_to_cam.txt"]


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_raw_kitti_file_that_is_no_file_is_refused(replace: Replace, index: int, tmp_path: Path) -> None:
    images = kitti.first_images(1)
    kitti.write_raw(tmp_path, images)
    path = kitti_files(tmp_path)[index]
    replace(path)
    with pytest.raises(DatasetError, match=path.name) as caught:
        read_truth(find_truth(tmp_path, images, "raw")[0][0])
    assert locations(caught.value.problems) == [("unreadable", "")]


def test_links_in_kitti_folder_are_followed(tmp_path: Path) -> None:
    images = kitti.first_images(1)
    kitti.write_raw(tmp_path, images)
    expected = read_truth(find_truth(tmp_path, images, "raw")[0][0])
    to_link(kitti_files(tmp_path)[0])
    assert np.array_equal(read_truth(find_truth(tmp_path, images, "raw")[0][0]), expected)


@pytest.mark.parametrize("replace", [to_pipe, to_device])
def test_improved_kitti_map_that_is_no_file_is_refused(replace: Replace, tmp_path: Path) -> None:
    images = kitti.first_images(1)
    path = kitti.improved_path(tmp_path, images[0])
    path.parent.mkdir(parents=True)
    replace(path)
    with pytest.raises(DatasetError, match=path.name):
        find_truth(tmp_path, images, "improved")


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
    images = kitti.first_images(1)
    kitti.write_improved(kitti.improved_path(tmp_path, images[0]), np.ones((3, 4)))
    monkeypatch.setenv("REBAR_MAX_IMAGE_PIXELS", "11")
    with pytest.raises(DatasetError, match="3 x 4"):
        find_truth(tmp_path, images, "improved")


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
