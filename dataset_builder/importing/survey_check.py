"""Surveyed bars: their CSV file, and the comparison with the steel of imported views, which reveals mistakes."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from operator import itemgetter
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
from rebar_depth_bench.base.validation import UNITS_M
from rebar_depth_bench.captures.fields import plain_key
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import swap_camera_axes, undistort
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

    Each line is a point of an axis, in order. Commas, semicolons or tabs are between the columns; beside the
    latter two, numbers may have decimal commas. Raises ``InputError`` with the first problems and their lines.
    """
    content = read_file(path, TABLE_BYTES, "a CSV file of bars", InputError)
    text, problems = decode_text(content)
    rows = [] if problems else _rows(text, problems)
    bars = () if problems else _bars(rows, problems)
    if not problems and not bars:
        problems.append(Problem("missing", "", "has no bars", "one or more"))
    if problems:
        raise InputError.from_problems(path, problems)
    return bars


def _rows(text: str, problems: list[Problem]) -> list[tuple[int, dict[str, str]]]:
    """Return the number of each line and its cells by column; problems are added to ``problems``."""
    lines = text.splitlines()
    # Excel states the delimiter in a line before the header.
    first = next((n for n, line in enumerate(lines) if line.strip() and not line.lower().startswith("sep=")), 0)
    header = lines[first] if lines else ""
    delimiter = max(_DELIMITERS, key=header.count)
    reader = csv.reader(lines[first:], delimiter=delimiter, skipinitialspace=True, strict=True)
    try:
        read = [(first + reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        problems.append(Problem("syntax", "", f"line {first + reader.line_num}: {error}", "a CSV file"))
        return []
    names = [_COLUMNS.get(plain_key(name), "") for name in read[0][1]] if read else []
    if wrong := [name for name in _NUMBERS if names.count(name) != 1]:
        found = f"line {first + 1} is {escape_text(header)}, without one {', one '.join(wrong)}"
        problems.append(Problem("missing", "", found, _HEADER))
        return []
    read = [(number, cells) for number, cells in read[1:] if any(cells)]
    for number, cells in read:
        if len(problems) < _MAX_PROBLEMS and (len(cells) < len(names) or any(cells[len(names) :])):
            expected = f"{len(names)} as in the header; decimal commas need semicolons or tabs between the columns"
            problems.append(Problem("invalid", "", f"line {number} has {len(cells)} cells", expected))
    rows = [(number, dict(zip(names, cells, strict=False))) for number, cells in read]
    if delimiter != "," and not problems:
        numbers = [row[name] for _, row in rows for name in _NUMBERS[1:]]
        if any("," in cell for cell in numbers) and any("." in cell for cell in numbers):
            problems.append(Problem("conflict", "", "has numbers with commas and with points", "decimal points"))
        for _, row in rows:
            row |= {name: row[name].replace(",", ".") for name in _NUMBERS[1:]}
    return rows


def _bars(rows: Sequence[tuple[int, Mapping[str, str]]], problems: list[Problem]) -> tuple[Bar, ...]:
    """Return the bars of the lines of a file; problems are added to ``problems``."""
    values = np.array([[parse_number(row[name]) for name in _NUMBERS] for _, row in rows]).reshape(-1, 5)
    ids, sizes = values[:, 0], values[:, 1:]
    is_sound = (ids == np.round(ids)) & (ids >= 1) & (ids <= _MAX_BAR_ID) & np.isfinite(sizes).all(axis=1)
    is_sound &= (sizes[:, 0] > 0) & (sizes[:, 0] <= _MAX_DIAMETER_M)
    is_near = (np.abs(sizes) < _MAX_COORDINATE_M).all(axis=1)
    for k in np.flatnonzero(~(is_sound & is_near))[:_MAX_PROBLEMS].tolist():
        cells = escape_text(", ".join(rows[k][1][name] for name in _NUMBERS))
        expected = _OFFSET if is_sound[k] else _LINE
        problems.append(Problem("invalid", "", f"line {rows[k][0]}: got {cells}", expected))
    if problems or not len(ids):
        return ()
    order = np.argsort(ids, kind="stable")
    return tuple(
        _bar(int(ids[of_bar[0]]), rows[of_bar[0]][1].get(_ROLE, _DEFAULT_ROLE), sizes[of_bar], problems)
        for of_bar in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1)
    )


def _bar(bar_id: int, role: str, sizes: Float64[ndarray, "n 4"], problems: list[Problem]) -> Bar:
    """Return a bar of the diameter and the points in ``sizes``; problems are added to ``problems``."""
    diameters_m, axis_m = sizes[:, 0], sizes[:, 1:]
    if len(set(diameters_m.tolist())) > 1:
        problems.append(Problem("conflict", f"bar {bar_id}", "has several diameters", "one"))
    if len(axis_m) < 2 or not np.diff(axis_m, axis=0).any(axis=1).all():
        problems.append(
            Problem("invalid", f"bar {bar_id}", f"has {len(axis_m)} points", "two or more, no two the same")
        )
    if re.search(r"[\x00-\x1f\x7f-\x9f]", role):
        problems.append(Problem("invalid", f"bar {bar_id}", f"has the role {escape_text(role)}", "printable text"))
    points = tuple((float(x), float(y), float(z)) for x, y, z in axis_m)
    return Bar(bar_id, role, float(diameters_m[0]), points)


# Comparison with the steel of imported views.

_MAX_POINTS = 20_000
"""About the largest number of pixels that are compared, spread over the views and the bars of each."""
_MAX_TRIED_POINTS = 2_000
_MAX_PAIRS = 1_000_000
_TRUSTED_SHARE = 0.95
"""Share of the deviations that count, the smallest ones: a survey and a segmentation have outliers."""
_MAX_LINES = 20
_RATIOS = (0.001, 0.01, 0.0254, 0.1, 0.3048, 10.0, 100.0, 1000.0)


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels on bars: planar depth (metres), ray (x, y, 1), ``cam_from_world``, and position of the bar."""

    depth_m: Float64[ndarray, " n"]
    ray: Float64[ndarray, "n 3"]
    cam_from_world: Float64[ndarray, "n 4 4"]
    bar: Int64[ndarray, " n"]

    def of(self, rows: ndarray | slice) -> _Pixels:
        """Return some of the pixels."""
        return _Pixels(*(values[rows] for values in vars(self).values()))


@dataclass
class SurveyCheck:
    """Steel pixels of the left images of ``views`` views, compared with the surfaces of the surveyed ``bars``.

    An RMS is that of the smallest ``_TRUSTED_SHARE`` of the deviations.
    """

    layout: Layout
    bars: tuple[Bar, ...]
    views: int
    parts: list[_Pixels] = field(default_factory=list)

    def add(self, columns: Mapping[str, Any]) -> None:
        """Add pixels of a view: for each bar, those in the interior of the steel if there are any."""
        if not self.bars or "left_bars" not in columns:
            return
        ids, depth_m = columns["left_bars"], columns["left_depth"]
        place = {bar.bar_id: k for k, bar in enumerate(self.bars)}
        usable, inside = np.isin(ids, list(place)) & (depth_m > 0), interior(columns["left_mask"])
        usable &= inside | ~np.isin(ids, ids[usable & inside])
        row, column = np.nonzero(usable)
        order = np.argsort(ids[row, column], kind="stable")
        of_bars = np.split(order, np.flatnonzero(np.diff(ids[row, column][order])) + 1)
        limit = max(1, _MAX_POINTS // (self.views * len(of_bars)))
        chosen = np.concatenate([pixels[:: max(1, -(-len(pixels) // limit))] for pixels in of_bars])
        at, K = (row[chosen], column[chosen]), columns["left_K"]
        plane = np.stack([(at[1] - K[0, 2]) / K[0, 0], (at[0] - K[1, 2]) / K[1, 1]], axis=-1)
        rays = np.insert(undistort(plane, columns["left_distortion"]), 2, 1.0, axis=-1)
        poses = np.broadcast_to(columns["left_cam_from_world"], (len(chosen), 4, 4))
        bars = np.array([place[bar_id] for bar_id in ids[at].tolist()], dtype=np.int64)
        self.parts.append(_Pixels(depth_m[at].astype(np.float64), rays, poses, bars))

    def pixels(self) -> _Pixels:
        """Return the pixels of all views; there may be none."""
        parts = [*self.parts, _Pixels(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4, 4)), np.zeros(0, np.int64))]
        return _Pixels(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))

    def lines(self) -> list[str]:
        """Return the lines of the summary: how far the points of each bar are off its surface.

        Offset (world) and scale of depth are those that alone explain the deviations best, by least squares.
        """
        pixels = self.pixels()
        seen = np.unique(pixels.bar).tolist()
        if not seen:
            has_ids = self.layout.files.left_bars is not None
            reason = "left_bars show none with depth" if self.bars and has_ids else "it needs [bars] and left_bars"
            return [f"compared with no surveyed bar ({reason}): wrong units, axes or poses would not show"]
        lines = [f"{len(seen)} of {len(self.bars)} surveyed bars are seen; their points against their surfaces:"]
        for k in seen[:_MAX_LINES]:
            of_bar = pixels.of(pixels.bar == k)
            residual_m, normal, from_camera_m = _deviations(of_bar, self.bars)
            trusted = _trusted(residual_m)
            offset_mm = 1000 * np.linalg.lstsq(normal[trusted], residual_m[trusted], rcond=0.05)[0]
            radial_m = (normal * from_camera_m).sum(axis=1)[trusted]
            with np.errstate(divide="ignore", invalid="ignore"):
                scale = 1 / (1 - np.divide(residual_m[trusted] @ radial_m, radial_m @ radial_m))
            offset = ", ".join(f"{value + 0.0:.1f}" for value in np.round(offset_mm, 1))
            spread_mm = _rms(1000 * residual_m - normal @ offset_mm)
            numbers = (
                f"offset ({offset}) mm, scale {scale:.5g}, RMS {1000 * _rms(residual_m):.3g} mm, "
                f"{spread_mm:.3g} mm without the offset"
            )
            lines.append(f"  bar {self.bars[k].bar_id}: {len(residual_m)} points, {numbers}")
        return lines + ([f"  and {len(seen) - _MAX_LINES} more"] if len(seen) > _MAX_LINES else [])

    def mistake(self) -> Problem | None:
        """Return the mistake of the layout that explains the deviations, if their RMS exceeds ``truth_sigma_m``.

        It is the changed line that leaves the smallest RMS, at most half of that found. The median has to fall
        too, since outliers alone are no evidence.
        """
        pixels = self.pixels()
        pixels = pixels.of(slice(None, None, max(1, len(pixels.bar) // _MAX_TRIED_POINTS)))
        found_m = _deviations(pixels, self.bars)[0]
        if _rms(found_m) <= self.layout.truth_sigma_m:
            return None
        tried = [(line, _deviations(changed, self.bars)[0]) for line, changed in _mistakes(self.layout, pixels)]
        better = [(_rms(left_m), line) for line, left_m in tried if _median(left_m) < _median(found_m)]
        left_rms_m, line = min(better, key=itemgetter(0), default=(np.inf, ""))
        if left_rms_m > _rms(found_m) / 2:
            return None
        found = f"the points of surveyed bars are {_rms(found_m):.3g} m off their surfaces (RMS)"
        found += f", and {left_rms_m:.3g} m if read with {line}"
        return Problem("conflict", "", found, f"{line} in {self.layout.views or 'the layout'}")


def _mistakes(layout: Layout, pixels: _Pixels) -> Iterator[tuple[str, _Pixels]]:
    """Yield changed lines of the layout, and the pixels as they are read with each."""
    depth, poses, length = layout.depth, layout.poses, np.linalg.norm(pixels.ray, axis=1)
    if depth.kind != "disparity":
        in_place = "" if depth.scale is None else " in place of depth.scale"
        units = {f'depth.unit = "{unit}"{in_place}': size_m / depth.factor for unit, size_m in UNITS_M.items()}
        if layout.views is not None:  # It may state the unit, such as that of BOP in metres by mistake.
            units = {f"a unit of depth that is {ratio:g} times as large": ratio for ratio in _RATIOS}
        for line, ratio in units.items():
            yield line, replace(pixels, depth_m=pixels.depth_m * ratio)
        kind, factors = ("range", 1 / length) if depth.kind == "z" else ("z", length)
        yield f'depth.kind = "{kind}"', replace(pixels, depth_m=pixels.depth_m * factors)
    found, is_opengl = pixels.cam_from_world, poses is not None and poses.axes == "opengl"
    turned = swap_camera_axes(found)
    inverted = np.linalg.inv(turned if is_opengl else found)  # The poses in the axes of the files.
    both = swap_camera_axes(inverted)
    if is_opengl:
        inverted, both = both, inverted
    kind, axes, changes = "poses inverted", "camera axes turned", dict[str, ndarray]()
    if poses is not None:
        kind = f'poses.kind = "{"world_from_cam" if poses.kind == "cam_from_world" else "cam_from_world"}"'
        axes = f'poses.axes = "{"opencv" if is_opengl else "opengl"}"'
        for unit, factor_m in UNITS_M.items():
            scales = np.array([1, 1, 1, factor_m / UNITS_M[poses.unit]])
            changes[f'poses.unit = "{unit}"'] = found * np.vstack([[scales] * 3, np.ones(4)])
    changes |= {kind: inverted, axes: turned, f"{kind} and {axes}": both}
    for line, pose in changes.items():
        yield line, replace(pixels, cam_from_world=pose)


def _deviations(
    pixels: _Pixels, bars: tuple[Bar, ...]
) -> tuple[Float64[ndarray, " n"], Float64[ndarray, "n 3"], Float64[ndarray, "n 3"]]:
    """Return how far each point is outside its bar, the direction, and its vector from the camera, metres."""
    rotation, moved_m = pixels.cam_from_world[:, :3, :3], pixels.cam_from_world[:, :3, 3]
    from_camera_m = np.einsum("nji,nj->ni", rotation, pixels.ray * pixels.depth_m[:, None])
    points_m = from_camera_m - np.einsum("nji,nj->ni", rotation, moved_m)
    residual_m, normal = np.zeros(len(points_m)), np.zeros_like(points_m)
    for k in np.unique(pixels.bar).tolist():
        axis_m, rows = np.array(bars[k].axis_m), np.flatnonzero(pixels.bar == k)
        for part in np.array_split(rows, -(-len(rows) * len(axis_m) // _MAX_PAIRS)):
            nearest_m, _, distance_m = nearest_points(points_m[part, None], axis_m[:-1], np.diff(axis_m, axis=0))
            away_m = points_m[part] - nearest_m[np.arange(len(part)), distance_m.argmin(axis=1)]
            length_m = np.linalg.norm(away_m, axis=1)
            residual_m[part] = length_m - bars[k].diameter_m / 2
            normal[part] = away_m / np.maximum(length_m, 1e-300)[:, None]
    return residual_m, normal, from_camera_m


def _trusted(residual_m: Float64[ndarray, " n"]) -> Int64[ndarray, " m"]:
    """Return the positions of the deviations that count."""
    return np.argsort(np.abs(residual_m), kind="stable")[: max(1, int(_TRUSTED_SHARE * len(residual_m)))]


def _rms(residual_m: Float64[ndarray, " n"]) -> float:
    """Return the root of the mean square of the deviations that count; 0 without any."""
    return float(np.linalg.norm(residual_m[_trusted(residual_m)]) / np.sqrt(max(1, len(_trusted(residual_m)))))


def _median(residual_m: Float64[ndarray, " n"]) -> float:
    return float(np.median(np.abs(residual_m)))
