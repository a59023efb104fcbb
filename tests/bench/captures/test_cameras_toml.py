"""``cameras.toml``: cameras, board and poses of a capture, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("cv2")

import numpy as np
from PIL import Image

from rebar_depth_bench.base.errors import CalibrationError, InputError
from rebar_depth_bench.captures.views import ImageViews, open_capture
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import inverse_rigid
from tests.bench.captures import calibration_files as files

POSES = """
[[pose]]
image = "0001"
cam_from_world = [[1, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 0.5], [0, 0, 0, 1]]
[[pose]]
image = "0002"
cam_from_world = [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
"""
BOARD = '[board]\nmarkers = 12\nmarker_side_m = 0.03\ndictionary = "DICT_4X4_50"\n'


def write_images(root: Path, *folders: str, size: tuple[int, int] = (files.WIDTH, files.HEIGHT)) -> None:
    """Write two images of random colour into each folder."""
    rng = np.random.default_rng(3)
    for folder in folders:
        (root / folder).mkdir(parents=True, exist_ok=True)
        for name in ("0001", "0002"):
            pixels = rng.integers(0, 255, (size[1], size[0], 3), np.uint8)
            Image.fromarray(pixels).save(root / folder / f"{name}.png")


def stereo(root: Path, text: str) -> ImageViews:
    write_images(root, "left", "right")
    (root / "cameras.toml").write_text(text)
    return open_capture(root)


def test_pair_with_board_and_poses(tmp_path: Path) -> None:
    views = stereo(tmp_path / "site", files.TOML + BOARD + POSES)
    assert views.view_ids == ("site/0001", "site/0002")
    assert views.board == BoardSpec(markers=12, marker_side_m=0.03)
    assert not views.board_is_assumed
    assert views.has_poses
    row = next(views.rows("left_rgb", "right_cam_from_world", "left_cam_from_world", "baseline_m", "left_K"))
    assert row["view_id"] == "site/0001"
    assert np.array_equal(row["left_rgb"], np.asarray(Image.open(tmp_path / "site" / "left" / "0001.png")))
    assert np.array_equal(row["left_K"], files.LEFT_K)
    right_from_left = row["right_cam_from_world"] @ inverse_rigid(row["left_cam_from_world"])
    assert np.allclose(right_from_left[:3, :3], files.ROTATION, atol=1e-12)
    assert np.allclose(right_from_left[:3, 3], files.TRANSLATION_M, atol=1e-12)
    assert row["baseline_m"] == pytest.approx(np.linalg.norm(files.TRANSLATION_M))


def test_without_poses_the_world_is_the_left_camera(tmp_path: Path) -> None:
    views = stereo(tmp_path / "site", files.TOML)
    assert not views.has_poses
    assert views.board == BoardSpec()
    assert views.board_is_assumed
    for row in views.rows("left_cam_from_world"):
        assert np.array_equal(row["left_cam_from_world"], np.eye(4))


@pytest.mark.parametrize("folder", ["", "left"])
def test_images_of_one_camera(folder: str, tmp_path: Path) -> None:
    root = tmp_path / "mono"
    write_images(root, folder)
    camera = files.TOML.partition("[right]")[0]
    (root / "cameras.toml").write_text(camera + POSES)
    views = open_capture(root)
    assert views.view_ids == ("mono/0001", "mono/0002")
    assert set(views.columns) == {"left_rgb", "left_K", "left_distortion", "left_cam_from_world"}
    assert views.rectify
    with pytest.raises(InputError, match="sgbm needs right_rgb, but these images have only left_rgb"):
        views.check_columns(("left_rgb", "right_rgb"), "sgbm")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (files.TOML.replace("534.07", "0"), ("invalid", "left.fx", None)),
        (files.TOML.replace("341.53", "641"), ("invalid", "left.cx", None)),
        (files.TOML + "[camera]\n", ("unknown", "camera", 12)),
        ('calibration = "a.yml"\n' + files.TOML, ("conflict", "calibration", 1)),
        ('calibration = "../a.yml"\n', ("invalid", "calibration", 1)),
        ('calibration = ["a.yml", "b.yml", "c.yml"]\n', ("invalid", "calibration", 1)),
        ('unit = "inch"\n' + files.TOML, ("invalid", "unit", 1)),
        (files.TOML + "[board]\nmarkers = 7\n", ("invalid", "board.markers", 13)),
        (files.TOML + "[board]\nmarker_side_m = 0.5\n", ("conflict", "board", 12)),
        (files.TOML + POSES.replace("0002", "0001"), ("duplicate", "pose", 13)),
        (files.TOML + POSES.replace("0002", "0003"), ("missing", "pose", 13)),
        (files.TOML + POSES.replace("[0, 1, 0, 0]", "[0, 2, 0, 0]"), ("invalid", "pose 2: cam_from_world", 18)),
        (files.TOML + POSES.replace("[0, 0, 0, 1]", "[0, 0, 0]"), ("invalid", "pose 1: cam_from_world 4", 15)),
        (files.TOML.replace("[stereo]", "[pair]"), ("unknown", "pair", 9)),
        ("[left]\nK = 3\n[right", ("syntax", "", None)),
    ],
)
def test_invalid_table_is_refused_with_its_line(
    text: str, expected: tuple[str, str, int | None], tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError) as caught:
        stereo(tmp_path / "site", text)
    assert "cameras.toml" in str(caught.value)
    problem = caught.value.problems[0]
    code, where, line = expected
    assert (problem.code, problem.where) == (code, where)
    assert line is None or problem.found.startswith(f"line {line}: ")


def test_missing_file_of_the_calibration_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent\.yml"):
        stereo(tmp_path / "site", 'calibration = "absent.yml"\n')


def test_intrinsics_of_images_of_another_shape_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "site"
    write_images(root, "left", "right", size=(640, 360))
    (root / "cameras.toml").write_text(files.TOML)
    with pytest.raises(CalibrationError, match=r"cameras\.toml") as caught:
        open_capture(root)
    assert [problem.code for problem in caught.value.problems] == ["conflict"]


def test_several_calibrations_without_cameras_toml_are_refused(tmp_path: Path) -> None:
    root = tmp_path / "site"
    write_images(root, "left", "right")
    files.write_opencv(root, "yml")
    files.write_opencv(root, "xml")
    files.write_opencv(root, "json")
    with pytest.raises(InputError, match=r"stereo\.json, stereo\.xml, stereo\.yml"):
        open_capture(root)
