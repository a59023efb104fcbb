"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from rebar_depth_bench.errors import CalibrationError, Problem
from rebar_depth_bench.geometry.calibration_conf import read_conf
from rebar_depth_bench.geometry.calibration_quantities import SIDES_PX
from rebar_depth_bench.geometry.calibration_toml import table_calibration
from rebar_depth_bench.geometry.stereo_calibration import (
    Calibration,
    MonoCalibration,
    StereoCalibration,
    check_invertible,
    scale_calibration,
)
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import parse_toml, read_file
from rebar_depth_bench.validation import with_lines

_AnyCalibration = TypeVar("_AnyCalibration", StereoCalibration, MonoCalibration, Calibration)
Parser = Callable[[bytes, int, int, list[Problem]], StereoCalibration | None]


def _read_toml(content: bytes, width: int, height: int, problems: list[Problem]) -> StereoCalibration | None:
    document, syntax_problems = parse_toml(content)
    problems += syntax_problems
    table = None if problems else table_calibration(document, width, height, problems, is_stereo=True)
    return table if isinstance(table, StereoCalibration) else None


PARSERS: Mapping[str, Parser] = {".conf": read_conf, ".toml": _read_toml}


def read_calibration(path: str | Path, width: int, height: int) -> StereoCalibration:
    """Read a stereo calibration from a ``.conf`` or ``.toml`` file, for images of ``width`` x ``height`` pixels.

    ``.conf`` is Stereolabs' INI file: sections ``LEFT_CAM_2K``, ``_FHD``, ``_HD``, ``_VGA`` (and ``RIGHT_CAM_``)
    with fx fy cx cy k1 k2 and, if given, p1 p2 k3; ``STEREO`` with Baseline, TY, TZ (millimetres; 0 where TY or
    TZ is missing) and RX, CV, RZ (radians), each with or without the section's suffix. If the file has no sections
    for the requested size, those nearest in aspect ratio and then in width are read and passed to
    ``scale_calibration``, which assumes that both sizes cover the same sensor area. The motion is
    ``x_right = R x_left + T`` with R = Rodrigues(RX, CV, RZ) and T = -(Baseline, TY, TZ): the whole vector is
    negated, which keeps it on the line that the vendor's rectification uses.

    In TOML, ``K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` may replace the four numbers, ``rotation`` may be a
    3 x 3 matrix, and ``baseline_m = 0.12`` may replace ``translation_m = [-0.12, 0, 0]``::

        width = 1280    # image size of the calibration; default: the requested size
        height = 720

        [left]
        fx = 701.88
        fy = 701.70
        cx = 641.285    # pixel centres at integers
        cy = 344.1835
        distortion = [-0.175286, 0.0283094, 6.68e-5, -1.50e-4, 1e-10]    # k1 k2 p1 p2, and k3 if known

        [right]
        K = [[700.965, 0, 633.515], [0, 701.11, 359.3135], [0, 0, 1]]
        distortion = [-0.172795, 0.0265223, 1.64e-4, 1.02e-5]

        [stereo]        # x_right = R x_left + T
        rotation = [-9.17e-4, 6.24e-3, 7.70e-4]    # Rodrigues vector, radians
        translation_m = [-0.119978, 0.0, 0.0]

    Raises ``CalibrationError`` with all problems of the file; also if a distortion model cannot be inverted over
    the whole image, and if the requested size is not 16 to 16384 pixels each.
    """
    path = Path(path)
    parser = PARSERS.get(path.suffix.lower())
    if parser is None:
        problem = Problem("invalid", "", f"the file suffix is {path.suffix!r}", " or ".join(PARSERS))
        raise CalibrationError.from_problems(path, [problem])
    content = read_file(path, TOML_BYTES, "a calibration file", CalibrationError)
    check_image_size(path, width, height)
    problems: list[Problem] = []
    calibration = parser(content, width, height, problems)
    if calibration is None or problems:
        problems += calibration_problems(calibration)
        raise CalibrationError.from_problems(path, with_lines(problems, content))
    return scaled_calibration(calibration, path, width, height)


def check_image_size(path: object, width: int, height: int) -> None:
    """Raise ``CalibrationError`` for images of a size that the calibration ``path`` cannot be scaled to."""
    if width not in SIDES_PX or height not in SIDES_PX:
        expected = f"{SIDES_PX[0]} to {SIDES_PX[-1]} pixels each"
        problem = Problem("invalid", "", f"it is requested for images of {width} x {height}", expected)
        raise CalibrationError.from_problems(path, [problem])


def scaled_calibration(calibration: _AnyCalibration, path: object, width: int, height: int) -> _AnyCalibration:
    """Return a calibration for another image size; raise ``CalibrationError`` with its problems if it has any."""
    if problems := calibration_problems(calibration):
        raise CalibrationError.from_problems(path, problems)
    return scale_calibration(calibration, width, height)


def calibration_problems(calibration: Calibration | None) -> list[Problem]:
    """Return what is wrong with a calibration: an offset that is not along x, distortion without an inverse."""
    if calibration is None:
        return []
    problems = []
    eyes = {"left": calibration.left}
    if isinstance(calibration, StereoCalibration):
        eyes["right"] = calibration.right
        x_m, y_m, z_m = calibration.translation_m
        if max(abs(y_m), abs(z_m)) > abs(x_m) / 2:
            found = f"the right camera is at {(-x_m, -y_m, -z_m)} m from the left one"
            problems.append(Problem("conflict", "stereo", found, "an offset mostly along x"))
    for eye, lens in eyes.items():
        try:
            check_invertible(lens, calibration.width, calibration.height)
        except ValueError as error:
            found = f"the distortion cannot be inverted at the image border: {error}"
            problems.append(Problem("conflict", eye, found))
    return problems
