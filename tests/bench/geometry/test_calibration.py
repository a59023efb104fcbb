"""Calibration files: what the vendor writes is read, and other grids scale."""

from __future__ import annotations

import re
from dataclasses import replace
from math import pi
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.geometry.calibration import read_calibration
from rebar_depth_bench.geometry.cameras import project
from rebar_depth_bench.geometry.stereo_calibration import (
    Lens,
    StereoCalibration,
    lens_distortion,
    lens_K,
    right_from_left,
    scaled,
)

SHIPPED = Path(__file__).parents[1] / "dataset_builder" / "calibrations" / "zed-hd720.conf"

CONF = """\
[LEFT_CAM_HD]
fx=700.5
fy=701.5
cx=640.25
cy=350.75
k1=-0.17
k2=0.03
p1=0.001
p2=-0.002
k3=0.0001

[RIGHT_CAM_HD]
fx=702.5
fy=703.5
cx=633.25
cy=359.75
k1=-0.16
k2=0.02
p1=0.003
p2=-0.004
k3=0.0002

[STEREO]
Baseline=120.5
TY=0.25
TZ=-0.75
CV_HD=0.006
RX_HD=-0.001
RZ_HD=0.0007
"""
EXPECTED = StereoCalibration(
    1280,
    720,
    Lens(700.5, 701.5, 640.25, 350.75, (-0.17, 0.03, 0.001, -0.002, 0.0001)),
    Lens(702.5, 703.5, 633.25, 359.75, (-0.16, 0.02, 0.003, -0.004, 0.0002)),
    (-0.001, 0.006, 0.0007),
    (-0.1205, -0.00025, 0.00075),
)

TOML = """\
width = 1280
height = 720
[left]
fx = 700.5
fy = 701.5
cx = 640.25
cy = 350.75
distortion = [-0.17, 0.03, 0.001, -0.002, 0.0001]
[right]
K = [[702.5, 0, 633.25], [0, 703.5, 359.75], [0, 0, 1]]
distortion = [-0.16, 0.02, 0.003, -0.004, 0.0002]
[stereo]
rotation = [-0.001, 0.006, 0.0007]
translation_m = [-0.1205, -0.00025, 0.00075]
"""


def read(
    folder: Path, text: str | bytes, name: str = "SN1.conf", grid: tuple[int, int] = (1280, 720)
) -> StereoCalibration:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_calibration(path, *grid)


def test_the_shipped_unit() -> None:
    calibration = read_calibration(SHIPPED, 1280, 720)
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
def test_what_vendors_files_differ_in_makes_no_difference(tmp_path: Path, change: object) -> None:
    assert read(tmp_path, change(CONF)) == EXPECTED  # type: ignore[operator]


def test_terms_that_old_files_leave_out_are_zero(tmp_path: Path) -> None:
    old = re.sub(r"(p1|p2|k3|TY|TZ)=.*\n", "", CONF)
    read_back = read(tmp_path, old)
    assert read_back.left.distortion == (-0.17, 0.03, 0.0, 0.0, 0.0)
    assert read_back.translation_m == (-0.1205, 0.0, 0.0)


@pytest.mark.parametrize(
    ("grid", "suffix"),
    [
        ((2208, 1242), "2K"),
        ((1920, 1080), "FHD"),
        ((1280, 720), "HD"),
        ((672, 376), "VGA"),
        ((640, 360), "HD"),  # 16:9 as HD is; VGA is nearer in width but not quite of this shape
        ((320, 180), "HD"),
        ((1900, 1070), "FHD"),
    ],
)
def test_the_grid_chooses_the_section(tmp_path: Path, grid: tuple[int, int], suffix: str) -> None:
    grids = {"2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376)}
    text = ""
    for name, (width, height) in grids.items():
        for eye in ("LEFT", "RIGHT"):
            middle = f"cx={width / 2}\ncy={height / 2}"
            text += f"[{eye}_CAM_{name}]\nfx={width}\nfy={width + 1}\n{middle}\nk1=-0.{len(name)}\nk2=0\n"
    text += "[STEREO]\nBaseline=120\n"
    text += "".join(f"{key}_{name}=0.0{n}\n" for key in ("CV", "RX", "RZ") for n, name in enumerate(grids))
    found = read(tmp_path, text, grid=grid)
    wide = grids[suffix][0]
    assert (found.width, found.height) == grid
    assert found.left.fx == pytest.approx(wide * grid[0] / wide)
    assert found.left.fy == pytest.approx((wide + 1) * grid[1] / grids[suffix][1])
    assert found.rotation_rad == pytest.approx([list(grids).index(suffix) / 100] * 3)
    assert found.left.cx == pytest.approx((wide / 2 + 0.5) * grid[0] / wide - 0.5)


def test_toml_says_the_same(tmp_path: Path) -> None:
    assert read(tmp_path, TOML, "rig.toml") == EXPECTED


def test_toml_in_its_other_spellings(tmp_path: Path) -> None:
    matrix = cv2.Rodrigues(np.array(EXPECTED.rotation_rad))[0].tolist()
    text = TOML.replace("[-0.001, 0.006, 0.0007]", repr(matrix)).replace(
        "translation_m = [-0.1205, -0.00025, 0.00075]", "baseline_m = 0.1205"
    )
    text = text.replace(", 0.0001]", "]").replace("width = 1280\nheight = 720\n", "")
    found = read(tmp_path, text, "rig.toml")
    assert found.rotation_rad == pytest.approx(EXPECTED.rotation_rad, abs=1e-15)
    assert found.translation_m == (-0.1205, 0.0, 0.0)
    assert found.left.distortion == (-0.17, 0.03, 0.001, -0.002, 0.0)
    assert (found.width, found.height) == (1280, 720)


def test_toml_of_another_grid_is_scaled(tmp_path: Path) -> None:
    assert read(tmp_path, TOML, "rig.toml", (640, 360)) == scaled(EXPECTED, 640, 360)


def test_half_a_turn_is_no_stereo_rig() -> None:
    turned = replace(EXPECTED, rotation_rad=(pi, 0.0, 0.0))
    assert right_from_left(turned)[:3, :3] == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-15)


@given(
    st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.just(1.0)).map(np.array),
    st.integers(16, 4000),
    st.integers(16, 4000),
)
def test_a_scaled_grid_sees_the_same_share_of_the_picture(ray: np.ndarray, width: int, height: int) -> None:
    """A point's place, measured from the picture's edge in shares of its sides, does not depend on the grid."""
    other = scaled(EXPECTED, width, height)
    shares = []
    for calibration in (EXPECTED, other):
        place = project(lens_K(calibration.left), ray, lens_distortion(calibration.left))
        shares.append((place + 0.5) / [calibration.width, calibration.height])
    assert shares[1] == pytest.approx(shares[0], abs=1e-12)
    assert other.translation_m == EXPECTED.translation_m


def test_the_same_grid_is_the_same_value() -> None:
    assert scaled(EXPECTED, 1280, 720) is EXPECTED
    assert scaled(scaled(EXPECTED, 640, 360), 1280, 720).left == EXPECTED.left
