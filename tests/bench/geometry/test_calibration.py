"""Calibration files in both formats: read, scaled to other grids, and refused with every problem at once."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from math import pi
from pathlib import Path

import pytest

pytest.importorskip("cv2")

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import CalibrationError, InputError, Problem
from rebar_depth_bench.captures.calibration import Lens, StereoCalibration, scale_calibration
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


CONF_VARIANTS: dict[str, Callable[[str], str]] = {
    "as the vendor writes it": lambda text: text,
    "no suffix in STEREO": lambda text: text.replace("_HD=", "="),
    "suffix on TY and TZ": lambda text: text.replace("TY=", "TY_HD=").replace("TZ=", "TZ_HD="),
    "upper case": str.upper,
    "lower case": str.lower,
    "byte order mark": lambda text: "\ufeff" + text,
    "Windows line ends": lambda text: text.replace("\n", "\r\n"),
    "comments after": lambda text: re.sub(r"=(\S+)", r" = \1   ; a word, # and another", text),
    "comment lines": lambda text: "; one\n# two\n" + text.replace("[", "# three\n;four\n["),
    "colons": lambda text: text.replace("=", ": "),
    "other sections": lambda text: text + "[MISC]\nSensor_ID=1%\nfx=\n",
    "other grids' keys": lambda text: text + "CV_FHD=0.4\nCV=0.3\nCV_2K=bad\n",
    "other grids' sections": lambda text: text + text.replace("_HD", "_VGA").split("[STEREO]")[0],
}


@pytest.mark.parametrize("variant", CONF_VARIANTS)
def test_vendor_conf_variants_read_the_same(tmp_path: Path, variant: str) -> None:
    assert write_and_read(tmp_path, CONF_VARIANTS[variant](CONF)) == EXPECTED


def test_omitted_terms_are_zero(tmp_path: Path) -> None:
    old = re.sub(r"(p1|p2|k3|TY|TZ)=.*\n", "", CONF)
    read_back = write_and_read(tmp_path, old)
    assert read_back.left.distortion == (-0.17, 0.03, 0.0, 0.0, 0.0)
    assert read_back.translation_m == (-0.1205, 0.0, 0.0)


def test_toml_equals_conf_on_every_grid(tmp_path: Path) -> None:
    assert write_and_read(tmp_path, TOML, "rig.toml") == EXPECTED
    assert write_and_read(tmp_path, TOML, "rig.toml", (640, 360)) == scale_calibration(EXPECTED, 640, 360)
    negligible = write_and_read(tmp_path, TOML.replace("-0.002, 0.0001]", "-0.002, 1e-320]"), "rig.toml")
    assert negligible.left.distortion[4] == 1e-320


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


def reported_problems(folder: Path, text: str | bytes, name: str = "SN1.conf") -> tuple[Problem, ...]:
    with pytest.raises(CalibrationError) as caught:
        write_and_read(folder, text, name)
    assert isinstance(caught.value, InputError)
    assert str(folder / name) in str(caught.value)
    assert len(caught.value.problems) > 0
    return caught.value.problems


def locations(problems: tuple[Problem, ...]) -> list[tuple[str, str]]:
    return [(problem.code, problem.where) for problem in problems]


FOLDS_BACK = "folds back at the radius"
INVALID_CONF = [
    ("fx=700.5", "fx=0", "invalid LEFT_CAM_HD.fx", "got '0', expected a number from 1 to 100000 pixels"),
    ("fx=700.5", "fx=nan", "invalid LEFT_CAM_HD.fx", "got 'nan'"),
    ("fx=700.5", "fx=700,5", "invalid LEFT_CAM_HD.fx", "got '700,5'"),
    ("fx=700.5", "fx=", "invalid LEFT_CAM_HD.fx", "got ''"),
    ("fx=700.5", "fx=1e999", "invalid LEFT_CAM_HD.fx", "got '1e999'"),
    ("fx=700.5\n", "", "missing LEFT_CAM_HD.fx", "expected a number from 1 to 100000 pixels"),
    ("fx=700.5", "fx=700.5\nFX=700", "duplicate LEFT_CAM_HD.FX", "line 3: the key occurs twice"),
    ("fx=700.5", "fx=7_00.5", "invalid LEFT_CAM_HD.fx", "got '7_00.5'"),
    ("fx=700.5", "fx=٧٠٠", "invalid LEFT_CAM_HD.fx", ""),
    ("fx=700.5", "fx=700.5\n\x1b[2J=1\n\x1b[2J=1", r"duplicate LEFT_CAM_HD.'\x1b[2J'", "line 4"),
    ("k1=-0.16", "k1=%(k2)s", "invalid RIGHT_CAM_HD.k1", "got '%(k2)s', expected a number from -1000"),
    ("k1=-0.17\n", "", "missing LEFT_CAM_HD.k1", ""),
    ("cx=640.25", "cx=1290", "invalid LEFT_CAM_HD.cx", "expected a number from -0.5 to 1279.5 pixels"),
    ("cy=359.75", "cy=-1", "invalid RIGHT_CAM_HD.cy", "expected a number from -0.5 to 719.5 pixels"),
    ("[RIGHT_CAM_HD]", "[RIGHT_CAM_VGA]", "missing RIGHT_CAM_HD", ""),
    ("[STEREO]", "[MONO]", "missing STEREO", ""),
    ("[STEREO]", "[LEFT_CAM_HD]", "duplicate LEFT_CAM_HD", "line 23: the section occurs twice"),
    ("[STEREO]", "[left_cam_hd]", "duplicate LEFT_CAM_HD", ""),
    ("Baseline=120.5", "Baseline=0.1205", "invalid STEREO.Baseline", "from 1 to 10000 millimetres"),
    ("Baseline=120.5\n", "", "missing STEREO.Baseline", ""),
    ("CV_HD=0.006", "CV_VGA=0.006", "missing STEREO.CV", "expected a number from -0.5 to 0.5 radians"),
    ("RX_HD=-0.001", "RX_HD=-5", "invalid STEREO.RX_HD", ""),
    ("TY=0.25", "TY=1e6", "invalid STEREO.TY", "millimetres"),
    ("[LEFT_CAM_HD]\n", "", "syntax ", "line 1 is 'fx=700.5', expected [SECTION], or key = value"),
    ("fx=700.5", "fx 700.5 ", "syntax ", "line 2 is 'fx 700.5', expected [SECTION], or key = value"),
    ("TY=0.25", "TY=-100", "conflict stereo", "at (0.1205, -0.1, -0.00075) m from the left one"),
    ("k1=-0.17", "k1=-0.9", "conflict left", FOLDS_BACK),
    ("k2=0.02", "k2=-30", "conflict right", FOLDS_BACK),
]


@pytest.mark.parametrize(
    ("content", "code", "words"),
    [
        (b"", "missing", "the file has no section, expected one of"),
        (b"\x00" * 100, "syntax", "line 1 is '\\x00"),
        (b"\xff\xfe[\x00L\x00", "syntax", "the text is UTF-16, expected UTF-8 text"),
        (b"[\xe9]", "syntax", "byte 1 is not UTF-8"),
        (b"[STEREO]\nBaseline=120\n", "missing", "the file has [STEREO], expected one of [LEFT_CAM_2K]"),
        (b"[DEFAULT]\nfx=1\n", "missing", "the file has [DEFAULT], expected"),
        (b"; " + b"x" * (1 << 20), "size", "at most 1048576 bytes"),
    ],
)
def test_file_that_is_no_calibration_is_rejected(tmp_path: Path, content: bytes, code: str, words: str) -> None:
    [problem] = reported_problems(tmp_path, content)
    assert (problem.code, problem.where) == (code, "")
    assert words in str(problem)


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "9" * 1_000_000 + "x",
        " " * 1_000_000 + "x",
        "[" + " " * 1_000_000 + "x",
        "a " * 500_000,
        "[a]\n" * 200_000,
        "[a]\n" + "b=1\n" * 200_000,
        CONF.replace("700.5", "9" * 1_000_000 + "x"),
        CONF.replace("700.5", "1e" + "9" * 1_000_000),
    ],
)
def test_large_files_are_rejected_quickly(tmp_path: Path, text: str) -> None:
    start = time.process_time()
    problems = reported_problems(tmp_path, text)
    assert time.process_time() - start < 2
    assert all(len(str(problem)) < 300 for problem in problems)


@pytest.mark.parametrize("size", [(0, 0), (1280, 0), (-1, 720), (15, 15), (1280, 16385)])
@pytest.mark.parametrize(("name", "text"), [("SN1.conf", CONF), ("rig.toml", TOML)])
def test_impossible_image_size_is_rejected(tmp_path: Path, name: str, text: str, size: tuple[int, int]) -> None:
    with pytest.raises(CalibrationError, match="expected 16 to 16384 pixels each") as caught:
        write_and_read(tmp_path, text, name, size)
    assert locations(caught.value.problems) == [("invalid", "")]


def test_all_problems_of_a_table_are_reported_at_once(tmp_path: Path) -> None:
    text = TOML.replace("height = 720", "height = 7").replace("fx = 700.5", "fx = 0").replace("[0, 0, 1]", "[0]")
    assert locations(reported_problems(tmp_path, text.replace("rotation", "rot"), "rig.toml")) == [
        ("invalid", "height"),
        ("invalid", "left.fx"),
        ("invalid", "right"),
        ("missing", "stereo.rotation"),
        ("unknown", "stereo.rot"),
    ]


ROTATION = "[-0.001, 0.006, 0.0007]"
INVALID_TOML = [
    ("width = 1280", "width = 1280.5", "invalid width", "got 1280.5, expected a whole number"),
    ("width = 1280", f"width = {'9' * 400}", "invalid width", ""),
    ("width = 1280", "widht = 1280", "unknown widht", "expected width"),
    ("[left]", "left = 3\n[lleft]", "invalid left", "expected a table"),
    ("[stereo]", "[stero]", "missing stereo", "expected a table"),
    ("fx = 700.5", "fx = '700.5'", "invalid left.fx", "got '700.5'"),
    ("fx = 700.5", "fx = true", "invalid left.fx", "got True"),
    ("fx = 700.5", "fx = nan", "invalid left.fx", "got nan"),
    ("fx = 700.5", f"fx = 1{'0' * 400}", "invalid left.fx", "expected a number from 1 to 100000 pixels"),
    ("0, 633.25]", "0, -1]", "invalid right.cx", "got -1.0"),
    ("fx = 700.5\n", "", "missing left.fx", "expected a number from 1 to 100000 pixels"),
    ("fx = 700.5", "fx = 700.5\nfz = 700.5", "unknown left.fz", ""),
    ("distortion = [-0.17, 0.03, 0.001, -0.002, 0.0001]\n", "", "missing left.distortion", "[k1, k2, p1, p2]"),
    ("0.001, -0.002, 0.0001]", "0.001]", "invalid left.distortion", "[k1, k2, p1, p2]"),
    ("0.001, -0.002, 0.0001]", "'a', -0.002]", "invalid left.distortion 3", "got 'a'"),
    ("K = [[702.5, 0,", "K = [[702.5, 3,", "invalid right", "expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
    ("K = [[702.5, 0, 633.25],", "K = [[702.5, 633.25],", "invalid right", "K is"),
    ("K = [[702.5,", "fx = 7\nK = [[702.5,", "conflict right", "has K beside fx, fy, cx or cy"),
    ("K = [[702.5,", "K = [[0.5,", "invalid right.fx", "got 0.5"),
    ("rotation = [-0.001,", "rotation = [-3.1,", "invalid stereo.rotation", "radians"),
    ("rotation = [-0.001,", "rotation = [1, -0.001,", "invalid stereo.rotation", ""),
    (ROTATION, "[[1, 0, 0], [0, 1, 0], [0, 0, -1]]", "invalid stereo.rotation", "a 3 x 3 rotation matrix"),
    (ROTATION, "[[1, 0, 0], [0, 1, 0], [0.1, 0, 1]]", "invalid stereo.rotation", ""),
    (ROTATION, "[[1, 0, 0], [0, -1, 0], [0, 0, -1]]", "invalid stereo.rotation", "from -0.5 to 0.5 radians"),
    (ROTATION, "[[1, 0, 0], [0, nan, 0], [0, 0, 1]]", "invalid stereo.rotation", ""),
    (ROTATION, "[[1, 0, 0], [0, 1e300, 0], [0, 0, 1]]", "invalid stereo.rotation", ""),
    ("rotation = ", "roration = ", "missing stereo.rotation", ""),
    (
        "translation_m = ",
        "baseline_m = 0.12\ntranslation_m = ",
        "conflict stereo",
        "has translation_m beside baseline_m",
    ),
    ("translation_m = ", "translation = ", "missing stereo.translation_m", "three numbers, metres, or baseline_m"),
    ("translation_m = [-0.1205, -0.00025, 0.00075]", "baseline_m = 0", "invalid stereo", "baseline_m is 0"),
    ("[-0.1205, -0.00025", "[0.1205, -0.00025", "invalid stereo.translation_m", "expected [-baseline, y, z]"),
    ("[-0.1205, -0.00025", "[-120.5, -0.00025", "invalid stereo.translation_m 1", "metres"),
    ("fx = 700.5", "fx = = 700.5", "syntax ", "line 4"),
    ("fx = 700.5", f"fx = {'9' * 5000}", "syntax ", "not a valid TOML file"),
]


INVALID = [("SN1.conf", CONF, *case) for case in INVALID_CONF] + [
    ("rig.toml", TOML, *case) for case in INVALID_TOML
]


@pytest.mark.parametrize(("name", "text", "old", "new", "location", "words"), INVALID)
def test_invalid_values_are_refused(
    tmp_path: Path, name: str, text: str, old: str, new: str, location: str, words: str
) -> None:
    assert old in text
    first, *_ = reported_problems(tmp_path, text.replace(old, new, 1), name)
    assert f"{first.code} {first.where}" == location
    assert words in str(first)
