"""Parsers of stereo calibration files: Stereolabs' INI format (``.conf``) and TOML.

``calibration.read_calibration`` documents both layouts. Every parser appends its problems to the list
``problems``.
"""

from __future__ import annotations

import configparser
import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rebar_depth_bench.geometry.cameras import rotation_vector
from rebar_depth_bench.geometry.stereo_calibration import Lens, StereoCalibration

MIN_PRINCIPAL_POINT = -0.5
"""Smallest coordinate of a principal point, pixels: the left edge of the first pixel, whose centre is at 0."""


@dataclass(frozen=True)
class NumberRange:
    """Allowed range of a number, bounds included; ``unit`` is used in problem messages."""

    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"a number from {self.low:g} to {self.high:g} {self.unit}".rstrip()


FOCAL_RANGE_PX = NumberRange(1.0, 1e5, "pixels")
DISTORTION_RANGE = NumberRange(-1000.0, 1000.0, "")
ANGLE_RANGE_RAD = NumberRange(-0.5, 0.5, "radians")
BASELINE_RANGE_MM = NumberRange(1.0, 10_000.0, "millimetres")
OFFSET_RANGE_MM = NumberRange(-1000.0, 1000.0, "millimetres")
BASELINE_RANGE_M = NumberRange(0.001, 10.0, "metres")
OFFSET_RANGE_M = NumberRange(-10.0, 10.0, "metres")


def principal_point_range(side_px: int) -> NumberRange:
    """Return the range of a principal point coordinate, pixels, for an image side of ``side_px``."""
    return NumberRange(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


def parse_number(raw: object, where: str, allowed: NumberRange, problems: list[str]) -> float:
    """Convert ``raw``, a string or number, to float; if invalid or out of range, add a problem and return NaN."""
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        problems.append(f"{where} is {raw!r}, expected {allowed}")
        return math.nan
    try:
        value = float(raw)
    except (ValueError, OverflowError):
        value = math.nan
    if not allowed.low <= value <= allowed.high:
        problems.append(f"{where} is {raw!r}, expected {allowed}")
        return math.nan
    return value


def parse_numbers(
    raw: object, where: str, counts: Sequence[int], allowed: NumberRange, problems: list[str]
) -> tuple[float, ...]:
    """Convert a list of numbers to a tuple of floats, with NaN and a problem for each invalid number.

    If ``raw`` is not a list with one of the lengths ``counts``, add a problem and return ``max(counts)`` NaNs.
    """
    if not isinstance(raw, list) or len(raw) not in counts:
        expected = " or ".join(str(count) for count in counts)
        problems.append(f"{where} is {raw!r}, expected {expected} numbers")
        return (math.nan,) * max(counts)
    return tuple(parse_number(item, f"{where}[{n}]", allowed, problems) for n, item in enumerate(raw))


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


def parse_conf(text: str, width: int, height: int, problems: list[str]) -> StereoCalibration | None:
    """Parse a Stereolabs ``.conf`` file.

    Returns the calibration of the image size nearest to ``width`` x ``height`` in aspect ratio, then in width; the
    caller scales it. Section names and keys are case-insensitive, unknown keys are ignored. Returns None if the
    file has no sections of a known size; problems are added to ``problems``, with NaN in place of invalid numbers.
    """
    sections = _read_sections(text, problems)
    suffix = _nearest_suffix(sections, width, height, problems)
    if suffix is None:
        return None
    grid = STEREOLABS_GRIDS[suffix]
    left, right = (_conf_lens(sections, f"{eye}_CAM_{suffix}", grid, problems) for eye in ("LEFT", "RIGHT"))
    stereo = _StereoSection(sections, suffix, problems)
    baseline_mm = stereo.value("BASELINE", BASELINE_RANGE_MM)
    offsets_mm = [stereo.value(key, OFFSET_RANGE_MM, default="0") for key in ("TY", "TZ")]
    rx, cv, rz = (stereo.value(key, ANGLE_RANGE_RAD) for key in ("RX", "CV", "RZ"))
    # The whole vector is negated, which keeps it on the line that the vendor's rectification uses.
    translation_m = tuple(0.0 - length / 1000 for length in (baseline_mm, *offsets_mm))
    return StereoCalibration(*grid, left, right, (rx, cv, rz), translation_m)  # type: ignore[arg-type]


def _read_sections(text: str, problems: list[str]) -> Sections:
    """Return the sections with names and keys in upper case; comments after ``;`` and ``#`` are removed."""
    parser = configparser.ConfigParser(
        interpolation=None,
        comment_prefixes=(";", "#"),
        inline_comment_prefixes=(";", "#"),
        default_section="",  # No section provides defaults for the others.
        empty_lines_in_values=False,
    )
    parser.optionxform = str.upper  # type: ignore[assignment,method-assign]
    try:
        parser.read_string(text, "the file")
    except configparser.Error as error:
        problems.append(f"the file is not an INI file: {' '.join(error.message.split())}")
        return {}
    upper_sections: dict[str, Mapping[str, str]] = {}
    for name in parser.sections():
        if name.strip().upper() in upper_sections:
            problems.append(f"section [{name}] occurs twice")
        upper_sections[name.strip().upper()] = dict(parser.items(name))
    return upper_sections


def _nearest_suffix(sections: Sections, width: int, height: int, problems: list[str]) -> str | None:
    """Return the suffix of the sections whose image size is nearest in aspect ratio, then in width.

    Returns None, and adds a problem if there is none yet, if the file has no sections of a known size.
    """
    present = [
        suffix for suffix in STEREOLABS_GRIDS if {f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}"} & set(sections)
    ]
    if not present:
        if not problems:
            found = ", ".join(f"[{name}]" for name in sections) or "no section"
            expected = ", ".join(f"[LEFT_CAM_{suffix}]" for suffix in STEREOLABS_GRIDS)
            problems.append(
                f"the file has {found}, expected one of {expected} with its [RIGHT_CAM_...] and [STEREO]"
            )
        return None

    def distance(suffix: str) -> tuple[float, float]:
        grid_width, grid_height = STEREOLABS_GRIDS[suffix]
        return abs(math.log(grid_width * height / (width * grid_height))), abs(math.log(grid_width / width))

    return min(present, key=distance)


def _conf_lens(sections: Sections, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
    if name not in sections:
        problems.append(f"section [{name}] is missing")
    section = sections.get(name, {})

    def value(key: str, allowed: NumberRange, default: str | None = None) -> float:
        raw = section.get(key.upper(), default)
        if raw is None:
            if name in sections:
                problems.append(f"section [{name}] has no {key}, expected {allowed}")
            return math.nan
        return parse_number(raw, f"section [{name}] {key}", allowed, problems)

    fx, fy = value("fx", FOCAL_RANGE_PX), value("fy", FOCAL_RANGE_PX)
    cx, cy = value("cx", principal_point_range(grid[0])), value("cy", principal_point_range(grid[1]))
    k1, k2 = value("k1", DISTORTION_RANGE), value("k2", DISTORTION_RANGE)
    p1, p2, k3 = (value(key, DISTORTION_RANGE, default="0") for key in ("p1", "p2", "k3"))
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


class _StereoSection:
    """Section ``[STEREO]``: motion between the cameras; its keys may have the suffix of the image size."""

    def __init__(self, sections: Sections, suffix: str, problems: list[str]) -> None:
        self._section = sections.get("STEREO")
        self._suffix = suffix
        self._problems = problems
        if self._section is None:
            problems.append("section [STEREO] is missing")

    def value(self, key: str, allowed: NumberRange, default: str | None = None) -> float:
        if self._section is None:
            return math.nan
        names = [name for name in (f"{key}_{self._suffix}", key) if name in self._section]
        if names:
            return parse_number(self._section[names[0]], f"section [STEREO] {names[0]}", allowed, self._problems)
        if default is None:
            self._problems.append(f"section [STEREO] has no {key}_{self._suffix} and no {key}, expected {allowed}")
            return math.nan
        return float(default)


ROTATION_TOLERANCE = 1e-6
"""Largest deviation of ``R @ R.T`` from the identity for a 3 x 3 rotation."""

_PINHOLE_KEYS = ("fx", "fy", "cx", "cy")
_GRID_SIDE_RANGE_PX = NumberRange(16, 16384, "pixels")
_MATRIX_ENTRY_RANGE = NumberRange(-1.0 - ROTATION_TOLERANCE, 1.0 + ROTATION_TOLERANCE, "")


def parse_toml(text: str, width: int, height: int, problems: list[str]) -> StereoCalibration | None:
    """Parse a TOML calibration for the image size in the file, or else for ``width`` x ``height``.

    Returns None if the text is not TOML or has no ``[stereo]`` table; problems are added to ``problems``, with NaN
    in place of invalid numbers.
    """
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problems.append(f"the file is not a TOML file: {error}")
        return None
    _check_keys(document, "the file", ("width", "height", "left", "right", "stereo"), problems)
    grid = _side(document, "width", width, problems), _side(document, "height", height, problems)
    left, right = (_toml_lens(_table(document, eye, problems), eye, grid, problems) for eye in ("left", "right"))
    stereo = _table(document, "stereo", problems)
    if stereo is None:
        return None
    _check_keys(stereo, "[stereo]", ("rotation", "translation_m", "baseline_m"), problems)
    rotation_rad, translation_m = _rotation_rad(stereo, problems), _translation_m(stereo, problems)
    return StereoCalibration(*grid, left, right, rotation_rad, translation_m)


def _check_keys(table: Mapping[str, Any], where: str, known: Iterable[str], problems: list[str]) -> None:
    unknown = sorted(set(table) - set(known))
    problems.extend(f"{where} has {key!r}, expected only {', '.join(known)}" for key in unknown)


def _table(document: Mapping[str, Any], name: str, problems: list[str]) -> Mapping[str, Any] | None:
    if not isinstance(document.get(name), dict):
        problems.append(f"table [{name}] is missing")
        return None
    return dict(document[name])


def _side(document: Mapping[str, Any], key: str, default: int, problems: list[str]) -> int:
    side = document.get(key, default)
    if (
        isinstance(side, bool)
        or not isinstance(side, int)
        or not _GRID_SIDE_RANGE_PX.low <= side <= _GRID_SIDE_RANGE_PX.high
    ):
        problems.append(f"{key} is {side!r}, expected a whole number of pixels from 16 to 16384")
        return default
    return side


def _toml_lens(table: Mapping[str, Any] | None, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
    if table is None:
        return Lens(math.nan, math.nan, math.nan, math.nan, (math.nan,) * 5)
    _check_keys(table, f"[{name}]", ("K", *_PINHOLE_KEYS, "distortion"), problems)
    pinhole = _pinhole_from_K(table, name, problems) if "K" in table else table
    ranges = (FOCAL_RANGE_PX, FOCAL_RANGE_PX, principal_point_range(grid[0]), principal_point_range(grid[1]))
    values = {}
    for key, allowed in zip(_PINHOLE_KEYS, ranges, strict=True):
        if key in pinhole:
            values[key] = parse_number(pinhole[key], f"[{name}] {key}", allowed, problems)
        elif "K" not in table:
            problems.append(f"[{name}] has no {key} and no K, expected {allowed}")
    if "distortion" not in table:
        problems.append(f"[{name}] has no distortion, expected [k1, k2, p1, p2] or [k1, k2, p1, p2, k3]")
    terms = parse_numbers(
        table.get("distortion", [0.0] * 5), f"[{name}] distortion", (4, 5), DISTORTION_RANGE, problems
    )
    k1, k2, p1, p2, k3 = (*terms, 0.0)[:5]
    fx, fy, cx, cy = (values.get(key, math.nan) for key in _PINHOLE_KEYS)
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def _pinhole_from_K(table: Mapping[str, Any], name: str, problems: list[str]) -> Mapping[str, Any]:
    conflicting = [key for key in _PINHOLE_KEYS if key in table]
    if conflicting:
        problems.append(f"[{name}] has K and also {', '.join(conflicting)}, expected one or the other")
    K = table["K"]
    if not _is_three_by_three(K):
        problems.append(f"[{name}] K is {K!r}, expected three rows of three numbers")
        return {}
    if [K[0][1], K[1][0], *K[2]] != [0, 0, 0, 0, 1]:
        problems.append(f"[{name}] K is {K!r}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}


def _rotation_rad(stereo: Mapping[str, Any], problems: list[str]) -> tuple[float, float, float]:
    unknown, where = (math.nan,) * 3, "[stereo] rotation"
    if "rotation" not in stereo:
        problems.append(f"{where} is missing, expected a Rodrigues vector in radians or a 3 x 3 matrix")
        return unknown
    raw = stereo["rotation"]
    if not _is_three_by_three(raw):
        x, y, z = parse_numbers(raw, where, (3,), ANGLE_RANGE_RAD, problems)
        return x, y, z
    before = len(problems)
    rotation = np.array(
        [parse_numbers(row, f"{where}[{n}]", (3,), _MATRIX_ENTRY_RANGE, problems) for n, row in enumerate(raw)]
    )
    if len(problems) > before:
        return unknown
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        problems.append(f"{where} is {raw!r}, expected a rotation matrix (orthonormal, determinant 1)")
        return unknown
    cosine = (float(np.trace(rotation)) - 1.0) / 2
    parse_number(math.acos(max(-1.0, min(1.0, cosine))), f"{where}'s angle", ANGLE_RANGE_RAD, problems)
    x, y, z = rotation_vector(rotation).tolist()
    return x, y, z


def _translation_m(stereo: Mapping[str, Any], problems: list[str]) -> tuple[float, float, float]:
    if ("translation_m" in stereo) == ("baseline_m" in stereo):
        problems.append("[stereo] has both or neither of translation_m and baseline_m, expected exactly one")
        return (math.nan,) * 3
    if "baseline_m" in stereo:
        return -parse_number(stereo["baseline_m"], "[stereo] baseline_m", BASELINE_RANGE_M, problems), 0.0, 0.0
    x, y, z = parse_numbers(stereo["translation_m"], "[stereo] translation_m", (3,), OFFSET_RANGE_M, problems)
    parse_number(-x, "[stereo] translation_m[0], with its sign changed,", BASELINE_RANGE_M, problems)
    return x, y, z


def _is_three_by_three(raw: object) -> bool:
    return isinstance(raw, list) and [isinstance(row, list) and len(row) for row in raw] == [3, 3, 3]
