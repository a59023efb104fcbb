"""Seeded damage of every file that the bench's readers take: an ``InputError`` or sound values, and quickly."""

from __future__ import annotations

import io
import json
import random
import time
from collections.abc import Callable, Mapping
from dataclasses import astuple
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("cv2")
pytest.importorskip("pydantic_settings")

import numpy as np
from PIL import Image
from rebar_depth_bench.captures.kitti_calibration import read_camera, read_pair
from rebar_depth_bench.captures.kitti_images import read_images
from rebar_depth_bench.studies.depth_source import open_depths
from rebar_depth_bench.studies.kitti.ground_truth import find_truth, project_scan, read_scan, read_truth

from leaderboard.settings import read_settings
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.folder import open_capture
from rebar_depth_bench.errors import InputError, terminal_text
from rebar_depth_bench.scoring.result_io import read_result
from rebar_depth_bench.submission.metadata import parse_metadata
from tests.bench.captures import calibration_files as calibrations
from tests.bench.captures.test_cameras_toml import BOARD, POSES
from tests.bench.damage import damaged
from tests.bench.geometry.calibrations import CONF, TOML, write_and_read
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view
from tests.bench.studies import kitti_folder as kitti
from tests.bench.studies.captures import write_capture
from tests.bench.submission.zips import exr, npz, png

CASES = 300
SECONDS = 1.0
DEPTH = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
IMAGE = kitti.first_images(1)[0]
SETTINGS = b'data = "x"\nquota = 7\nport = 80\nmax_upload = "3GiB"\nlease = 5\nrescore = true\nscore_time = 1.5\n'

Read = Callable[[Path, bytes], object]


def is_finite(value: object) -> bool:
    """Return whether all numbers in nested tuples are finite."""
    if isinstance(value, tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float) or bool(np.isfinite(value))


def calibration(folder: Path, content: bytes, name: str) -> None:
    assert is_finite(astuple(write_and_read(folder, content, name)))


def kitti_calibration(folder: Path, content: bytes, name: str) -> None:
    kitti.write_day(folder)
    (folder / name).write_bytes(content)
    camera = read_camera(folder, 2)
    assert np.isfinite(camera.image_from_velo).all()
    assert np.isfinite(project_scan(kitti.random_scan(1, 100), camera)).all()


def kitti_pair(folder: Path, content: bytes) -> None:
    kitti.write_day(folder)
    (folder / "calib_cam_to_cam.txt").write_bytes(content)
    assert is_finite(astuple(read_pair(folder)))


def kitti_list(folder: Path, content: bytes) -> None:
    (folder / "images.txt").write_bytes(content)
    assert all(image.name.isprintable() for image in read_images(folder / "images.txt"))


def cameras(folder: Path, content: bytes, name: str) -> None:
    (folder / name).write_bytes(content)
    try:
        read = read_cameras(folder, ["0001", "0002"], calibrations.WIDTH, calibrations.HEIGHT, is_stereo=True)
    finally:
        (folder / name).unlink()
    assert is_finite(astuple(read.calibration))
    assert all(np.isfinite(pose).all() for pose in read.cam_from_world.values())


def opencv_bytes(folder: Path, suffix: str) -> bytes:
    calibrations.write_opencv(folder, suffix)
    content = (folder / f"stereo.{suffix}").read_bytes()
    (folder / f"stereo.{suffix}").unlink()
    return content


def scan(folder: Path, content: bytes) -> None:
    kitti.write_day(folder)
    (folder / "scan.bin").write_bytes(content)
    assert np.isfinite(project_scan(read_scan(folder / "scan.bin"), read_camera(folder, 2))).all()


def improved(folder: Path, content: bytes) -> None:
    path = kitti.improved_path(folder, IMAGE)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    [truth] = find_truth(folder, (IMAGE,), "improved")[0]
    depth_m = read_truth(truth)
    assert depth_m.shape == truth.shape
    assert np.isfinite(depth_m).all()


def capture_image(folder: Path, content: bytes, name: str) -> None:
    root = folder / "capture"
    if not root.exists():
        write_capture(root, views=1)
        (root / "right" / "000000.png").unlink()
    (root / "right" / name).write_bytes(content)
    assert open_capture(root).expected_views() == {"capture/000000": (36, 64)}


def depth_file(folder: Path, content: bytes, name: str) -> None:
    (folder / name).write_bytes(content)
    with open_depths(folder, {"walk/a": (3, 4)}, png_scale=0.001) as source:
        assert source.read("walk/a").shape == (3, 4)


def depth_folder(folder: Path, content: bytes) -> None:
    np.save(folder / "a.npy", DEPTH)
    (folder / "submission.json").write_bytes(content)
    with open_depths(folder, {"walk/a": (3, 4)}) as source:
        assert source.method.isprintable()


def metadata(_: Path, content: bytes) -> None:
    meta, problems = parse_metadata(content)
    assert (meta is None) == bool(problems)
    if problems:
        raise InputError.from_problems("a.zip", problems)


def result_file(_: Path, content: bytes) -> None:
    read = read_result(content, "result.json")
    again = read.to_json()
    assert read_result(again, "result.json").to_json() == again


def settings(folder: Path, content: bytes) -> None:
    (folder / "board.toml").write_bytes(content)
    read_settings(folder / "board.toml", {"data": "x"})


def image_bytes(kind: str) -> bytes:
    stream = io.BytesIO()
    Image.new("L", (64, 36)).save(stream, kind)
    return stream.getvalue()


def npy_bytes() -> bytes:
    stream = io.BytesIO()
    np.save(stream, DEPTH)
    return stream.getvalue()


READERS: Mapping[str, tuple[Callable[[Path], bytes], Read]] = {
    "calibration.conf": (lambda _: CONF.encode(), partial(calibration, name="a.conf")),
    "calibration.toml": (lambda _: TOML.encode(), partial(calibration, name="a.toml")),
    "KITTI cameras": (
        lambda _: kitti.CAM_TO_CAM.encode(),
        partial(kitti_calibration, name="calib_cam_to_cam.txt"),
    ),
    "KITTI scanner": (
        lambda _: kitti.VELO_TO_CAM.encode(),
        partial(kitti_calibration, name="calib_velo_to_cam.txt"),
    ),
    "KITTI pair": (lambda _: kitti.CAM_TO_CAM.encode(), kitti_pair),
    "KITTI list": (
        lambda _: b"".join(f"{i.date}/{i.drive} {i.frame} {i.side}\n".encode() for i in kitti.first_images(9)),
        kitti_list,
    ),
    "cameras.toml": (
        lambda _: (calibrations.TOML + BOARD + POSES).encode(),
        partial(cameras, name="cameras.toml"),
    ),
    "OpenCV YAML": (partial(opencv_bytes, suffix="yml"), partial(cameras, name="a.yml")),
    "OpenCV XML": (partial(opencv_bytes, suffix="xml"), partial(cameras, name="a.xml")),
    "OpenCV JSON": (partial(opencv_bytes, suffix="json"), partial(cameras, name="a.json")),
    "Kalibr chain": (lambda _: calibrations.kalibr_text().encode(), partial(cameras, name="a.yaml")),
    "KITTI scan": (lambda _: kitti.random_scan(1, 50).tobytes(), scan),
    "KITTI depth": (lambda _: png(np.arange(12).reshape(3, 4) * 256.0), improved),
    "capture PNG": (lambda _: image_bytes("PNG"), partial(capture_image, name="000000.png")),
    "capture JPEG": (lambda _: image_bytes("JPEG"), partial(capture_image, name="000000.jpg")),
    "depth npy": (lambda _: npy_bytes(), partial(depth_file, name="a.npy")),
    "depth npz": (lambda _: npz(depth=DEPTH), partial(depth_file, name="a.npz")),
    "depth exr": (
        lambda folder: exr(folder / "sound.exr", {"Z": DEPTH}),
        partial(depth_file, name="a.exr"),
    ),
    "depth png": (lambda _: png(DEPTH * 1000.0), partial(depth_file, name="a.png")),
    "folder metadata": (lambda _: b'{"method": "m", "depth_scale": 0.001, "url": "http://x.org"}', depth_folder),
    "archive metadata": (lambda _: b'{"method": "m", "runtime": {"s": [1, 2.5]}, "description": "d"}', metadata),
    "result": (
        lambda _: result(
            scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000")
        ).to_json(),
        result_file,
    ),
    "settings": (lambda _: SETTINGS, settings),
}


def outcome(read: Read, folder: Path, content: bytes) -> str:
    """Return whether the content was read or refused; any other exception fails the test."""
    start = time.process_time()
    try:
        read(folder, content)
    except InputError as error:
        message = str(error)
        assert all(len(line) < 1000 for line in message.splitlines()), message
        assert all(line.isprintable() for line in terminal_text(message).split("\n"))
        return "refused"
    finally:
        assert time.process_time() - start < SECONDS
    return "read"


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_damaged_file_is_refused_or_read_soundly(name: str, tmp_path: Path) -> None:
    make, read = READERS[name]
    sound = make(tmp_path)
    read(tmp_path, sound)
    rng = random.Random(name)
    outcomes = [outcome(read, tmp_path, damaged(sound, rng)) for _ in range(CASES)]
    assert outcomes.count("refused") > CASES // 5


@pytest.mark.slow
@pytest.mark.parametrize("name", ["KITTI depth", "depth npy", "depth npz", "depth exr", "depth png"])
def test_file_is_refused_or_read_wherever_it_ends(name: str, tmp_path: Path) -> None:
    make, read = READERS[name]
    sound = make(tmp_path)
    for end in range(len(sound)):
        outcome(read, tmp_path, sound[:end])


@pytest.mark.parametrize(
    "place", [("tables",), ("views",), ("tables", "lattice", "native"), ("views", 0, "within_mm")]
)
@pytest.mark.parametrize("value", [None, 3, "x", [1] * 200_000, {"a": 1}, True, [[]] * 3])
def test_wrong_type_in_result_names_place(place: tuple[str | int, ...], value: object) -> None:
    document = json.loads(result(scored_view("lattice/0000")).to_json())
    target = document
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value
    with pytest.raises(InputError, match=r"result\.json") as caught:
        read_result(json.dumps(document).encode(), "result.json")
    assert any(str(place[0]) in str(problem) for problem in caught.value.problems)
    assert len(str(caught.value)) < 5000
