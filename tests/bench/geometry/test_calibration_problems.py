"""Tests of invalid calibration files: every problem is reported, all of them at once."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rebar_depth_bench.errors import CalibrationError, InputError
from rebar_depth_bench.geometry.calibration import read_calibration
from tests.bench.geometry.calibrations import CONF, TOML, write_and_read


def reported_problems(folder: Path, text: str | bytes, name: str = "SN1.conf") -> str:
    with pytest.raises(CalibrationError) as caught:
        write_and_read(folder, text, name)
    assert isinstance(caught.value, InputError)
    assert str(folder / name) in str(caught.value)
    assert len(caught.value.problems) > 0
    return "\n".join(caught.value.problems)


INVALID_CONF = [
    ("fx=700.5", "fx=0", r"section \[LEFT_CAM_HD\] fx is '0', expected a number from 1 to 100000 pixels"),
    ("fx=700.5", "fx=nan", r"\[LEFT_CAM_HD\] fx is 'nan', expected"),
    ("fx=700.5", "fx=inf", r"\[LEFT_CAM_HD\] fx is 'inf', expected"),
    ("fx=700.5", "fx=700,5", r"\[LEFT_CAM_HD\] fx is '700,5', expected"),
    ("fx=700.5", "fx=", r"\[LEFT_CAM_HD\] fx is '', expected"),
    ("fx=700.5", "fx=1e999", r"\[LEFT_CAM_HD\] fx is '1e999', expected"),
    ("fx=700.5", "fx=-700.5", r"\[LEFT_CAM_HD\] fx is '-700.5', expected"),
    ("fx=700.5\n", "", r"section \[LEFT_CAM_HD\] has no fx, expected a number"),
    ("fx=700.5", "fx=700.5\nFX=700", r"not an INI file: .*FX.* already exists"),
    ("k1=-0.16", "k1=%(k2)s", r"\[RIGHT_CAM_HD\] k1 is '%\(k2\)s', expected a number from -1000"),
    ("k1=-0.17\n", "", r"\[LEFT_CAM_HD\] has no k1"),
    ("cx=640.25", "cx=1290", r"\[LEFT_CAM_HD\] cx is '1290', expected a number from -0.5 to 1279.5 pixels"),
    ("cy=359.75", "cy=-1", r"\[RIGHT_CAM_HD\] cy is '-1', expected a number from -0.5 to 719.5"),
    ("[RIGHT_CAM_HD]", "[RIGHT_CAM_VGA]", r"section \[RIGHT_CAM_HD\] is missing"),
    ("[STEREO]", "[MONO]", r"section \[STEREO\] is missing"),
    ("[STEREO]", "[LEFT_CAM_HD]", r"not an INI file: .*section 'LEFT_CAM_HD' already exists"),
    ("[STEREO]", "[left_cam_hd]", r"section \[left_cam_hd\] occurs twice"),
    ("Baseline=120.5", "Baseline=0.1205", r"\[STEREO\] BASELINE is '0.1205', expected .* 1 to 10000 millimetres"),
    ("Baseline=120.5", "Baseline=-120.5", r"\[STEREO\] BASELINE is '-120.5', expected"),
    ("Baseline=120.5\n", "", r"\[STEREO\] has no BASELINE_HD and no BASELINE, expected"),
    ("CV_HD=0.006", "CV_VGA=0.006", r"\[STEREO\] has no CV_HD and no CV, expected .* -0.5 to 0.5 radians"),
    ("RX_HD=-0.001", "RX_HD=-5", r"\[STEREO\] RX_HD is '-5', expected"),
    ("TY=0.25", "TY=1e6", r"\[STEREO\] TY is '1e6', expected .* millimetres"),
    ("[LEFT_CAM_HD]\n", "", r"not an INI file: File contains no section headers"),
    ("fx=700.5", "fx 700.5 ", r"not an INI file: .*parsing errors"),
    (
        "TY=0.25",
        "TY=-100",
        r"right camera is at \(0.1205, -0.1, -0.00075\) m from the left one, expected an offset mostly along x",
    ),
    (
        "k1=-0.17",
        "k1=-0.9",
        r"the left distortion cannot be inverted .*cannot be inverted at \d+ of \d+ points.*folds back",
    ),
    ("k2=0.02", "k2=-30", r"the right distortion cannot be inverted"),
]


@pytest.mark.parametrize(("old", "new", "words"), INVALID_CONF)
def test_invalid_conf_is_rejected(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in CONF
    assert re.search(words, reported_problems(tmp_path, CONF.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "the file has no section, expected one of"),
        (b"\x00" * 100, "not an INI file"),
        (b"\xff\xfe[\x00L\x00", "not UTF-8"),
        (b"[STEREO]\nBaseline=120\n", r"the file has \[STEREO\], expected one of \[LEFT_CAM_2K\]"),
        (b"[DEFAULT]\nfx=1\n", r"the file has \[DEFAULT\], expected"),
        (b"; " + b"x" * 1_000_001, "larger than 1000000 bytes"),
    ],
)
def test_file_that_is_no_calibration_is_rejected(tmp_path: Path, content: bytes, words: str) -> None:
    assert re.search(words, reported_problems(tmp_path, content))


def test_unreadable_path_raises_calibration_error(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read: No such file"):
        read_calibration(tmp_path / "none.conf", 1280, 720)
    (tmp_path / "folder.conf").mkdir()
    with pytest.raises(CalibrationError, match="cannot be read: Is a directory"):
        read_calibration(tmp_path / "folder.conf", 1280, 720)
    with pytest.raises(CalibrationError, match=r"the file suffix is '.yaml', expected .conf or .toml"):
        read_calibration(tmp_path / "a.yaml", 1280, 720)


def test_all_problems_are_reported_at_once(tmp_path: Path) -> None:
    text = CONF.replace("fx=700.5", "fx=x").replace("fy=703.5\n", "").replace("Baseline=120.5", "Baseline=0")
    lines = reported_problems(tmp_path, text).splitlines()
    assert len(lines) == 3
    assert "[LEFT_CAM_HD] fx" in lines[0]
    assert "[RIGHT_CAM_HD] has no fy" in lines[1]
    assert "[STEREO] BASELINE" in lines[2]


INVALID_TOML = [
    ("width = 1280", "width = 1280.5", r"width is 1280.5, expected a whole number"),
    ("width = 1280", "width = true", r"width is True, expected a whole number"),
    ("width = 1280", "widht = 1280", r"the file has 'widht', expected only width, height"),
    ("[left]", "left = 3\n[lleft]", r"table \[left\] is missing"),
    ("[stereo]", "[stero]", r"table \[stereo\] is missing"),
    ("fx = 700.5", "fx = '700.5x'", r"\[left\] fx is '700.5x', expected"),
    ("fx = 700.5", "fx = true", r"\[left\] fx is True, expected"),
    ("fx = 700.5", "fx = nan", r"\[left\] fx is nan, expected"),
    ("fx = 700.5", "fx = []", r"\[left\] fx is \[\], expected"),
    ("fx = 700.5\n", "", r"\[left\] has no fx and no K"),
    ("fx = 700.5", "fz = 700.5", r"\[left\] has 'fz', expected only K, fx"),
    ("distortion = [-0.17, 0.03, 0.001, -0.002, 0.0001]\n", "", r"\[left\] has no distortion"),
    ("0.001, -0.002, 0.0001]", "0.001]", r"\[left\] distortion is .*, expected 4 or 5 numbers"),
    ("0.001, -0.002, 0.0001]", "'a', -0.002]", r"\[left\] distortion\[2\] is 'a', expected"),
    ("K = [[702.5, 0,", "K = [[702.5, 3,", r"\[right\] K is .*, expected \[\[fx, 0, cx\], \[0, fy, cy\]"),
    ("K = [[702.5, 0, 633.25],", "K = [[702.5, 633.25],", r"\[right\] K is .*, expected three rows"),
    ("K = [[702.5,", "fx = 7\nK = [[702.5,", r"\[right\] has K and also fx"),
    ("rotation = [-0.001,", "rotation = [-3.1,", r"\[stereo\] rotation\[0\] is -3.1, expected .*radians"),
    ("rotation = [-0.001,", "rotation = [1, -0.001,", r"\[stereo\] rotation is .*, expected 3 numbers"),
    (
        "[-0.001, 0.006, 0.0007]",
        "[[1, 0, 0], [0, 1, 0], [0, 0, -1]]",
        r"expected a rotation matrix .*determinant 1",
    ),
    ("[-0.001, 0.006, 0.0007]", "[[1, 0, 0], [0, 1, 0], [0.1, 0, 1]]", r"expected a rotation"),
    (
        "[-0.001, 0.006, 0.0007]",
        "[[1, 0, 0], [0, -1, 0], [0, 0, -1]]",
        r"rotation's angle is 3\.14.*, expected .*radians",
    ),
    ("rotation = ", "roration = ", r"\[stereo\] rotation is missing"),
    (
        "translation_m = ",
        "baseline_m = 0.12\ntranslation_m = ",
        r"both or neither of translation_m and baseline_m",
    ),
    ("[-0.1205, -0.00025", "[0.1205, -0.00025", r"translation_m\[0\], with its sign changed, is -0.1205"),
    ("[-0.1205, -0.00025", "[-120.5, -0.00025", r"translation_m\[0\] is -120.5, expected .* metres"),
    ("fx = 700.5", "fx = = 700.5", r"not a TOML file: .*line 4"),
]


@pytest.mark.parametrize(("old", "new", "words"), INVALID_TOML)
def test_invalid_toml_is_rejected(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in TOML
    assert re.search(words, reported_problems(tmp_path, TOML.replace(old, new, 1), "rig.toml"))
