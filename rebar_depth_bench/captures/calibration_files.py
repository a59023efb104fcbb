"""Stereo calibration files: Stereolabs ``.conf`` or TOML, scaled to the requested image size."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, CalibrationError, Problem, escape_text
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import parse_number, parse_toml, read_file
from rebar_depth_bench.base.validation import Expected, format_location, short_repr, with_lines
from rebar_depth_bench.captures.calibration import (
    ANGLE_RAD,
    DISTORTION,
    FOCAL_PX,
    SIDES_PX,
    Calibration,
    Lens,
    StereoCalibration,
    principal_point,
    quantity,
    scaled_calibration,
    table_calibration,
)


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
    the whole image, if the requested size is not 16 to 16384 pixels each, and if its aspect ratio is another one.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".conf", ".toml"):
        problem = Problem("invalid", "", f"the file suffix is {path.suffix!r}", ".conf or .toml")
        raise CalibrationError.from_problems(path, [problem])
    content = read_file(path, TOML_BYTES, "a calibration file", CalibrationError)
    check_image_size(path, width, height)
    problems: list[Problem] = []
    if suffix == ".conf":
        calibration: Calibration | None = _read_conf(content, width, height, problems)
    else:
        document, problems = parse_toml(content)
        calibration = None if problems else table_calibration(document, width, height, problems, is_stereo=True)
    if not isinstance(calibration, StereoCalibration):
        raise CalibrationError.from_problems(path, with_lines(problems, content))
    return scaled_calibration(calibration, path, width, height)


def check_image_size(path: object, width: int, height: int) -> None:
    """Raise ``CalibrationError`` for images of a size that the calibration ``path`` cannot be scaled to."""
    if width not in SIDES_PX or height not in SIDES_PX:
        expected = f"{SIDES_PX[0]} to {SIDES_PX[-1]} pixels each"
        problem = Problem("invalid", "", f"it is requested for images of {width} x {height}", expected)
        raise CalibrationError.from_problems(path, [problem])


# Stereolabs' files, an INI format.

_GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""Image sizes (width, height) of Stereolabs cameras, pixels, by section suffix."""

_STEREO: Mapping[str, Expected] = {
    "Baseline": quantity(1, 10_000, "millimetres"),
    **dict.fromkeys(("TY", "TZ"), quantity(-1000, 1000, "millimetres")),
    **dict.fromkeys(("RX", "CV", "RZ"), ANGLE_RAD),
}
"""Keys of the section ``[STEREO]``."""
_OPTIONAL = ("p1", "p2", "k3", "TY", "TZ")
"""Keys that may be missing, which means 0."""

_Sections = Mapping[str, Mapping[str, tuple[int, str]]]
"""Line and text of each key of each section."""
_COMMENT = re.compile(r"(?:^|\s)[;#]")
_SEPARATOR = re.compile("[=:]")


def _camera_keys(width: int, height: int) -> Mapping[str, Expected]:
    """Return the keys of the section of a camera whose images have ``width`` x ``height`` pixels."""
    return {
        **dict.fromkeys(("fx", "fy"), FOCAL_PX),
        "cx": principal_point(width),
        "cy": principal_point(height),
        **dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), DISTORTION),
    }


def _read_conf(content: bytes, width: int, height: int, problems: list[Problem]) -> StereoCalibration | None:
    """Return the calibration of a Stereolabs ``.conf`` file for one of its image sizes; the caller scales it.

    The size is that nearest to ``width`` x ``height`` in aspect ratio, then in width. Section names and keys are
    case-insensitive, unknown keys are ignored. Problems are added to ``problems``; the result is None if there are
    any.
    """
    sections = _read_sections(content, problems)
    suffix = _nearest_suffix(sections, width, height, problems)
    if suffix is None:
        return None
    width, height = _GRIDS[suffix]
    names = (f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}", "STEREO")
    problems += [Problem("missing", name, "missing", "a section") for name in names if name not in sections]
    lenses = []
    for name in names[:2]:
        keys = _camera_keys(width, height)
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = _section_numbers(sections, name, keys, suffix, problems)
        lenses.append(Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3)))
    baseline_mm, y_mm, z_mm, rx, cv, rz = _section_numbers(sections, "STEREO", _STEREO, suffix, problems)
    translation_m = (0.0 - baseline_mm / 1000, 0.0 - y_mm / 1000, 0.0 - z_mm / 1000)
    return (
        None if problems else StereoCalibration(width, height, lenses[0], lenses[1], (rx, cv, rz), translation_m)
    )


def _read_sections(content: bytes, problems: list[Problem]) -> _Sections:
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


def _nearest_suffix(sections: _Sections, width: int, height: int, problems: list[Problem]) -> str | None:
    """Return the suffix of the sections whose image size is nearest in aspect ratio, then in width.

    Returns None, and adds a problem if there is none yet, if the file has no sections of a known size.
    """
    present = [name for name in _GRIDS if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} & set(sections)]
    if not present and not problems:
        found = escape_text(", ".join(f"[{name}]" for name in sections) or "no section")
        cameras = ", ".join(f"[LEFT_CAM_{name}]" for name in _GRIDS)
        expected = f"one of {cameras} with its [RIGHT_CAM_...] and [STEREO]"
        problems.append(Problem("missing", "", f"the file has {found}", expected))

    def distance(suffix: str) -> tuple[float, float]:
        grid_width, grid_height = _GRIDS[suffix]
        return abs(math.log(grid_width * height / (width * grid_height))), abs(math.log(grid_width / width))

    return min(present, key=distance, default=None)


def _section_numbers(
    sections: _Sections, section: str, keys: Mapping[str, Expected], suffix: str, problems: list[Problem]
) -> list[float]:
    """Return the numbers of a section, by keys with the section's suffix or without; 0 for missing ones.

    Add a problem for each invalid number, and for each missing one of an existing section unless it is optional.
    """
    values = sections.get(section, {})
    numbers = []
    for key, expected in keys.items():
        name = next((name for name in (f"{key}_{suffix}", key) if name.lower() in values), None)
        if name is None:
            if section in sections and key not in _OPTIONAL:
                problems.append(Problem("missing", f"{section}.{key}", "missing", expected.text))
            numbers.append(0.0)
            continue
        line_number, raw = values[name.lower()]
        numbers.append(parse_number(raw))
        if not expected.accept(numbers[-1]):
            found = f"line {line_number}: got {short_repr(raw)}"
            problems.append(Problem("invalid", f"{section}.{name}", found, expected.text))
    return numbers
