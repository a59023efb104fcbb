"""Stereolabs' calibration files: sections of every image size, lens models, scaling, and notes of unlisted keys.

The files are those of stereolabs/zed-opencv-calibration (StereoCalib::saveCalibZED) for the sensors AR0234 (ZED X)
and IMX678 (4K), whose sizes are crops of one another, and that of a ZED as Stereolabs delivers it.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rebar_depth_bench.base.errors import CalibrationError, Problem
from rebar_depth_bench.captures.calibration import StereoCalibration
from rebar_depth_bench.captures.calibration_files import read_calibration

FX, CX, CY = 1500.0, 1920.3, 1080.2
"""Camera of the IMX678 at its full size, 3840 x 2160."""
BROWN = {
    "k1": "-0.05",
    "k2": "0.01",
    "p1": "0.0001",
    "p2": "-0.0002",
    "k3": "1e-3",
    "k4": "0",
    "k5": "0",
    "k6": "0",
}
FACTORY = {"2K": (1403.76, 1109.57, 592.367), "FHD": (1403.76, 965.57, 511.367), "HD": (701.88, 641.285, 344.1835)}
"""fx, cx, cy of a delivered ZED: its sizes of 16:9 show 2208, 1920 and 2560 columns of the sensor."""


def section(name: str, keys: dict[str, object]) -> str:
    return f"[{name}]\n" + "".join(f"{key} = {value}\n" for key, value in keys.items()) + "\n"


def conf(sizes: dict[str, tuple[float, float, float]], terms: dict[str, str], own: dict[str, str]) -> str:
    """Return a file of sizes with fx, cx, cy; ``terms`` are those of [LEFT_DISTO], ``own`` of [LEFT_CAM_X]."""
    text = ""
    for name, (fx, cx, cy) in sizes.items():
        for eye in ("LEFT", "RIGHT"):
            text += section(f"{eye}_CAM_{name}", {"fx": fx, "fy": fx, "cx": cx, "cy": cy, **own})
    for eye in ("LEFT", "RIGHT") if terms else ():
        text += section(f"{eye}_DISTO", dict(terms))
    text += section("MISC", {"Sensor_ID": 1})
    stereo: dict[str, object] = {"Baseline": 119.82, "TY": 0.06, "TZ": -0.11}
    for key, angle_rad in (("CV", 0.0031), ("RX", 0.0012), ("RZ", -0.0008)):
        stereo |= {f"{key}_{name}": angle_rad for name in sizes}
    return text + section("STEREO", stereo)


def imx678(terms: dict[str, str]) -> str:
    return conf(
        {
            "4k": (FX, CX, CY),
            "QHDPLUS": (FX, CX - 320, CY - 180),
            "FHD": (FX / 2, CX / 2, CY / 2),
            "FHD1200": (FX, CX - 960, CY - 480),
        },
        terms,
        {},
    )


def ar0234(terms: dict[str, str]) -> str:
    return conf(
        {"FHD1200": (742.1, 961.3, 603.2), "FHD": (742.1, 961.3, 543.2), "SVGA": (371.05, 480.65, 301.6)},
        terms,
        {},
    )


def read(folder: Path, text: str, size: tuple[int, int]) -> StereoCalibration:
    (folder / "SN1.conf").write_text(text)
    return read_calibration(folder / "SN1.conf", *size)


def refusal(folder: Path, text: str, size: tuple[int, int]) -> tuple[Problem, ...]:
    with pytest.raises(CalibrationError) as caught:
        read(folder, text, size)
    return caught.value.problems


@pytest.mark.parametrize(
    ("text", "size", "camera"),
    [
        (imx678(BROWN), (3840, 2160), (1500, 1920.3, 1080.2)),
        (imx678(BROWN), (3200, 1800), (1500, 1600.3, 900.2)),
        (imx678(BROWN), (1920, 1080), (750, 960.15, 540.1)),
        (imx678(BROWN), (1920, 1200), (1500, 960.3, 600.2)),
        (imx678(BROWN).upper(), (3200, 1800), (1500, 1600.3, 900.2)),
        (imx678(BROWN).lower(), (3840, 2160), (1500, 1920.3, 1080.2)),
        (ar0234(BROWN), (1920, 1200), (742.1, 961.3, 603.2)),
        (ar0234(BROWN), (1920, 1080), (742.1, 961.3, 543.2)),
        (ar0234(BROWN), (960, 600), (371.05, 480.65, 301.6)),
        (conf({"HD": FACTORY["HD"]}, BROWN, {}), (1280, 720), FACTORY["HD"]),
        (ar0234({**BROWN, "s1": "0", "s2": "0.0", "s3": "0e0", "s4": "-0"}), (960, 600), (371.05, 480.65, 301.6)),
        (
            conf(FACTORY, {}, {key: BROWN[key] for key in ("k1", "k2", "p1", "p2", "k3")}),
            (2208, 1242),
            FACTORY["2K"],
        ),
        (conf({**FACTORY, "WVGA": (1.0, 1.0, 1.0)}, BROWN, BROWN), (1920, 1080), FACTORY["FHD"]),
    ],
)
def test_section_of_the_exact_size_is_read(
    tmp_path: Path, text: str, size: tuple[int, int], camera: tuple[float, float, float]
) -> None:
    calibration = read(tmp_path, text, size)
    assert (calibration.width, calibration.height) == size
    for lens in (calibration.left, calibration.right):
        assert (lens.fx, lens.fy, lens.cx, lens.cy) == pytest.approx((camera[0], *camera), abs=1e-9)
        assert lens.distortion == (-0.05, 0.01, 0.0001, -0.0002, 0.001)
    assert calibration.rotation_rad == (0.0012, 0.0031, -0.0008)
    assert not [note for note in calibration.notes if "scaled" in note]


RATIONAL = {"k1": "4.9342", "k2": "1.8712", "p1": "0.00012", "p2": "-7e-05", "k3": "0.06134"}
RATIONAL |= {"k4": "5.0742", "k5": "2.0070", "k6": "0.2"}
FISHEYE = {"k1": "-0.0386674", "k2": "0.0304795", "k3": "-0.0237575", "k4": "0.0167972"}
PADDING = {"k5": "0", "k6": "0", "p1": "0", "p2": "0"}


@pytest.mark.parametrize(
    ("text", "size", "where", "words"),
    [
        (ar0234(RATIONAL), (960, 600), "LEFT_DISTO", "8 terms: fisheye or rational distortion"),
        (ar0234(RATIONAL), (640, 400), "LEFT_DISTO", "rational"),
        (ar0234(RATIONAL).lower(), (1920, 1080), "LEFT_DISTO", "rational"),
        (imx678({**BROWN, "k6": "1e-9"}), (3840, 2160), "LEFT_DISTO", "8 terms: fisheye or rational distortion"),
        (re.sub(r"(RIGHT_DISTO[^[]*k4 = )0", r"\g<1>0.1", ar0234(BROWN)), (960, 600), "RIGHT_DISTO", "rational"),
        # The factory's files have the rational terms beside five of an older model.
        (conf(FACTORY, RATIONAL, BROWN), (1280, 720), "LEFT_DISTO", "rational"),
        # printDisto writes four terms of a fisheye lens; normalizedStereoDisto adds zeros.
        (ar0234(FISHEYE), (960, 600), "LEFT_DISTO", "'fisheye, k1 k2 k3 k4'"),
        (ar0234({**FISHEYE, "k4": "0"}), (960, 600), "LEFT_DISTO", "'fisheye, k1 k2 k3 k4'"),
        (ar0234(FISHEYE | PADDING), (960, 600), "LEFT_DISTO", "6 terms: fisheye"),
        # stereolabs/zed-opencv-native/issues/16: a ZED Mini with four terms in the sections of sizes.
        (conf({"HD": FACTORY["HD"]}, {}, FISHEYE), (1280, 720), "LEFT_CAM_HD", "fisheye"),
        (conf({"HD": FACTORY["HD"]}, {}, RATIONAL), (1280, 720), "LEFT_CAM_HD", "rational"),
        # stereolabs/zed-ros2-wrapper/issues/128: thin prism terms.
        (ar0234({**BROWN, "s2": "0.002"}), (960, 600), "LEFT_DISTO", "10 terms: thin prism distortion"),
        (ar0234({**BROWN, "p1": "0", "p2": "0", "tauX": "0.002"}), (960, 600), "LEFT_DISTO", "tilted distortion"),
    ],
)
def test_other_lens_models_are_refused_with_the_remedy(
    tmp_path: Path, text: str, size: tuple[int, int], where: str, words: str
) -> None:
    [problem] = refusal(tmp_path, text, size)
    assert problem.where == where
    assert words in problem.found
    assert "k1 k2 p1 p2 k3" in problem.expected
    assert 'see "Rectify images first" in docs/captures.md' in problem.expected


@pytest.mark.parametrize(
    ("old", "new", "where", "words"),
    [
        ("[LEFT_CAM_SVGA]", "[LEFT_CAM_SVGA]\nk2 = 0.02", "LEFT_DISTO.k2", "differs from LEFT_CAM_SVGA.k2"),
        ("[RIGHT_DISTO]", "[RIGHT]", "RIGHT_CAM_SVGA.k1", "missing"),
        ("k1 = -0.05\n", "", "LEFT_CAM_SVGA.k1", "missing"),
        ("k1 = -0.05", "k1 = -0,05", "LEFT_DISTO.k1", "got '-0,05'"),
        ("k4 = 0", "k4 = none", "LEFT_DISTO.k4", "got 'none'"),
    ],
)
def test_incomplete_and_contradicting_distortion_is_refused(
    tmp_path: Path, old: str, new: str, where: str, words: str
) -> None:
    problem, *_ = refusal(tmp_path, ar0234(BROWN).replace(old, new, 1), (960, 600))
    assert problem.where == where
    assert words in problem.found


@pytest.mark.parametrize(
    ("text", "size", "words"),
    [
        # A size that no table has may be the one of the images.
        (ar0234(BROWN).replace("SVGA", "WVGA"), (960, 600), "[LEFT_CAM_WVGA], [RIGHT_CAM_WVGA] may be"),
        (imx678(BROWN).replace("CAM_QHDPLUS", "CAM_QHD+"), (3200, 1800), "[LEFT_CAM_QHD+]"),
    ],
)
def test_file_with_sections_of_unknown_sizes_is_not_scaled(
    tmp_path: Path, text: str, size: tuple[int, int], words: str
) -> None:
    [problem] = refusal(tmp_path, text, size)
    assert words in problem.found
    assert "calibration.toml with that size" in problem.expected


@pytest.mark.parametrize(
    ("text", "size", "camera", "source"),
    [
        # FHD1200 and SVGA show the same columns; 480 x 300 is half of SVGA: cx = (480.65 + 0.5) / 2 - 0.5.
        (ar0234(BROWN), (480, 300), (185.525, 240.075, 150.55), "SVGA, 960 x 600"),
        (ar0234(BROWN), (1280, 720), (494.7333333, 640.7, 361.9666667), "FHD, 1920 x 1080"),
        (conf(FACTORY, {}, BROWN), (640, 360), (350.94, 320.3925, 171.84175), "HD, 1280 x 720"),
    ],
)
def test_other_sizes_are_scaled_with_a_note(
    tmp_path: Path, text: str, size: tuple[int, int], camera: tuple[float, float, float], source: str
) -> None:
    calibration = read(tmp_path, text, size)
    left = calibration.left
    assert (left.fx, left.cx, left.cy) == pytest.approx(camera, abs=1e-6)
    assert calibration.notes == (
        f"SN1.conf: scaled from {source}, as if both sizes showed the same part of the sensor",
    )


def test_keys_and_sections_without_a_meaning_are_named_once(tmp_path: Path) -> None:
    text = (
        ar0234(BROWN).replace("[LEFT_DISTO]", "[LEFT_DISTO]\nlens = 3").replace("[STEREO]", "[STEREO]\nRY_FHD = 0")
    )
    text += section("LEFT_CAM_WVGA", {"fx": 1, "fy": 2}) + section("IMU", {"a": 1, "b": 2}) + "[EMPTY]\n"
    calibration = read(tmp_path, text.replace("TY = 0.06", "TY_SVGA = 0.06"), (960, 600))
    assert calibration.translation_m == pytest.approx((-0.11982, -0.00006, 0.00011))
    [note] = calibration.notes
    names = "LEFT_DISTO.LENS, STEREO.RY_FHD, LEFT_CAM_WVGA, IMU, EMPTY"
    assert note == f"SN1.conf: fields without a known meaning are left out: {names}"
    assert not read(tmp_path, re.sub(r"(?m)^(k[456]) = .*\n", "", ar0234(BROWN)), (960, 600)).notes
