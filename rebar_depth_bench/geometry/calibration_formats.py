"""The factory calibration of a Stereolabs camera: an INI file with a section for each eye and grid.

A stereo calibration in TOML; ``calibration.read_calibration`` shows the layout.
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
"""The left edge of the first pixel, whose centre is 0."""


@dataclass(frozen=True)
class Range:
    """What a number may be, bounds included, and its unit for the words of a problem."""

    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"a number from {self.low:g} to {self.high:g} {self.unit}".rstrip()


FOCAL = Range(1.0, 1e5, "pixels")
TERM = Range(-1000.0, 1000.0, "")
ANGLE = Range(-0.5, 0.5, "radians")
BASELINE_MM = Range(1.0, 10_000.0, "millimetres")
OFFSET_MM = Range(-1000.0, 1000.0, "millimetres")
BASELINE_M = Range(0.001, 10.0, "metres")
OFFSET_M = Range(-10.0, 10.0, "metres")


def principal_range(side_px: int) -> Range:
    """Return the range of a principal point's coordinate: inside the picture."""
    return Range(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


def number(raw: object, where: str, allowed: Range, problems: list[str]) -> float:
    """Return ``raw``, text or a number, as a float; NaN and a further problem where it is none or out of range."""
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


def numbers(
    raw: object, where: str, counts: Sequence[int], allowed: Range, problems: list[str]
) -> tuple[float, ...]:
    """Return a list of numbers; NaNs and further problems where it is none, or not of one of the ``counts``."""
    if not isinstance(raw, list) or len(raw) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        problems.append(f"{where} is {raw!r}, expected {wanted} numbers")
        return (math.nan,) * max(counts)
    return tuple(number(item, f"{where}[{n}]", allowed, problems) for n, item in enumerate(raw))


GRIDS: Mapping[str, tuple[int, int]] = {
    "2K": (2208, 1242),
    "FHD": (1920, 1080),
    "FHD1200": (1920, 1200),
    "HD": (1280, 720),
    "SVGA": (960, 600),
    "VGA": (672, 376),
}
"""The grids of Stereolabs cameras by the suffix of their sections."""

Sections = Mapping[str, Mapping[str, str]]


def parse_conf(text: str, width: int, height: int, problems: list[str]) -> StereoCalibration | None:
    """Return the calibration for a grid of ``width`` x ``height``; none, and further problems, where it fails.

    It is that of the file's own section for this grid, or else the one nearest to it in shape, then in width:
    the caller scales it. Case is of no matter, unknown keys are passed over.
    """
    sections = _sections(text, problems)
    suffix = _suffix(sections, width, height, problems)
    if suffix is None:
        return None
    grid = GRIDS[suffix]
    left, right = (_conf_lens(sections, f"{eye}_CAM_{suffix}", grid, problems) for eye in ("LEFT", "RIGHT"))
    stereo = _Stereo(sections, suffix, problems)
    baseline_mm = stereo.value("BASELINE", BASELINE_MM)
    across_mm = [stereo.value(key, OFFSET_MM, default="0") for key in ("TY", "TZ")]
    rx, cv, rz = (stereo.value(key, ANGLE) for key in ("RX", "CV", "RZ"))
    # The whole vector changes its sign, so that it stays on the line that the vendor's rectification uses.
    translation_m = tuple(0.0 - length / 1000 for length in (baseline_mm, *across_mm))
    return StereoCalibration(*grid, left, right, (rx, cv, rz), translation_m)  # type: ignore[arg-type]


def _sections(text: str, problems: list[str]) -> Sections:
    """Return the file's sections and keys in upper case, comments after ``;`` and ``#`` dropped."""
    parser = configparser.ConfigParser(
        interpolation=None,
        comment_prefixes=(";", "#"),
        inline_comment_prefixes=(";", "#"),
        default_section="",  # no section lends its keys to the others
        empty_lines_in_values=False,
    )
    parser.optionxform = str.upper  # type: ignore[assignment,method-assign]
    try:
        parser.read_string(text, "the file")
    except configparser.Error as error:
        problems.append(f"it is no INI file: {' '.join(error.message.split())}")
        return {}
    found: dict[str, Mapping[str, str]] = {}
    for name in parser.sections():
        if name.strip().upper() in found:
            problems.append(f"section [{name}] stands there twice")
        found[name.strip().upper()] = dict(parser.items(name))
    return found


def _suffix(sections: Sections, width: int, height: int, problems: list[str]) -> str | None:
    """Return the suffix of the sections to read: the exact grid, else the nearest in shape, then in width."""
    present = [suffix for suffix in GRIDS if {f"LEFT_CAM_{suffix}", f"RIGHT_CAM_{suffix}"} & set(sections)]
    if not present:
        if not problems:
            found = ", ".join(f"[{name}]" for name in sections) or "no section"
            wanted = ", ".join(f"[LEFT_CAM_{suffix}]" for suffix in GRIDS)
            problems.append(f"it has {found}, expected one of {wanted}, its [RIGHT_CAM_...] and [STEREO]")
        return None

    def distance(suffix: str) -> tuple[float, float]:
        wide, high = GRIDS[suffix]
        return abs(math.log(wide * height / (width * high))), abs(math.log(wide / width))

    return min(present, key=distance)


def _conf_lens(sections: Sections, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
    if name not in sections:
        problems.append(f"section [{name}] is missing")
    section = sections.get(name, {})

    def value(key: str, allowed: Range, default: str | None = None) -> float:
        raw = section.get(key.upper(), default)
        if raw is None:
            if name in sections:
                problems.append(f"section [{name}] has no {key}, expected {allowed}")
            return math.nan
        return number(raw, f"section [{name}] {key}", allowed, problems)

    fx, fy = value("fx", FOCAL), value("fy", FOCAL)
    cx, cy = value("cx", principal_range(grid[0])), value("cy", principal_range(grid[1]))
    k1, k2 = value("k1", TERM), value("k2", TERM)
    p1, p2, k3 = (value(key, TERM, default="0") for key in ("p1", "p2", "k3"))
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


class _Stereo:
    """The section between the two eyes, whose keys bear the grid's suffix or none."""

    def __init__(self, sections: Sections, suffix: str, problems: list[str]) -> None:
        self._section = sections.get("STEREO")
        self._suffix = suffix
        self._problems = problems
        if self._section is None:
            problems.append("section [STEREO] is missing")

    def value(self, key: str, allowed: Range, default: str | None = None) -> float:
        if self._section is None:
            return math.nan
        names = [name for name in (f"{key}_{self._suffix}", key) if name in self._section]
        if names:
            return number(self._section[names[0]], f"section [STEREO] {names[0]}", allowed, self._problems)
        if default is None:
            self._problems.append(f"section [STEREO] has no {key}_{self._suffix} and no {key}, expected {allowed}")
            return math.nan
        return float(default)


RIGIDITY = 1e-6
"""By how much the rows of a 3 x 3 rotation may miss length 1 and right angles."""

_PINHOLE_KEYS = ("fx", "fy", "cx", "cy")
_GRID_SIDE = Range(16, 16384, "pixels")
_ENTRY = Range(-1.0 - RIGIDITY, 1.0 + RIGIDITY, "")


def parse_toml(text: str, width: int, height: int, problems: list[str]) -> StereoCalibration | None:
    """Return the calibration of the grid the file names, or else of the asked one; none where it fails.

    What is wrong is added to ``problems``.
    """
    try:
        file = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        problems.append(f"it is no TOML file: {error}")
        return None
    _check_keys(file, "the file", ("width", "height", "left", "right", "stereo"), problems)
    grid = _side(file, "width", width, problems), _side(file, "height", height, problems)
    left, right = (_toml_lens(_table(file, eye, problems), eye, grid, problems) for eye in ("left", "right"))
    stereo = _table(file, "stereo", problems)
    if stereo is None:
        return None
    _check_keys(stereo, "[stereo]", ("rotation", "translation_m", "baseline_m"), problems)
    rotation_rad, translation_m = _rotation(stereo, problems), _translation(stereo, problems)
    return StereoCalibration(*grid, left, right, rotation_rad, translation_m)


def _check_keys(table: Mapping[str, Any], where: str, known: Iterable[str], problems: list[str]) -> None:
    unknown = sorted(set(table) - set(known))
    problems.extend(f"{where} has {key!r}, expected only {', '.join(known)}" for key in unknown)


def _table(file: Mapping[str, Any], name: str, problems: list[str]) -> Mapping[str, Any] | None:
    if not isinstance(file.get(name), dict):
        problems.append(f"table [{name}] is missing")
        return None
    return dict(file[name])


def _side(file: Mapping[str, Any], key: str, asked: int, problems: list[str]) -> int:
    side = file.get(key, asked)
    if isinstance(side, bool) or not isinstance(side, int) or not _GRID_SIDE.low <= side <= _GRID_SIDE.high:
        problems.append(f"{key} is {side!r}, expected a whole number of pixels from 16 to 16384")
        return asked
    return side


def _toml_lens(table: Mapping[str, Any] | None, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
    if table is None:
        return Lens(math.nan, math.nan, math.nan, math.nan, (math.nan,) * 5)
    _check_keys(table, f"[{name}]", ("K", *_PINHOLE_KEYS, "distortion"), problems)
    pinhole = _pinhole_from_K(table, name, problems) if "K" in table else table
    ranges = (FOCAL, FOCAL, principal_range(grid[0]), principal_range(grid[1]))
    values = {}
    for key, allowed in zip(_PINHOLE_KEYS, ranges, strict=True):
        if key in pinhole:
            values[key] = number(pinhole[key], f"[{name}] {key}", allowed, problems)
        elif "K" not in table:
            problems.append(f"[{name}] has no {key} and no K, expected {allowed}")
    if "distortion" not in table:
        problems.append(f"[{name}] has no distortion, expected [k1, k2, p1, p2] or [k1, k2, p1, p2, k3]")
    terms = numbers(table.get("distortion", [0.0] * 5), f"[{name}] distortion", (4, 5), TERM, problems)
    k1, k2, p1, p2, k3 = (*terms, 0.0)[:5]
    fx, fy, cx, cy = (values.get(key, math.nan) for key in _PINHOLE_KEYS)
    return Lens(fx, fy, cx, cy, (k1, k2, p1, p2, k3))


def _pinhole_from_K(table: Mapping[str, Any], name: str, problems: list[str]) -> Mapping[str, Any]:
    twice = [key for key in _PINHOLE_KEYS if key in table]
    if twice:
        problems.append(f"[{name}] has K and also {', '.join(twice)}, expected one or the other")
    K = table["K"]
    if not _is_three_by_three(K):
        problems.append(f"[{name}] K is {K!r}, expected three rows of three numbers")
        return {}
    if [K[0][1], K[1][0], *K[2]] != [0, 0, 0, 0, 1]:
        problems.append(f"[{name}] K is {K!r}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    return {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}


def _rotation(stereo: Mapping[str, Any], problems: list[str]) -> tuple[float, float, float]:
    unknown, where = (math.nan,) * 3, "[stereo] rotation"
    if "rotation" not in stereo:
        problems.append(f"{where} is missing, expected a Rodrigues vector in radians or a 3 x 3 matrix")
        return unknown
    raw = stereo["rotation"]
    if not _is_three_by_three(raw):
        x, y, z = numbers(raw, where, (3,), ANGLE, problems)
        return x, y, z
    before = len(problems)
    rotation = np.array([numbers(row, f"{where}[{n}]", (3,), _ENTRY, problems) for n, row in enumerate(raw)])
    if len(problems) > before:
        return unknown
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGIDITY or np.linalg.det(rotation) < 0:
        problems.append(f"{where} is {raw!r}, expected a rotation: rows of length 1 at right angles, no mirror")
        return unknown
    cosine = (float(np.trace(rotation)) - 1.0) / 2
    number(math.acos(max(-1.0, min(1.0, cosine))), f"{where}'s angle", ANGLE, problems)
    x, y, z = rotation_vector(rotation).tolist()
    return x, y, z


def _translation(stereo: Mapping[str, Any], problems: list[str]) -> tuple[float, float, float]:
    if ("translation_m" in stereo) == ("baseline_m" in stereo):
        problems.append("[stereo] has both or none of translation_m and baseline_m, expected one of them")
        return (math.nan,) * 3
    if "baseline_m" in stereo:
        return -number(stereo["baseline_m"], "[stereo] baseline_m", BASELINE_M, problems), 0.0, 0.0
    x, y, z = numbers(stereo["translation_m"], "[stereo] translation_m", (3,), OFFSET_M, problems)
    number(-x, "[stereo] translation_m[0], with its sign changed,", BASELINE_M, problems)
    return x, y, z


def _is_three_by_three(raw: object) -> bool:
    return isinstance(raw, list) and [isinstance(row, list) and len(row) for row in raw] == [3, 3, 3]
