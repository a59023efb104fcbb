"""Tests of reading calibration files in both formats and of scaling them to other grids."""

from __future__ import annotations

import re
from dataclasses import replace
from math import pi
from pathlib import Path

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.captures.calibration import (
    Lens,
    StereoCalibration,
    scale_calibration,
)
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.geometry.cameras import project
from tests.bench.geometry.calibrations import CONF, SHIPPED_CALIBRATION, TOML, write_and_read

EXPECTED = StereoCalibration(
    1280,
    720,
    Lens(700.5, 701.5, 640.25, 350.75, (-0.17, 0.03, 0.001, -0.002, 0.0001)),
    Lens(702.5, 703.5, 633.25, 359.75, (-0.16, 0.02, 0.003, -0.004, 0.0002)),
    (-0.001, 0.006, 0.0007),
    (-0.1205, -0.00025, 0.00075),
)


def test_shipped_zed_calibration_values() -> None:
    calibration = read_calibration(SHIPPED_CALIBRATION, 1280, 720)
    assert calibration.left == Lens(
        701.88, 701.70, 641.285, 344.1835, (-0.175286, 0.0283094, 6.68e-5, -1.5e-4, 1e-10)
    )
    assert calibration.right == Lens(
        700.965, 701.11, 633.515, 359.3135, (-0.172795, 0.0265223, 1.64e-4, 1.02e-5, 0.0)
    )
    assert calibration.rotation_rad == (-9.17e-4, 6.24e-3, 7.70e-4)
    assert calibration.translation_m == (-0.119978, 0.0, 0.0)
    assert "-0.0" not in [str(length) for length in calibration.translation_m]


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda text: text, id="as the vendor writes it"),
        pytest.param(lambda text: re.sub("_HD=", "=", text), id="no suffix in STEREO"),
        pytest.param(
            lambda text: text.replace("TY=", "TY_HD=").replace("TZ=", "TZ_HD="), id="suffix on TY and TZ"
        ),
        pytest.param(lambda text: text.upper(), id="upper case"),
        pytest.param(lambda text: text.lower(), id="lower case"),
        pytest.param(lambda text: "\ufeff" + text, id="byte order mark"),
        pytest.param(lambda text: text.replace("\n", "\r\n"), id="Windows line ends"),
        pytest.param(
            lambda text: re.sub(r"=(\S+)", r" = \1   ; a word, # and another", text), id="comments after"
        ),
        pytest.param(lambda text: "; one\n# two\n" + text.replace("[", "# three\n;four\n["), id="comment lines"),
        pytest.param(lambda text: text.replace("=", ": "), id="colons"),
        pytest.param(
            lambda text: text + "[MISC]\nSensor_ID=1%\nfx\n".replace("fx\n", "fx=\n"), id="other sections"
        ),
        pytest.param(lambda text: text + "CV_FHD=0.4\nCV=0.3\nCV_2K=bad\n", id="other grids' keys"),
        pytest.param(
            lambda text: text + text.replace("_HD", "_VGA").split("[STEREO]")[0], id="other grids' sections"
        ),
    ],
)
def test_vendor_conf_variants_read_the_same(tmp_path: Path, change: object) -> None:
    assert write_and_read(tmp_path, change(CONF)) == EXPECTED  # type: ignore[operator]


def test_omitted_terms_are_zero(tmp_path: Path) -> None:
    old = re.sub(r"(p1|p2|k3|TY|TZ)=.*\n", "", CONF)
    read_back = write_and_read(tmp_path, old)
    assert read_back.left.distortion == (-0.17, 0.03, 0.0, 0.0, 0.0)
    assert read_back.translation_m == (-0.1205, 0.0, 0.0)


@pytest.mark.parametrize(
    ("grid", "suffix"),
    [
        ((2208, 1242), "2K"),
        ((1920, 1080), "FHD"),
        ((1280, 720), "HD"),
        ((672, 376), "VGA"),
        ((640, 360), "HD"),  # 16:9 like HD; VGA is nearer in width but has a slightly different aspect ratio
        ((320, 180), "HD"),
        ((1900, 1070), "FHD"),
    ],
)
def test_grid_selects_conf_section(tmp_path: Path, grid: tuple[int, int], suffix: str) -> None:
    grids = {"2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376)}
    text = ""
    for name, (width, height) in grids.items():
        for eye in ("LEFT", "RIGHT"):
            middle = f"cx={width / 2}\ncy={height / 2}"
            text += f"[{eye}_CAM_{name}]\nfx={width}\nfy={width + 1}\n{middle}\nk1=-0.{len(name)}\nk2=0\n"
    text += "[STEREO]\nBaseline=120\n"
    text += "".join(f"{key}_{name}=0.0{n}\n" for key in ("CV", "RX", "RZ") for n, name in enumerate(grids))
    calibration = write_and_read(tmp_path, text, grid=grid)
    grid_width = grids[suffix][0]
    assert (calibration.width, calibration.height) == grid
    assert calibration.left.fx == pytest.approx(grid_width * grid[0] / grid_width)
    assert calibration.left.fy == pytest.approx((grid_width + 1) * grid[1] / grids[suffix][1])
    assert calibration.rotation_rad == pytest.approx([list(grids).index(suffix) / 100] * 3)
    assert calibration.left.cx == pytest.approx((grid_width / 2 + 0.5) * grid[0] / grid_width - 0.5)


def test_toml_equals_conf(tmp_path: Path) -> None:
    assert write_and_read(tmp_path, TOML, "rig.toml") == EXPECTED


def test_toml_rotation_matrix_and_baseline_variants(tmp_path: Path) -> None:
    matrix = cv2.Rodrigues(np.array(EXPECTED.rotation_rad))[0].tolist()
    text = TOML.replace("[-0.001, 0.006, 0.0007]", repr(matrix)).replace(
        "translation_m = [-0.1205, -0.00025, 0.00075]", "baseline_m = 0.1205"
    )
    text = text.replace(", 0.0001]", "]").replace("width = 1280\nheight = 720\n", "")
    calibration = write_and_read(tmp_path, text, "rig.toml")
    assert calibration.rotation_rad == pytest.approx(EXPECTED.rotation_rad, abs=1e-15)
    assert calibration.translation_m == (-0.1205, 0.0, 0.0)
    assert calibration.left.distortion == (-0.17, 0.03, 0.001, -0.002, 0.0)
    assert (calibration.width, calibration.height) == (1280, 720)


def test_toml_is_scaled_to_another_grid(tmp_path: Path) -> None:
    assert write_and_read(tmp_path, TOML, "rig.toml", (640, 360)) == scale_calibration(EXPECTED, 640, 360)


def test_right_from_left_of_half_turn() -> None:
    turned = replace(EXPECTED, rotation_rad=(pi, 0.0, 0.0))
    assert turned.right_from_left[:3, :3] == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-15)


@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.just(1.0)).map(np.array),
    st.integers(16, 4000),
    st.integers(16, 4000),
)
def test_scaling_keeps_relative_image_position(ray: np.ndarray, width: int, height: int) -> None:
    """Check that a point's position in the image, as a fraction of the image size, is the same on any grid."""
    scaled = scale_calibration(EXPECTED, width, height)
    positions = []
    for calibration in (EXPECTED, scaled):
        pixel = project(calibration.left.K, ray, np.array(calibration.left.distortion))
        positions.append((pixel + 0.5) / [calibration.width, calibration.height])
    assert positions[1] == pytest.approx(positions[0], abs=1e-12)
    assert scaled.translation_m == EXPECTED.translation_m


def test_scaling_to_same_grid_returns_same_object() -> None:
    assert scale_calibration(EXPECTED, 1280, 720) is EXPECTED
    assert scale_calibration(scale_calibration(EXPECTED, 640, 360), 1280, 720).left == EXPECTED.left
