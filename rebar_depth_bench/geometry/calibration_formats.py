"""Parsers of stereo calibration files: Stereolabs' INI format (``.conf``) and TOML.

``calibration.read_calibration`` documents both layouts. A parser returns None after appending the problems of the
file to the list ``problems``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from functools import partial
from typing import Annotated

import numpy as np
from pydantic import Field, Strict, ValidationInfo, field_validator

from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, Problem, escape_text
from rebar_depth_bench.geometry.cameras import rotation_vector
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration
from rebar_depth_bench.reading import parse_number, parse_toml
from rebar_depth_bench.validation import (
    Expected,
    StrictModel,
    Triple,
    field_error,
    format_location,
    number,
    short_repr,
    validate_table,
    whole_number,
)

SIDES_PX = range(16, 16385)
"""Accepted widths and heights of images, pixels."""
MIN_PRINCIPAL_POINT = -0.5
"""Smallest coordinate of a principal point, pixels: the left edge of the first pixel, whose centre is at 0."""
ROTATION_TOLERANCE = 1e-6
"""Largest deviation of ``R @ R.T`` from the identity for a 3 x 3 rotation."""


def _quantity(low: float, high: float, unit: str) -> Expected:
    return number(low, high, f"a number from {low:g} to {high:g} {unit}")


def _principal_point(side_px: int) -> Expected:
    return _quantity(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


_FOCAL_PX = _quantity(1, 1e5, "pixels")
_DISTORTION = number(-1000, 1000)
_ANGLE_RAD = _quantity(-0.5, 0.5, "radians")
_BASELINE_MM = _quantity(1, 10_000, "millimetres")
_OFFSET_MM = _quantity(-1000, 1000, "millimetres")
_BASELINE_M = _quantity(0.001, 10, "metres")
_OFFSET_M = _quantity(-10, 10, "metres")

STEREOLABS_GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""Image sizes (width, height) of Stereolabs cameras, pixels, by section suffix."""

Sections = Mapping[str, Mapping[str, str]]
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
        fx, fy = value(section, ["fx"], _FOCAL_PX), value(section, ["fy"], _FOCAL_PX)
        cx, cy = value(section, ["cx"], _principal_point(width)), value(section, ["cy"], _principal_point(height))
        k1, k2 = (value(section, [key], _DISTORTION) for key in ("k1", "k2"))
        p1, p2, k3 = (value(section, [key], _DISTORTION, default=0.0) for key in ("p1", "p2", "k3"))
        return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))

    left, right = lens(names[0]), lens(names[1])
    baseline_mm = value("STEREO", [f"Baseline_{suffix}", "Baseline"], _BASELINE_MM)
    y_mm, z_mm = (value("STEREO", [f"{key}_{suffix}", key], _OFFSET_MM, default=0.0) for key in ("TY", "TZ"))
    rx, cv, rz = (value("STEREO", [f"{key}_{suffix}", key], _ANGLE_RAD) for key in ("RX", "CV", "RZ"))
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
    sections: dict[str, dict[str, str]] = {}
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
            sections[section][key.lower()] = value[0]
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
    raw = values[key.lower()]
    value = parse_number(raw)
    if not expected.accept(value):
        problems.append(Problem("invalid", f"{section}.{key}", f"got {short_repr(raw)}", expected.text))
    return value


_Matrix = Annotated[tuple[Triple, Triple, Triple], Strict(False)]
_Offset = Annotated[float, _OFFSET_M]
_Pixels = Annotated[float, Expected("a number of pixels")]
_Side = Annotated[int, whole_number(SIDES_PX[0], SIDES_PX[-1])]
_PINHOLE_ENTRIES: Mapping[str, tuple[int, int]] = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
_PINHOLE = Expected(
    "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]", lambda K: (K[0][1], K[1][0], *K[2]) == (0, 0, 0, 0, 1)
)
_TERMS = Expected("[k1, k2, p1, p2] or [k1, k2, p1, p2, k3]", lambda terms: len(terms) in (4, 5))


def _is_small_rotation(rotation: Triple | _Matrix) -> bool:
    """Return whether a Rodrigues vector, or a rotation matrix, has a plausible angle."""
    values = np.array(rotation)
    if values.ndim == 1:
        return all(map(_ANGLE_RAD.accept, rotation))
    if not (np.abs(values) <= 1 + ROTATION_TOLERANCE).all():  # The products stay finite; false for NaN.
        return False
    cosine = (float(np.trace(values)) - 1.0) / 2
    return bool(
        np.abs(values @ values.T - np.eye(3)).max() <= ROTATION_TOLERANCE
        and np.linalg.det(values) >= 0
        and _ANGLE_RAD.accept(math.acos(max(-1.0, min(1.0, cosine))))
    )


_ROTATION = Expected(
    f"a Rodrigues vector or a 3 x 3 rotation matrix, each angle {_ANGLE_RAD.text}", _is_small_rotation
)


class _LensTable(StrictModel):  # Order matters: validators read the fields above theirs.
    """Table ``[left]`` or ``[right]``; ``info.context`` is the image size."""

    K: Annotated[_Matrix, _PINHOLE] | None = None
    fx: Annotated[float, _FOCAL_PX] = Field(default=None, validate_default=True)
    fy: Annotated[float, _FOCAL_PX] = Field(default=None, validate_default=True)
    cx: _Pixels = Field(default=None, validate_default=True)
    cy: _Pixels = Field(default=None, validate_default=True)
    distortion: Annotated[list[Annotated[float, _DISTORTION]], _TERMS]

    @field_validator(*_PINHOLE_ENTRIES, mode="before")
    @classmethod
    def _take_from_K(cls, value: object, info: ValidationInfo) -> object:
        """Return the number, or the entry of K; any valid number if K is given but invalid."""
        K = info.data.get("K", ((1, 0, 1), (0, 1, 1), (0, 0, 1)))
        _check_one_given({str(info.field_name): value, "K": K})
        row, column = _PINHOLE_ENTRIES[str(info.field_name)]
        return value if K is None else K[row][column]

    @field_validator("cx", "cy")
    @classmethod
    def _check_inside_image(cls, value: float, info: ValidationInfo[Mapping[str, int]]) -> float:
        expected = _principal_point(info.context["width" if info.field_name == "cx" else "height"])
        if not expected.accept(value):
            raise field_error(f"got {value}", expected.text)
        return value

    @property
    def lens(self) -> Lens:
        """Lens of the table."""
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
        return Lens(self.fx, self.fy, self.cx, self.cy, (k1, k2, p1, p2, k3))


class _StereoTable(StrictModel):
    """Table ``[stereo]``; the baseline is converted to a translation."""

    rotation: Annotated[Triple | _Matrix, _ROTATION]
    baseline_m: Annotated[float, _BASELINE_M] | None = None
    translation_m: Annotated[
        tuple[_Offset, _Offset, _Offset], Strict(False), Expected("three numbers, metres")
    ] = Field(default=None, validate_default=True)

    @field_validator("translation_m", mode="before")
    @classmethod
    def _take_from_baseline(cls, translation_m: object, info: ValidationInfo) -> object:
        """Return the translation, or that along x; any valid one if the baseline is given but invalid."""
        baseline_m = info.data.get("baseline_m", 1.0)
        _check_one_given({"translation_m": translation_m, "baseline_m": baseline_m})
        return translation_m if baseline_m is None else (-baseline_m, 0.0, 0.0)

    @field_validator("translation_m")
    @classmethod
    def _check_baseline(cls, translation_m: Triple) -> Triple:
        if not _BASELINE_M.accept(-translation_m[0]):
            raise field_error(f"got {list(translation_m)}", f"[-baseline, y, z], the baseline {_BASELINE_M.text}")
        return translation_m


class _CalibrationTable(StrictModel):
    """Content of a TOML file."""

    width: _Side
    height: _Side
    left: _LensTable
    right: _LensTable
    stereo: _StereoTable


def _check_one_given(values: Mapping[str, object]) -> None:
    """Check that one of two keys has a value. Raises the error of a field otherwise."""
    given = [key for key, value in values.items() if value is not None]
    if len(given) != 1:
        found = f"got {' and '.join(given)}" if given else "missing"
        raise field_error(found, f"either {' or '.join(values)}", "conflict" if given else "missing")


def read_toml(content: bytes, width: int, height: int, problems: list[Problem]) -> StereoCalibration | None:
    """Return the calibration of a TOML file, for the image size in the file or else ``width`` x ``height``."""
    document, syntax_problems = parse_toml(content)
    problems += syntax_problems
    sides_px = {"width": width, "height": height}
    values = {**sides_px, **document}
    context = {key: values[key] if values[key] in SIDES_PX else side_px for key, side_px in sides_px.items()}
    table = None if problems else validate_table(_CalibrationTable, values, problems, context=context)
    if table is None:
        return None
    rotation = np.array(table.stereo.rotation)
    x, y, z = (rotation if rotation.ndim == 1 else rotation_vector(rotation)).tolist()
    left, right, translation_m = table.left.lens, table.right.lens, table.stereo.translation_m
    return StereoCalibration(table.width, table.height, left, right, (x, y, z), translation_m)
