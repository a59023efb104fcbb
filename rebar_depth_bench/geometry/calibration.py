"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from rebar_depth_bench.errors import CalibrationError
from rebar_depth_bench.geometry.calibration_formats import parse_conf, parse_toml
from rebar_depth_bench.geometry.stereo_calibration import StereoCalibration, check_invertible, scale_calibration

MAX_FILE_BYTES = 1_000_000
"""Size limit of a calibration file, bytes; real ones have a few kilobytes."""

Parser = Callable[[str, int, int, list[str]], StereoCalibration | None]
PARSERS: Mapping[str, Parser] = {".conf": parse_conf, ".toml": parse_toml}


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

    Raises ``CalibrationError`` with every problem, each naming section, key, value and expected value; also if a
    distortion model cannot be inverted over the whole image.
    """
    path = Path(path)
    if path.suffix.lower() not in PARSERS:
        raise CalibrationError(str(path), [f"the file suffix is {path.suffix!r}, expected {' or '.join(PARSERS)}"])
    problems: list[str] = []
    calibration = PARSERS[path.suffix.lower()](_read_text(path), width, height, problems)
    if calibration is not None and not problems:
        _check_rig(calibration, problems)
    if calibration is None or problems:
        raise CalibrationError(str(path), problems)
    return scale_calibration(calibration, width, height)


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise CalibrationError(str(path), [f"the file cannot be read: {error.strerror}"]) from error
    if len(content) > MAX_FILE_BYTES:
        raise CalibrationError(
            str(path), [f"the file is larger than {MAX_FILE_BYTES} bytes, expected a calibration file"]
        )
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CalibrationError(str(path), [f"the file is not UTF-8: byte {error.start} is invalid"]) from error


def _check_rig(calibration: StereoCalibration, problems: list[str]) -> None:
    x_m, y_m, z_m = calibration.translation_m
    if max(abs(y_m), abs(z_m)) > abs(x_m) / 2:
        problems.append(
            f"the right camera is at {(-x_m, -y_m, -z_m)} m from the left one, expected an offset mostly along x"
        )
    for eye, lens in (("left", calibration.left), ("right", calibration.right)):
        try:
            check_invertible(lens, calibration.width, calibration.height)
        except ValueError as error:
            problems.append(f"the {eye} distortion cannot be inverted at the image border: {error}")
