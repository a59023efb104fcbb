"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TypeVar

from rebar_depth_bench.captures.calibration import (
    ANGLE_RAD,
    BASELINE_MM,
    DISTORTION,
    FOCAL_PX,
    OFFSET_MM,
    SIDES_PX,
    Calibration,
    Lens,
    MonoCalibration,
    StereoCalibration,
    check_invertible,
    principal_point,
    scale_calibration,
    table_calibration,
)
from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, CalibrationError, Problem, escape_text
from rebar_depth_bench.key_lines import with_lines
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.reading import parse_number, parse_toml, read_file
from rebar_depth_bench.validation import Expected, format_location, short_repr

_AnyCalibration = TypeVar("_AnyCalibration", StereoCalibration, MonoCalibration, Calibration)
Parser = Callable[[bytes, int, int, list[Problem]], StereoCalibration | None]


def _read_toml(content: bytes, width: int, height: int, problems: list[Problem]) -> StereoCalibration | None:
    document, syntax_problems = parse_toml(content)
    problems += syntax_problems
    table = None if problems else table_calibration(document, width, height, problems, is_stereo=True)
    return table if isinstance(table, StereoCalibration) else None


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
    parsers: Mapping[str, Parser] = {".conf": read_conf, ".toml": _read_toml}
    parser = parsers.get(path.suffix.lower())
    if parser is None:
        problem = Problem("invalid", "", f"the file suffix is {path.suffix!r}", " or ".join(parsers))
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


# Parser of Stereolabs' calibration files, an INI format.


STEREOLABS_GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""Image sizes (width, height) of Stereolabs cameras, pixels, by section suffix."""

Sections = Mapping[str, Mapping[str, tuple[int, str]]]
"""Line and text of each key of each section."""
_COMMENT = re.compile(r"(?:^|\s)[;#]")
_SEPARATOR = re.compile("[=:]")


def read_conf(content: bytes, width: int, height: int, problems: list[Problem]) -> StereoCalibration | None:
    """Return the calibration of a Stereolabs ``.conf`` file for one of its image sizes; the caller scales it.

    The size is that nearest to ``width`` x ``height`` in aspect ratio, then in width. Section names and keys are
    case-insensitive, unknown keys are ignored.
    """
    sections = _read_sections(content, problems)
    suffix = _nearest_suffix(sections, width, height, problems)
    if suffix is None:
        return None
    width, height = STEREOLABS_GRIDS[suffix]
    names = (f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}", "STEREO")
    problems += [Problem("missing", name, "missing", "a section") for name in names if name not in sections]
    value = partial(_conf_number, sections, problems)

    def lens(section: str) -> Lens:
        fx, fy = value(section, ["fx"], FOCAL_PX), value(section, ["fy"], FOCAL_PX)
        cx, cy = value(section, ["cx"], principal_point(width)), value(section, ["cy"], principal_point(height))
        k1, k2 = (value(section, [key], DISTORTION) for key in ("k1", "k2"))
        p1, p2, k3 = (value(section, [key], DISTORTION, default=0.0) for key in ("p1", "p2", "k3"))
        return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))

    left, right = lens(names[0]), lens(names[1])
    baseline_mm = value("STEREO", [f"Baseline_{suffix}", "Baseline"], BASELINE_MM)
    y_mm, z_mm = (value("STEREO", [f"{key}_{suffix}", key], OFFSET_MM, default=0.0) for key in ("TY", "TZ"))
    rx, cv, rz = (value("STEREO", [f"{key}_{suffix}", key], ANGLE_RAD) for key in ("RX", "CV", "RZ"))
    # The whole vector is negated, which keeps it on the line that the vendor's rectification uses.
    translation_m = (0.0 - baseline_mm / 1000, 0.0 - y_mm / 1000, 0.0 - z_mm / 1000)
    return None if problems else StereoCalibration(width, height, left, right, (rx, cv, rz), translation_m)


def _read_sections(content: bytes, problems: list[Problem]) -> Sections:
    """Return the sections, names in upper and keys in lower case, without the comments after ``;`` and ``#``."""
    try:
        lines = content.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        problems.append(Problem("syntax", "", f"byte {error.start} is not UTF-8", "an INI file"))
        return {}
    sections: dict[str, dict[str, tuple[int, str]]] = {}
    section = ""
    for line_number, line in enumerate(lines, start=1):
        if len(problems) == MAX_PROBLEMS_SHOWN:
            break
        text = _COMMENT.split(line, maxsplit=1)[0].strip()
        key, *value = (part.strip() for part in _SEPARATOR.split(text, maxsplit=1))
        if text.startswith("[") and text.endswith("]"):
            section = text[1:-1].strip().upper()
            if section in sections:
                place = format_location("", section)
                problems.append(Problem("duplicate", place, f"line {line_number}: the section occurs twice"))
            sections.setdefault(section, {})
        elif key and value and section:
            if key.lower() in sections[section]:
                place = format_location("", section, key)
                problems.append(Problem("duplicate", place, f"line {line_number}: the key occurs twice"))
            sections[section][key.lower()] = line_number, value[0]
        elif text:
            expected = "[SECTION] or key = value" if section else "a [SECTION]"
            problems.append(Problem("syntax", "", f"line {line_number} is {short_repr(text)}", expected))
    return sections


def _nearest_suffix(sections: Sections, width: int, height: int, problems: list[Problem]) -> str | None:
    """Return the suffix of the sections whose image size is nearest in aspect ratio, then in width.

    Returns None, and adds a problem if there is none yet, if the file has no sections of a known size.
    """
    present = [name for name in STEREOLABS_GRIDS if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} & set(sections)]
    if not present and not problems:
        found = escape_text(", ".join(f"[{name}]" for name in sections) or "no section")
        cameras = ", ".join(f"[LEFT_CAM_{name}]" for name in STEREOLABS_GRIDS)
        expected = f"one of {cameras} with its [RIGHT_CAM_...] and [STEREO]"
        problems.append(Problem("missing", "", f"the file has {found}", expected))

    def distance(suffix: str) -> tuple[float, float]:
        grid_width, grid_height = STEREOLABS_GRIDS[suffix]
        return abs(math.log(grid_width * height / (width * grid_height))), abs(math.log(grid_width / width))

    return min(present, key=distance, default=None)


def _conf_number(
    sections: Sections,
    problems: list[Problem],
    section: str,
    keys: list[str],
    expected: Expected,
    default: float | None = None,
) -> float:
    """Return the number of the first of ``keys`` in a section, or else ``default`` (NaN if it is None).

    Add a problem if the number is invalid, or if it is missing from an existing section and has no default.
    """
    values = sections.get(section, {})
    key = next((key for key in keys if key.lower() in values), None)
    if key is None:
        if default is None and section in sections:
            problems.append(Problem("missing", f"{section}.{keys[-1]}", "missing", expected.text))
        return math.nan if default is None else default
    line_number, raw = values[key.lower()]
    value = parse_number(raw)
    if not expected.accept(value):
        problems.append(
            Problem("invalid", f"{section}.{key}", f"line {line_number}: got {short_repr(raw)}", expected.text)
        )
    return value
