"""Surveyed bars: their CSV file, and the comparison with the steel of imported views."""

from __future__ import annotations

import csv
import math
import re
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.importing.import_layout import Layout
from rebar_depth_bench.bar_crossings.axis_segments import nearest_points
from rebar_depth_bench.base.errors import InputError, Problem, escape_text
from rebar_depth_bench.base.limits import TABLE_BYTES
from rebar_depth_bench.base.reading import decode_text, parse_number, read_file
from rebar_depth_bench.captures.fields import plain_key
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import undistort
from rebar_depth_bench.scoring.protocol import interior

# The points of the axes of bars in a CSV file, as surveyors and spreadsheets write it.

_NUMBERS = ("bar_id", "diameter_m", "x_m", "y_m", "z_m")
_ROLE, _DEFAULT_ROLE = "role", "surveyed"
_COLUMNS = {plain_key(name): name for name in (*_NUMBERS, _ROLE)}
_DELIMITERS = ",;\t"
_MAX_PROBLEMS = 100
_MAX_BAR_ID = np.iinfo(np.uint16).max
_MAX_DIAMETER_M = 0.5
_MAX_COORDINATE_M = 1e6
_HEADER = f"the columns {', '.join(_NUMBERS)}, lengths in metres, between commas, semicolons or tabs"
_LINE = f"a bar_id from 1 to {_MAX_BAR_ID}, a diameter up to {_MAX_DIAMETER_M} m, and numbers with decimal points"
_OFFSET = (
    f"less than {_MAX_COORDINATE_M:g} m: subtract one offset from all points of this file and from all camera"
    " centres of the poses (of a pose cam_from_world with R and t, add R times the offset to t)"
)


def read_bars_file(path: Path) -> tuple[Bar, ...]:
    """Return the bars of a CSV file with the columns bar_id, diameter_m, x_m, y_m, z_m and, if wanted, role.

    Each line is a point of an axis, in order. Commas, semicolons or tabs are between the columns. Raises
    ``InputError`` with the first problems and their lines.
    """
    text, problems = decode_text(read_file(path, TABLE_BYTES, "a CSV file of bars", InputError))
    if problems:
        raise InputError.from_problems(path, problems)
    lines = text.splitlines()
    # Excel states the delimiter in a line before the header.
    first = next((n for n, line in enumerate(lines) if line.strip() and not line.lower().startswith("sep=")), 0)
    header = lines[first] if lines else ""
    delimiter = max(_DELIMITERS, key=header.count)
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        rows = [(first + reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        problem = Problem("syntax", "", f"line {first + reader.line_num}: {error}", "a CSV file")
        raise InputError.from_problems(path, [problem]) from None
    names = [_COLUMNS.get(plain_key(name), "") for name in rows[0][1]] if rows else []
    if wrong := [name for name in _NUMBERS if names.count(name) != 1]:
        found = f"line {first + 1} is {escape_text(header)}, without one {', one '.join(wrong)}"
        raise InputError.from_problems(path, [Problem("missing", "", found, _HEADER)])

    sizes_by_bar, roles = defaultdict[int, list[list[float]]](list), dict[int, str]()
    for number, cells in rows[1:]:
        if not any(cells) or len(problems) == _MAX_PROBLEMS:
            continue
        if len(cells) < len(names) or any(cells[len(names) :]):
            expected = f"{len(names)} as in the header, and numbers with decimal points"
            problems.append(Problem("invalid", "", f"line {number} has {len(cells)} cells", expected))
            continue
        row = dict(zip(names, cells, strict=False))
        bar_id, *sizes = (parse_number(row[name]) for name in _NUMBERS)
        is_sound = 1 <= bar_id <= _MAX_BAR_ID and bar_id == round(bar_id) and 0 < sizes[0] <= _MAX_DIAMETER_M
        if not is_sound or not all(abs(size) < _MAX_COORDINATE_M for size in sizes):
            found = f"line {number}: got {escape_text(', '.join(row[name] for name in _NUMBERS))}"
            is_far = is_sound and all(map(math.isfinite, sizes))
            problems.append(Problem("invalid", "", found, _OFFSET if is_far else _LINE))
            continue
        sizes_by_bar[int(bar_id)].append(sizes)
        roles.setdefault(int(bar_id), row.get(_ROLE, _DEFAULT_ROLE))
    if not sizes_by_bar and not problems:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    bars = []
    for bar_id, of_bar in sorted(sizes_by_bar.items()):
        points, role = [(x, y, z) for _, x, y, z in of_bar], roles[bar_id]
        if len({diameter_m for diameter_m, *_ in of_bar}) > 1:
            problems.append(Problem("conflict", f"bar {bar_id}", "has several diameters", "one"))
        if len(points) < 2 or any(one == other for one, other in pairwise(points)):
            found = f"has {len(points)} points"
            problems.append(Problem("invalid", f"bar {bar_id}", found, "two or more, no two the same"))
        if re.search(r"[\x00-\x1f\x7f-\x9f]", role):
            found = f"has the role {escape_text(role)}"
            problems.append(Problem("invalid", f"bar {bar_id}", found, "printable text"))
        bars.append(Bar(bar_id, role, of_bar[0][0], tuple(points)))
    if problems:
        raise InputError.from_problems(path, problems)
    return tuple(bars)


# Comparison with the steel of imported views.

_MAX_POINTS = 20_000
"""About the largest number of pixels that are compared, spread over the views and the bars of each."""
_MAX_PAIRS = 1_000_000
_TRUSTED_SHARE = 0.95
"""Share of the deviations that count, the smallest ones: a survey and a segmentation have outliers."""
_MAX_LINES = 20


@dataclass
class SurveyCheck:
    """Steel pixels of the left images of ``views`` views, compared with the surfaces of the surveyed ``bars``.

    ``parts`` has the bar ids of the pixels of each view, their points in the world and their vectors from the
    camera, metres. An RMS is taken over the smallest ``_TRUSTED_SHARE`` of the deviations.
    """

    layout: Layout
    bars: tuple[Bar, ...]
    views: int
    parts: list[tuple[ndarray, ndarray, ndarray]] = field(default_factory=list)

    def add(self, columns: Mapping[str, Any]) -> None:
        """Add pixels of a view: for each bar, those in the interior of the steel if there are any."""
        if not self.bars or "left_bars" not in columns:
            return
        ids, depth_m = columns["left_bars"], columns["left_depth"]
        usable = np.isin(ids, [bar.bar_id for bar in self.bars]) & (depth_m > 0)
        inside = interior(columns["left_mask"])
        usable &= inside | ~np.isin(ids, ids[usable & inside])
        row, column = np.nonzero(usable)
        order = np.argsort(ids[row, column], kind="stable")
        of_bars = np.split(order, np.flatnonzero(np.diff(ids[row, column][order])) + 1)
        limit = max(1, _MAX_POINTS // (self.views * len(of_bars)))
        chosen = np.concatenate([pixels[:: max(1, -(-len(pixels) // limit))] for pixels in of_bars])
        at, K = (row[chosen], column[chosen]), columns["left_K"]
        plane = np.stack([(at[1] - K[0, 2]) / K[0, 0], (at[0] - K[1, 2]) / K[1, 1]], axis=-1)
        rays = np.insert(undistort(plane, columns["left_distortion"]), 2, 1.0, axis=-1)
        rotation, moved_m = columns["left_cam_from_world"][:3, :3], columns["left_cam_from_world"][:3, 3]
        from_camera_m = (rays * depth_m[at].astype(np.float64)[:, None]) @ rotation
        self.parts.append((ids[at], from_camera_m - moved_m @ rotation, from_camera_m))

    def findings(self) -> tuple[list[str], list[str]]:
        """Return how far the points of each bar are off its surface, and a note if that is past ``truth_sigma_m``.

        Offset (world) and scale of depth are those that alone explain the deviations best, by least squares.
        """
        seen = {bar_id for ids, _, _ in self.parts for bar_id in ids.tolist()}
        if not seen:
            has_ids = self.layout.files.left_bars is not None
            reason = "left_bars show none with depth" if self.bars and has_ids else "it needs [bars] and left_bars"
            return [f"compared with no surveyed bar ({reason}): wrong units, axes or poses would not show"], []
        ids, points_m, from_camera_m = map(np.concatenate, zip(*self.parts, strict=True))
        lines = [f"{len(seen)} of {len(self.bars)} surveyed bars are seen; their points against their surfaces:"]
        residuals_m = []
        for bar in (bar for bar in self.bars if bar.bar_id in seen):
            of_bar = ids == bar.bar_id
            residual_m, normal = _deviations(points_m[of_bar], bar)
            trusted = _trusted(residual_m)
            offset_mm = 1000 * np.linalg.lstsq(normal[trusted], residual_m[trusted], rcond=0.05)[0]
            radial_m = (normal * from_camera_m[of_bar]).sum(axis=1)[trusted]
            with np.errstate(divide="ignore", invalid="ignore"):
                scale = 1 / (1 - np.divide(residual_m[trusted] @ radial_m, radial_m @ radial_m))
            offset = ", ".join(f"{value + 0.0:.1f}" for value in np.round(offset_mm, 1))
            spread_mm = _rms(1000 * residual_m - normal @ offset_mm)
            numbers = (
                f"offset ({offset}) mm, scale {scale:.5g}, RMS {1000 * _rms(residual_m):.3g} mm, "
                f"{spread_mm:.3g} mm without the offset"
            )
            lines.append(f"  bar {bar.bar_id}: {len(residual_m)} points, {numbers}")
            residuals_m.append(residual_m)
        if len(seen) > _MAX_LINES:
            lines[1 + _MAX_LINES :] = [f"  and {len(seen) - _MAX_LINES} more"]
        rms_m, sigma_m = _rms(np.concatenate(residuals_m)), self.layout.truth_sigma_m
        note = (
            f"the points of surveyed bars are {rms_m:.3g} m off their surfaces (RMS), expected truth_sigma_m, "
            f"{sigma_m:g} m, or less; check unit and kind of the depth, and unit, kind and axes of the poses"
        )
        return lines, [note] if rms_m > sigma_m else []


def _deviations(
    points_m: Float64[ndarray, "n 3"], bar: Bar
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, "n 3"]]:
    """Return how far each point is outside a bar, metres, and the direction."""
    residual_m, normal, axis_m = np.zeros(len(points_m)), np.zeros_like(points_m), np.array(bar.axis_m)
    for part in np.array_split(np.arange(len(points_m)), -(-len(points_m) * len(axis_m) // _MAX_PAIRS)):
        nearest_m, _, distance_m = nearest_points(points_m[part, None], axis_m[:-1], np.diff(axis_m, axis=0))
        away_m = points_m[part] - nearest_m[np.arange(len(part)), distance_m.argmin(axis=1)]
        length_m = np.linalg.norm(away_m, axis=1)
        residual_m[part] = length_m - bar.diameter_m / 2
        normal[part] = away_m / np.maximum(length_m, 1e-300)[:, None]
    return residual_m, normal


def _trusted(residual_m: Float64[ndarray, " n"]) -> Int64[ndarray, " m"]:
    """Return the positions of the deviations that count."""
    return np.argsort(np.abs(residual_m), kind="stable")[: max(1, int(_TRUSTED_SHARE * len(residual_m)))]


def _rms(residual_m: Float64[ndarray, " n"]) -> float:
    """Return the root of the mean square of the deviations that count; 0 without any."""
    return float(np.linalg.norm(residual_m[_trusted(residual_m)]) / np.sqrt(max(1, len(_trusted(residual_m)))))
