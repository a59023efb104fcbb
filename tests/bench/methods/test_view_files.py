"""Pictures and point clouds of predicted views: scale, points, resumption, refused folders and kinds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.methods import Views, find_method
from rebar_depth_bench.methods.run import dataset_views, predict_views
from rebar_depth_bench.methods.view_files import NO_DEPTH, write_depth_picture, write_point_cloud
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.captures.example_capture import HEIGHT, WIDTH, write_capture, write_images
from tests.bench.methods.predictors import stop_after

METHOD = """
import numpy as np
from rebar_depth_bench.methods import Method, MethodInfo

def load():
    return lambda row: np.where(row["left_rgb"][..., 1] < 60, 0, 0.4 + row["left_rgb"][..., 0] / 100)

METHOD = Method(MethodInfo("own", "a test", ("left_rgb",), False, "here", "MIT", prediction="KIND"), load)
"""


def write_method(path: Path, kind: str = "metric") -> str:
    """Write a method whose depth is that of the red, without depth where there is little green."""
    path.write_text(METHOD.replace("KIND", kind))
    return f"{path}:METHOD"


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Write a raw stereo capture of random colours."""
    root = write_capture(tmp_path / "zed", views=2)
    rng = np.random.default_rng(5)
    for eye in ("left", "right"):
        for view in range(2):
            noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
            Image.fromarray(noise).save(root / eye / f"{view:06d}.png")
    return root


def files_below(folder: Path) -> dict[str, bytes]:
    """Return the content of all files below a folder by their relative path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_points_project_to_their_pixels_of_the_distorted_image(capture: Path, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    trimesh = pytest.importorskip("trimesh")
    archive, out = tmp_path / "a.zip", tmp_path / "out"
    words = ["predict", write_method(tmp_path / "own.py"), "--data", str(capture), "--out", str(archive)]
    assert main([*words, "--ply", str(out), "--pictures", str(out)]) == 0
    views = open_capture(capture)
    assert sorted(files_below(out)) == sorted(
        f"{view}.{kind}" for view in views.view_ids for kind in ("ply", "png")
    )
    with SubmissionReader(archive, dict.fromkeys(views.view_ids, views.grid)) as reader:
        for row in views.rows("left_rgb", "left_K", "left_distortion"):
            assert row["left_distortion"].any()
            depth_m = reader.read(row["view_id"])
            valid = depth_m > 0
            assert 0.5 < valid.mean() < 0.9
            cloud = trimesh.load(out / f"{row['view_id']}.ply")
            points_m = np.asarray(cloud.vertices)
            assert (points_m[:, 2] == depth_m[valid]).all()
            pixels, _ = cv2.projectPoints(
                points_m, np.zeros(3), np.zeros(3), row["left_K"], row["left_distortion"]
            )
            assert np.abs(pixels[:, 0] - np.argwhere(valid)[:, ::-1]).max() < 1e-4
            assert (np.asarray(cloud.colors)[:, :3] == row["left_rgb"][valid]).all()


@pytest.mark.parametrize("kind", ["metric", "affine-depth", "affine-disparity"])
def test_colours_of_pixels_are_those_of_the_scale_at_their_value(kind: str, tmp_path: Path) -> None:
    height, width, size = 480, 640, 13
    values = np.geomspace(0.5, 4, height * width).reshape(height, width).astype(np.float32)
    values[:100, :100] = np.nan
    write_depth_picture(tmp_path / "a.png", "a/0", values, kind)
    with Image.open(tmp_path / "a.png") as opened:
        picture = np.asarray(opened).astype(int)
    low, high = np.percentile(values[np.isfinite(values)], (2, 98))
    nearness: dict[str, Callable[[Any], Any]] = {
        "metric": lambda v: 1 / v,
        "affine-depth": lambda v: -v,
        "affine-disparity": lambda v: v,
    }
    towards = nearness[kind]
    far, near = sorted((towards(low), towards(high)))
    bar_x = width + 2 * size
    image, bar = picture[3 * size :, size : size + width], picture[3 * size : 3 * size + height, bar_x + size // 2]
    assert (image[:100, :100] == NO_DEPTH).all()
    for row, column in ((0, 300), (120, 5), (240, 320), (300, 639), (479, 600)):
        place = np.clip((towards(values[row, column]) - far) / (near - far), 0, 1) * (height - 1)
        assert np.abs(image[row, column] - bar[round(place)]).max() <= 3
    ticks = np.flatnonzero((picture[3 * size : 3 * size + height, bar_x + size + 2] < 100).all(axis=1))
    # 1 / v, -v and v are their own inverses.
    found = [towards(far + (near - far) * tick / (height - 1)) for tick in ticks]
    assert len(found) == 8
    for value in found[1:-1]:
        one_px = max(abs(towards(towards(value) + step * (near - far) / height) - value) for step in (-1, 1))
        assert abs(value - float(f"{value:.2g}")) <= one_px


@pytest.mark.parametrize("depth_m", [[[1.0, 1.0]], [[0.0, np.nan]], [[1e-45, 3e38]], [[2.0]]])
def test_extreme_depth_has_a_picture(depth_m: list[list[float]], tmp_path: Path) -> None:
    for kind in ("metric", "scale", "affine-depth", "affine-disparity"):
        write_depth_picture(tmp_path / "a.png", "a/0", np.array(depth_m, np.float32), kind)
        with Image.open(tmp_path / "a.png") as picture:
            assert 400 < picture.width < 1000
            colours = picture.crop((0, 60, picture.width, picture.height - 60)).getcolors(1 << 20) or []
            has_depth = kind.startswith("affine") or bool((np.array(depth_m) > 0).any())
            assert (len(colours) > 200) == has_depth, "the colour bar"


def orbit(root: Path) -> list[Views]:
    return [*dataset_views(open_folder(root), ["lattice-orbit"])]


def test_resumed_run_writes_files_of_all_views(tiny_root: Path, tmp_path: Path) -> None:
    method, whole, out = find_method("constant"), tmp_path / "whole", tmp_path / "out"
    predict_views(method, orbit(tiny_root), tmp_path / "a.zip", pictures=whole, clouds=whole)
    expected = files_below(whole)
    assert len(expected) == 4
    (out / "lattice-orbit").mkdir(parents=True)
    (out / "lattice-orbit" / "notes.txt").write_text("mine")
    for task in ("constant on", "writing"):
        with pytest.raises(KeyboardInterrupt):
            predict_views(
                method, orbit(tiny_root), tmp_path / "b.zip", stop_after(1, task), pictures=out, clouds=out
            )
        written = files_below(out)
        assert written.pop("lattice-orbit/notes.txt") == b"mine"
        assert written.items() <= expected.items()
        assert not (tmp_path / "b.zip").exists()
    predict_views(method, orbit(tiny_root), tmp_path / "b.zip", pictures=out, clouds=out)
    assert files_below(out) == expected | {"lattice-orbit/notes.txt": b"mine"}


def test_point_clouds_of_values_without_metres_are_refused(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files_below(tmp_path)
    for kind in ("scale", "affine-depth", "affine-disparity"):
        before["own.py"] = METHOD.replace("KIND", kind).encode()
        method = write_method(tmp_path / "own.py", kind)
        words = ["predict", method, "--data", str(capture), "--out", str(tmp_path / "a.zip")]
        assert main([*words, "--ply", str(tmp_path / "out")]) == 2
        assert f"own predicts the kind {kind}" in capsys.readouterr().err
        assert {name: files_below(tmp_path)[name] for name in before} == before
        assert not (tmp_path / "out").exists()
        assert not (tmp_path / "a.zip").exists()


def test_folders_that_hold_inputs_or_are_files_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_images(tmp_path, "mine", size=(64, 48))
    camera = "width = 64\nheight = 48\n[left]\nfx = 50\nfy = 50\ncx = 31.5\ncy = 23.5\ndistortion = [0, 0, 0, 0]\n"
    (tmp_path / "mine" / "calibration.toml").write_text(camera)
    before = files_below(tmp_path)
    archive = tmp_path / "a.zip"
    words = ["predict", "constant", "--data", str(tmp_path / "mine"), "--out", str(archive)]
    for folder, reason in (
        (tmp_path, "its files would be in"),
        (tmp_path / "mine", "which is an input"),
        (tmp_path / "mine" / "pictures", "expected a path outside the input"),
        (tmp_path / "mine" / "0001.png", "expected a path outside the input"),
        (archive, "both name"),
        (Path("/dev/null"), "expected a"),
    ):
        for option in ("--pictures", "--ply"):
            assert main([*words, option, str(folder)]) == 2
            assert reason in " ".join(capsys.readouterr().err.split())
            assert files_below(tmp_path) == before


def test_lens_that_cannot_be_inverted_is_refused(tiny_root: Path, tmp_path: Path) -> None:
    [row, _] = [
        {**row} for views in orbit(tiny_root) for row in views.rows("left_rgb", "left_K", "left_distortion")
    ]
    row["left_distortion"] = np.array([-5.0, 0, 0, 0, 0])
    with pytest.raises(
        InputError, match=r"lattice-orbit/.*: its point cloud cannot be computed, .*: the lens model"
    ):
        write_point_cloud(tmp_path / "a.ply", np.ones(row["left_rgb"].shape[:2], np.float32), row)
    assert not any(tmp_path.iterdir())
