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
pytest.importorskip("sqlalchemy")

import numpy as np
from PIL import Image

from leaderboard.settings import read_settings
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.terminal import terminal_text
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.scoring.result import read_result
from rebar_depth_bench.submission.declaration import parse_metadata
from rebar_depth_bench.submission.entries import FORMATS
from tests.bench.captures import calibration_files as calibrations
from tests.bench.captures.example_capture import write_capture
from tests.bench.captures.test_cameras_toml import BOARD, POSES
from tests.bench.damage import damaged
from tests.bench.geometry.calibrations import CONF, TOML, write_and_read
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view
from tests.bench.submission.zips import exr, npz, png

CASES = 300
SECONDS = 1.0
DEPTH = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
SETTINGS = (
    b'data = "x"\nquota = 7\nport = 80\nmax_upload = "3GiB"\nlease_seconds = 5\nrescore = true\nscore_time = 1.5\n'
)

Read = Callable[[Path, bytes], object]


def is_finite(value: object) -> bool:
    """Return whether all numbers in nested tuples are finite."""
    if isinstance(value, tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float) or bool(np.isfinite(value))


def calibration(folder: Path, content: bytes, name: str) -> None:
    assert is_finite(astuple(write_and_read(folder, content, name)))


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


def capture_image(folder: Path, content: bytes, name: str) -> None:
    root = folder / "capture"
    if not root.exists():
        write_capture(root, views=1)
        (root / "right" / "000000.png").unlink()
    (root / "right" / name).write_bytes(content)
    assert open_capture(root).expected_views() == {"capture/000000": (36, 64)}


def depth_file(_: Path, content: bytes, suffix: str) -> None:
    assert FORMATS[suffix].decode(f"walk/a{suffix}", memoryview(content), (3, 4), 0.001).shape == (3, 4)


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
    "cameras.toml": (
        lambda _: (calibrations.TOML + BOARD + POSES).encode(),
        partial(cameras, name="cameras.toml"),
    ),
    "OpenCV YAML": (partial(opencv_bytes, suffix="yml"), partial(cameras, name="a.yml")),
    "OpenCV XML": (partial(opencv_bytes, suffix="xml"), partial(cameras, name="a.xml")),
    "OpenCV JSON": (partial(opencv_bytes, suffix="json"), partial(cameras, name="a.json")),
    "Kalibr chain": (lambda _: calibrations.kalibr_text().encode(), partial(cameras, name="a.yaml")),
    "capture PNG": (lambda _: image_bytes("PNG"), partial(capture_image, name="000000.png")),
    "capture JPEG": (lambda _: image_bytes("JPEG"), partial(capture_image, name="000000.jpg")),
    "depth npy": (lambda _: npy_bytes(), partial(depth_file, suffix=".npy")),
    "depth npz": (lambda _: npz(depth=DEPTH), partial(depth_file, suffix=".npz")),
    "depth exr": (
        lambda folder: exr(folder / "sound.exr", {"Z": DEPTH}),
        partial(depth_file, suffix=".exr"),
    ),
    "depth png": (lambda _: png(DEPTH * 1000.0), partial(depth_file, suffix=".png")),
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
@pytest.mark.parametrize("name", ["depth npy", "depth npz", "depth exr", "depth png"])
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
