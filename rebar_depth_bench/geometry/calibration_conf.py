"""Parser of Stereolabs' calibration files (``.conf``), an INI format.

``calibration.read_calibration`` documents the layout.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import partial

from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, Problem, escape_text
from rebar_depth_bench.geometry.calibration_quantities import (
    ANGLE_RAD,
    BASELINE_MM,
    DISTORTION,
    FOCAL_PX,
    OFFSET_MM,
    principal_point,
)
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration
from rebar_depth_bench.reading import parse_number
from rebar_depth_bench.validation import Expected, format_location, short_repr

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
