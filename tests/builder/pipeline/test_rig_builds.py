"""Builds with rigs of each form and with given poses, up to audit and score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.cameras.trajectories import poses
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.pipeline.build import plan_build
from dataset_builder.user_files.rig_file import read_rig
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.cameras import camera_centre, transform
from tests.bench.captures import calibration_files as files
from tests.builder.catalog.scene_files import BAR, MM, scene_config, write_scene
from tests.builder.pipeline.test_scene_builds import rank_error_of_exact_depth
from tests.building import TWO_BARS, RunBuild

POSITIONS_MM = [[0, 0, 400], [60, 40, 300], [200, -50, 100]]
TARGETS_MM = [[0, 0, 0], [60, 40, 0], [0, 0, 30]]
POSES = f'[cameras]\nkind = "poses"\npositions = {POSITIONS_MM}\ntargets = {TARGETS_MM}\nup = [0, 2, 0]\n'
NUMBERS = "[rig]\nwidth = 640\nheight = 400\nbaseline = 75\nfx = 441\ncx = 310\n"
ACROSS = "[[bar]]\ndiameter = 12\npoints = [[0, -100, 70], [0, 100, 70]]\n"


@pytest.mark.slow
def test_rigs_of_each_form_are_built_audited_and_scored(tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "root"
    files.write_opencv(tmp_path, "yml")
    write_scene(tmp_path, f"{MM}{BAR}{ACROSS}{NUMBERS}{POSES}", "own.toml")
    raw = '[rig]\ncalibration = "stereo.yml"\nwidth = 640\nheight = 480\ngrid = "raw"\n'
    ring = '[cameras]\nkind = "ring"\nradius = 400\nelevation_deg = 40\nazimuths = 2\n'
    write_scene(tmp_path, f"{MM}{BAR}{ACROSS}{raw}{ring}", "lens.toml")
    size = ("--width", "240", "--quality", "preview")
    scenes = (tmp_path / "own.toml", tmp_path / "lens.toml")
    for arguments in (
        ("--scene", *scenes),
        ("--config", "lattice", "--views", "2", "--rig", "Luxonis OAK-D Pro", "--height", "100"),
        ("--scene", TWO_BARS, "--views", "2", "--rig", "Intel RealSense D405"),
    ):
        process = run_build("--out", root, *size, *arguments)
        assert process.returncode == 0, process.stderr
        assert ("50 rows are cropped" in process.stderr) == ("--height" in arguments)

    named = "lattice-luxonis-oak-d-pro"
    focal_px = 640 / np.tan(np.radians(80) / 2) * 240 / 1280
    middle = (240 / 640) * 310.5 - 0.5
    expected = {
        "own": ([[165.375, 0, middle], [0, 165.375, 74.5], [0, 0, 1]], (150, 240), 0.075, "ideal"),
        named: ([[focal_px, 0, 119.5], [0, focal_px, 49.5], [0, 0, 1]], (100, 240), 0.075, "ideal"),
        "two-bars-intel-realsense-d405": (
            [[674.4 * 0.1875, 0, 119.5], [0, 674.4 * 0.1875, 67], [0, 0, 1]], (135, 240), 0.018, "ideal"
        ),
        "lens": (
            [[files.LEFT_K[0, 0] * 0.375, 0, (files.LEFT_K[0, 2] + 0.5) * 0.375 - 0.5],
             [0, files.LEFT_K[1, 1] * 0.375, (files.LEFT_K[1, 2] + 0.5) * 0.375 - 0.5], [0, 0, 1]],
            (180, 240), float(np.linalg.norm(files.TRANSLATION_M)), "raw",
        ),
    }  # fmt: skip
    folder = open_folder(root)
    assert set(folder.config_by_name) == set(expected)
    for name, (K, grid, baseline_m, optics) in expected.items():
        config = folder.config(name)
        assert config.scene.rig is not None
        assert (config.grid, config.scene.rig.grid) == (grid, optics)
        assert config.scene.rig.baseline_m == pytest.approx(baseline_m, abs=1e-12)
        for row in rdb.load(root, name):
            assert row["left_K"] == pytest.approx(np.array(K), abs=0.01)  # Named cameras are rounded to 0.1 px.
            assert row["left_depth"].shape == grid
            assert row["baseline_m"] == pytest.approx(baseline_m, abs=1e-12)
            assert row["left_mask"].any()
            if name == "lens":
                assert np.array_equal(row["left_distortion"], files.LEFT_D)
    for row, position_mm, target_mm in zip(rdb.load(root, "own"), POSITIONS_MM, TARGETS_MM, strict=True):
        pose = row["left_cam_from_world"]
        np.testing.assert_allclose(camera_centre(pose), np.array(position_mm) / 1000, atol=1e-12)
        np.testing.assert_allclose(transform(pose, np.array(target_mm) / 1000)[:2], 0, atol=1e-12)
        assert pose[1, :3] @ [0, 1, 0] < 0  # World y points up in the image.
    (spec,) = BuildRequest(("lattice",)).config_specs()
    for n, row in zip((126, 378), rdb.load(root, named), strict=True):
        default = poses(spec.protocol, np.array(folder.config(named).scene.aim_point_m), spec.rig)[n]
        np.testing.assert_allclose(camera_centre(row["left_cam_from_world"]), camera_centre(default), atol=1e-12)

    assert audit(root, depth_views=1).failures == ()
    card = (root / "README.md").read_text()
    assert "0.2177-0.4 m, target aimed at" in card
    assert "`own`: ideal pinholes; baseline 0.075 m." in card
    assert rank_error_of_exact_depth(root, "own", tmp_path) < 1e-6


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "up = [0, 2, 0]",
            "",
            r"cameras.targets: the line of sight of position 1 is .* up = \[0.0, 0.0, 1.0\]",
        ),
        ("[60, 40, 0], ", "", "cameras.targets: got 2 targets, expected as many as positions, 3, or one"),
        ("[0, 0, 400]", "[0, 0, 0]", "cameras.targets: the line of sight of position 1 is parallel"),
        ("[0, 0, 400]", "[0, 0, 50]", "the left camera of view 1 of my-beam is inside of a bar"),
        (
            "[0, 0, 400]",
            "[0, 0, -400]",
            r"the left camera of view 1 of my-beam is not above the ground, at \[0.*-0.4\]",
        ),
        ("positions = ", "places = ", "cameras.positions: missing"),
    ],
)
def test_invalid_poses_are_refused(old: str, new: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        scene_config(write_scene(tmp_path, MM + BAR + NUMBERS + POSES.replace(old, new)))


def test_both_cameras_are_tested_against_ground_and_steel_with_each_rig(tmp_path: Path) -> None:
    beside = '[cameras]\nkind = "poses"\npositions = [[-75, 50, 70]]\ntargets = [[-75, 50, 0]]\nup = [0, 1, 0]\n'
    with pytest.raises(InputError, match="the right camera of view 1 of my-beam is inside of a bar"):
        scene_config(write_scene(tmp_path, MM + BAR + ACROSS + NUMBERS + beside))
    config = scene_config(write_scene(tmp_path, MM + BAR + ACROSS + beside))
    request = BuildRequest((), scenes=(config,), rig=read_rig("Luxonis OAK-D"), rig_name="oak")
    with pytest.raises(InputError, match="the right camera of view 1 of my-beam-oak is inside of a bar"):
        plan_build(request, tmp_path / "root")
    below = beside.replace("[-75, 50, 70]", "[0, -400, 50]").replace("[-75, 50, 0]", "[0, 0, 50]")
    with pytest.raises(InputError, match="the right camera of view 1 of my-beam is not above the ground"):
        scene_config(write_scene(tmp_path, MM + BAR + below.replace("[0, 1, 0]", "[1, 0, 0]")))


def test_up_is_up_in_the_images(tmp_path: Path) -> None:
    config = scene_config(write_scene(tmp_path, MM + BAR + NUMBERS + POSES.replace("[0, 2, 0]", "[3, 0, 0]")))
    down = poses(config.protocol, np.zeros(3), config.rig)[0]
    np.testing.assert_allclose(down[:3, :3], [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], atol=1e-12)


def test_one_target_is_that_of_all_positions(tmp_path: Path) -> None:
    lefts = []
    for targets in ([[0, 0, 30]], [[0, 0, 30]] * 3):
        table = POSES.replace(str(TARGETS_MM), str(targets))
        config = scene_config(write_scene(tmp_path, MM + BAR + NUMBERS + table))
        lefts.append(poses(config.protocol, np.zeros(3), config.rig))
    np.testing.assert_array_equal(lefts[0], lefts[1])
