"""Rigs of named cameras, calibrations and numbers: their cameras, sizes, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from dataset_builder.cameras.rigs import rig_cameras, sized_rig, zed_rig
from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.cli.main import main
from dataset_builder.specs.config_specs import STEREO_CAMERAS, RigSpec
from dataset_builder.user_files.rig_file import read_rig
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.geometry.cameras import Camera, camera_centre, right_from_left
from tests.bench.captures import calibration_files as files
from tests.bench.geometry.calibrations import CONF
from tests.builder.catalog.scene_files import BAR, MM, scene_config, write_scene

NUMBERS = "width = 1280\nheight = 800\nbaseline = 75\nhorizontal_fov_deg = 71.9\n"
LENSES = (files.LEFT_K, files.LEFT_D, files.RIGHT_K, files.RIGHT_D, (files.WIDTH, files.HEIGHT))
POSE = cv2.Rodrigues(np.array([0.3, -0.2, 0.1]))[0]


def scene_rig(folder: Path, table: str) -> RigSpec:
    return scene_config(write_scene(folder, f"{MM}{BAR}[rig]\n{table}")).rig


def cameras(rig: RigSpec) -> dict[str, Camera]:
    pose = np.eye(4)
    pose[:3, :3] = POSE
    return rig_cameras(rig, pose)


def baseline_m(eyes: dict[str, Camera]) -> float:
    centres_m = [camera_centre(camera.cam_from_world) for camera in eyes.values()]
    return float(np.linalg.norm(centres_m[1] - centres_m[0]))


def test_numbers_are_those_of_parallel_square_pinholes(tmp_path: Path) -> None:
    rig = scene_rig(tmp_path, NUMBERS)
    fx = 640 / np.tan(np.radians(71.9) / 2)
    assert (rig.width, rig.height, rig.grid, rig.baseline_m) == (1280, 800, "ideal", 0.075)
    for camera in cameras(rig).values():
        assert pytest.approx(np.array([[fx, 0, 639.5], [0, fx, 399.5], [0, 0, 1]])) == camera.K
        assert not camera.distortion.any()
    assert baseline_m(cameras(rig)) == pytest.approx(0.075, abs=1e-12)
    in_cm = NUMBERS.replace("75", "7.5") + 'unit = "cm"\n'
    assert scene_rig(tmp_path, in_cm) == rig
    off_centre = scene_rig(
        tmp_path, "width = 640\nheight = 400\nbaseline = 75\nfx = 441.25\ncx = 310\ncy = 210.5\n"
    )
    assert cameras(off_centre)["right"].K.tolist() == [[441.25, 0, 310], [0, 441.25, 210.5], [0, 0, 1]]


@pytest.mark.parametrize("suffix", ["toml", "yml"])
def test_calibration_is_rectified_or_raw(suffix: str, tmp_path: Path) -> None:
    (tmp_path / "stereo.toml").write_text(files.TOML)
    files.write_opencv(tmp_path, "yml")
    table = f'calibration = "stereo.{suffix}"\nwidth = 640\nheight = 480\n'
    raw, rectified = scene_rig(tmp_path, table + 'grid = "raw"\n'), scene_rig(tmp_path, table)
    eyes = cameras(raw)
    assert np.array_equal([eyes["left"].K, eyes["right"].K], [files.LEFT_K, files.RIGHT_K])
    assert np.array_equal([eyes["left"].distortion, eyes["right"].distortion], [files.LEFT_D, files.RIGHT_D])
    motion = right_from_left({f"{eye}_cam_from_world": camera.cam_from_world for eye, camera in eyes.items()})
    np.testing.assert_allclose(motion[:3, :3], files.ROTATION, atol=1e-11)
    np.testing.assert_allclose(motion[:3, 3], files.TRANSLATION_M, atol=1e-11)

    _, _, P, *_ = cv2.stereoRectify(*LENSES, files.ROTATION, files.TRANSLATION_M, alpha=0)
    eyes = cameras(rectified)
    np.testing.assert_allclose(eyes["left"].K, P[:, :3], atol=1e-9)
    assert np.array_equal(eyes["left"].K, eyes["right"].K)
    assert baseline_m(eyes) == pytest.approx(np.linalg.norm(files.TRANSLATION_M), abs=1e-12)
    in_mm = 'calibration = "stereo.yml"\nunit = "mm"\nwidth = 640\nheight = 480\n'
    with pytest.raises(
        InputError, match=r"stereo.yml: .*translation_m: .*the baseline a number from 0.001"
    ):  # It is in metres.
        scene_rig(tmp_path, in_mm)


@pytest.mark.parametrize("size", ["", "width = 320\nheight = 240\n"])
def test_rectified_pair_has_the_stated_matrices_P(size: str, tmp_path: Path) -> None:
    for name, text in files.ros_texts(as_message=False).items():
        (tmp_path / name).write_text(text)
    rig = scene_rig(tmp_path, f'calibration = ["left.yaml", "right.yaml"]\n{size}')
    _, _, P, *_ = cv2.stereoRectify(*LENSES, files.ROTATION, files.TRANSLATION_M, alpha=0)
    scale = 0.5 if size else 1.0
    assert (rig.width, rig.height) == (640 * scale, 480 * scale)
    assert cameras(rig)["left"].K[0] == pytest.approx(
        [scale * P[0, 0], 0, scale * (P[0, 2] + 0.5) - 0.5], abs=1e-6
    )
    assert np.array_equal(cameras(rig)["left"].cam_from_world[:3, :3], POSE)


def write_with_changed_P(folder: Path, index: int, change: float) -> None:
    """Write the pair of ROS with a number added to one of P of the right camera."""
    texts = files.ros_texts(as_message=False)
    right = yaml.safe_load(texts["right.yaml"])
    right["projection_matrix"]["data"][index] += change
    (folder / "left.yaml").write_text(texts["left.yaml"])
    (folder / "right.yaml").write_text(yaml.safe_dump(right))


def test_matrices_P_are_made_equal_or_refused(tmp_path: Path) -> None:
    table = 'calibration = ["left.yaml", "right.yaml"]\n'
    write_with_changed_P(tmp_path, 5, 0.004)
    rig = scene_rig(tmp_path, table)
    assert rig.calibration is not None
    assert rig.calibration.is_rectified
    for camera in cameras(rig).values():
        assert np.array_equal(camera.cam_from_world[:3, :3], POSE)
        assert np.array_equal(camera.K, rig.calibration.left.K)
    for index, change, words in (
        (5, -2000.0, "right.yaml: projection_matrix: .*fy"),
        (5, 4.0, "of the two matrices P differ by 4 pixels"),
        (3, 1000.0, r"right.yaml: projection_matrix: .*expected fx above 0 and P\[0, 3\]"),
    ):
        write_with_changed_P(tmp_path, index, change)
        with pytest.raises(InputError, match=words):
            scene_rig(tmp_path, table)


def test_sections_of_a_conf_file_are_those_of_the_requested_size(tmp_path: Path) -> None:
    lenses, motion = CONF.split("[STEREO]")
    angles = "".join(f"{line}\n" for line in motion.splitlines() if "_HD" in line)
    smaller = lenses.replace("=70", "=35")
    path = tmp_path / "zed.conf"
    path.write_text(lenses + smaller.replace("_HD", "_VGA") + "[STEREO]" + motion + angles.replace("_HD", "_VGA"))
    for wanted, size in (
        ((None, None), (1280, 720)),
        ((672, None), (672, 376)),
        ((None, 376), (672, 376)),
        ((320, 200), (1280, 720)),  # Its aspect ratio is nearer.
    ):
        rig = read_rig(str(path), *wanted)
        assert (rig.width, rig.height) == size
    assert read_rig(str(path), 672) == scene_rig(tmp_path, 'calibration = "zed.conf"\nwidth = 672\nheight = 376\n')


def test_width_decides_focal_length_and_rows_are_cropped_or_added(tmp_path: Path) -> None:
    rigs = {
        "ideal": RigSpec(),
        "named": STEREO_CAMERAS["Luxonis OAK-D"],
        "numbers": scene_rig(tmp_path, NUMBERS + "cy = 380\n"),
        "rectified": zed_rig(),
    }
    for name, rig in rigs.items():
        tolerance = 0.01 if name == "rectified" else 1e-9  # OpenCV rounds the limits of the images to pixels.
        K = cameras(rig)["left"].K
        for width, height in ((320, 200), (320, 120), (2560, 1440)):
            scaled, scale = cameras(sized_rig(rig, width, height))["left"].K, width / rig.width
            assert scaled[0, 0] == scaled[1, 1] == pytest.approx(K[0, 0] * scale, rel=tolerance)
            # The pixel at the middle of the image shows the same ray.
            assert (scaled[:2, 2] - [(width - 1) / 2, (height - 1) / 2]) / scale == pytest.approx(
                K[:2, 2] - [(rig.width - 1) / 2, (rig.height - 1) / 2], rel=tolerance, abs=10 * tolerance
            )
    sizes = [sized_rig(rigs["named"], *sides) for sides in ((None, None), (320, None), (None, 400), (320, 180))]
    assert [(rig.width, rig.height) for rig in sizes] == [(1280, 800), (320, 200), (640, 400), (320, 180)]
    assert cameras(sized_rig(RigSpec(), 320, 200))["left"].K.tolist() == [
        [175, 0, 159.5],
        [0, 175, 99.5],
        [0, 0, 1],
    ]


def test_rig_of_a_request_keeps_stations_and_names_the_configs(tmp_path: Path) -> None:
    request = BuildRequest(("lattice", "pier"), rig=read_rig("Intel RealSense D405"), rig_name="d405")
    lattice, pier = request.config_specs()
    plain = BuildRequest(("lattice", "pier")).config_specs()
    assert (lattice.name, pier.name) == ("lattice-d405", "pier-d405")
    assert [spec.protocol for spec in (lattice, pier)] == [spec.protocol for spec in plain]
    assert [spec.scene for spec in (lattice, pier)] == [spec.scene for spec in plain]
    assert (lattice.rig.baseline_m, lattice.rig.width, request.notes([lattice, pier])) == (0.018, 1280, [])
    smaller = BuildRequest(("pile", "cages"), width=320, height=200)
    (note,) = smaller.notes(smaller.config_specs())
    assert note.source == "pile"
    assert "20 rows are added" in note.text
    path = tmp_path / "rig.toml"
    path.write_text(NUMBERS.replace("75", "0.075"))
    assert read_rig(str(path)) == scene_rig(tmp_path, NUMBERS)
    (tmp_path / "own.toml").write_text(files.TOML)
    assert read_rig(str(tmp_path / "own.toml")).width == files.WIDTH


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "rig: found no keys, expected exactly one of camera; calibration"),
        (f'camera = "Luxonis OAK-D"\n{NUMBERS}', "rig: found baseline, camera, .*, expected exactly one of"),
        ('camera = "OAK-D"\n', 'rig.camera: got \'OAK-D\', expected "Stereolabs ZED", .*"Luxonis OAK-D Pro"'),
        (NUMBERS + "fx = 700\n", "rig: found .*fx.*, expected exactly one of"),
        (NUMBERS.replace("height = 800\n", ""), "rig: found .*, expected exactly one of"),
        (NUMBERS.replace("75", "75_000"), "rig.baseline: is 75 m, expected .* from 0.001 to 10 metres"),
        (NUMBERS + "cx = 5000\n", "rig: cx is 5000, expected a number from -0.5 to 1279.5 pixels"),
        (NUMBERS.replace("1280", "-5"), "rig.width: got -5, expected a whole number from 16 to 16384"),
        (NUMBERS.replace("75", "0.1") + 'unit = "mm"\n', "rig.baseline: is 0.0001 m"),
        ('calibration = "stereo.yml"\n', r"stereo.yml: image_width: .*missing, .* or width and height in \[rig\]"),
        ('calibration = "stereo.toml"\nunit = "mm"\n', "rig: unit is given with stereo.toml, expected no unit"),
        ('calibration = "my cal.toml"\n', "a file beside this one, or two, of letters"),
        ('calibration = "none.yml"\n', "none.yml"),
        ('calibration = "../stereo.yml"\n', "rig.calibration: .*expected the name of a file beside this one"),
        ('calibration = "stereo.yml"\nwidth = 640\n', "rig: found calibration, width, expected"),
        ('calibration = "stereo.toml"\nwidth = 640\nheight = 400\n', "fx is 1.2.* times fy"),
    ],
)
def test_invalid_rig_is_refused(table: str, words: str, tmp_path: Path) -> None:
    files.write_opencv(tmp_path, "yml")
    (tmp_path / "stereo.toml").write_text(files.TOML)
    with pytest.raises(InputError, match=words) as caught:
        scene_rig(tmp_path, table)
    assert len(caught.value.problems) <= 1


def test_rig_that_does_not_suit_a_request_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such camera, expected one of Stereolabs ZED, .*, or a calibration"):
        read_rig("OAK-D")
    assert main(["--out", str(tmp_path / "root"), "--config", "lattice", "--rig", "", "--dry-run"]) == 2
    rig = read_rig("Luxonis OAK-D")
    for config in ("lattice-zed", "cages"):
        with pytest.raises(InputError, match=f"--rig: is combined with --config {config}"):
            BuildRequest((config,), rig=rig, rig_name="oak").config_specs()
    for name in ("zed", "12", "wet"):
        with pytest.raises(InputError, match=f"'lattice-{name}', expected .*: rename the file"):
            BuildRequest(("lattice",), rig=rig, rig_name=name).config_specs()
    with pytest.raises(InputError, match=r"16 x 10 pixels, expected 16 to 8192 each"):
        BuildRequest(("lattice",), rig=rig, rig_name="oak", width=16).config_specs()
    (tmp_path / "lens.toml").write_text(files.TOML.replace("-0.2929, 0.1077", "-0.22, 0.0"))
    lens = read_rig(str(tmp_path / "lens.toml"))
    request = BuildRequest(("lattice",), rig=lens, rig_name="lens", width=640, height=960)
    assert len(request.config_specs()) == 1  # The rectified cameras have no distortion.
    with pytest.raises(InputError, match="the distortion cannot be inverted"):
        replace(request, rig=replace(lens, grid="raw")).config_specs()
    near = '[cameras]\nkind = "ring"\nradius = 70\nelevation_deg = 40\nazimuths = 2\n'
    path = write_scene(tmp_path, f"{MM}{BAR}[rig]\n{NUMBERS}{near}")
    with pytest.raises(InputError, match=r"my-beam.toml: my-beam: a camera is 0.07 m .*of the rig, 0.075 m"):
        scene_config(path)
