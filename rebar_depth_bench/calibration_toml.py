"""A stereo calibration in TOML; ``calibration.read_calibration`` shows the layout."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rebar_depth_bench.calibration_values import (
    ANGLE,
    BASELINE_M,
    FOCAL,
    OFFSET_M,
    TERM,
    Range,
    number,
    numbers,
    principal_range,
)
from rebar_depth_bench.cameras import rotation_vector
from rebar_depth_bench.lenses import Lens, StereoCalibration

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
    left, right = (_lens(_table(file, eye, problems), eye, grid, problems) for eye in ("left", "right"))
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


def _lens(table: Mapping[str, Any] | None, name: str, grid: tuple[int, int], problems: list[str]) -> Lens:
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
