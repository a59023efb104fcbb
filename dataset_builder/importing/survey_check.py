"""Comparison of the steel of imported views with the surveyed bars, and the mistakes that it reveals."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, product
from operator import itemgetter
from typing import Any

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.importing.import_layout import Layout
from rebar_depth_bench.bar_crossings.axis_segments import nearest_points
from rebar_depth_bench.base.errors import EntryError, Problem
from rebar_depth_bench.base.validation import UNITS_M
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.cameras import swap_camera_axes, undistort
from rebar_depth_bench.scoring.protocol import interior

_MAX_POINTS = 20_000
"""About the largest number of pixels that are compared, spread over the views and the bars of each."""
_MAX_TRIED_POINTS = 2_000
_MAX_PAIRS = 1_000_000
_TRUSTED_SHARE = 0.95
"""Share of the deviations that count, the smallest ones: a survey and a segmentation have outliers."""
_MAX_LINES = 20


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


_Change = tuple[str, Callable[[_Pixels], _Pixels]]
"""Changed line of the layout, and the pixels as they are read with it."""


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
        """Add pixels of a view: for each bar, those in the interior of the steel if there are any.

        Raises ``EntryError`` for a lens model that cannot be inverted at one of them.
        """
        if not self.bars or "left_bars" not in columns:
            return
        ids, depth_m, K = columns["left_bars"].ravel(), columns["left_depth"].ravel(), columns["left_K"]
        inside = interior(columns["left_mask"]).ravel()
        place = {bar.bar_id: k for k, bar in enumerate(self.bars)}
        usable = np.flatnonzero(np.isin(ids, list(place)) & (depth_m > 0))
        usable = usable[np.argsort(ids[usable], kind="stable")]
        of_bars = np.split(usable, np.flatnonzero(np.diff(ids[usable])) + 1)
        limit, chosen = max(1, _MAX_POINTS // (self.views * len(of_bars))), []
        for pixels in of_bars:
            inner = pixels[inside[pixels]]
            pixels = inner if len(inner) else pixels
            chosen.append(pixels[np.linspace(0, len(pixels) - 1, min(limit, len(pixels))).astype(np.intp)])
        pixels = np.concatenate(chosen)
        row, column = np.divmod(pixels, columns["left_bars"].shape[1])
        plane = np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]], axis=-1)
        try:
            rays = np.insert(undistort(plane, columns["left_distortion"]), 2, 1.0, axis=-1)
        except ValueError as error:
            raise EntryError(Problem("invalid", "K", str(error), "a lens that sees every pixel")) from None
        poses = np.broadcast_to(columns["left_cam_from_world"], (len(pixels), 4, 4))
        bars = np.array([place[bar_id] for bar_id in ids[pixels].tolist()], dtype=np.int64)
        self.parts.append(_Pixels(depth_m[pixels].astype(np.float64), rays, poses, bars))

    def pixels(self) -> _Pixels:
        """Return the pixels of all views; there may be none."""
        parts = [*self.parts, _Pixels(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 4, 4)), np.zeros(0, np.int64))]
        return _Pixels(*(np.concatenate([vars(part)[name] for part in parts]) for name in vars(parts[0])))

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
            numbers = f"offset ({offset}) mm, scale {scale:.5g}, RMS {1000 * _rms(residual_m):.3g} mm"
            lines.append(f"  bar {self.bars[k].bar_id}: {len(residual_m)} points, {numbers}")
        return lines + ([f"  and {len(seen) - _MAX_LINES} more"] if len(seen) > _MAX_LINES else [])

    def mistake(self) -> Problem | None:
        """Return the mistake of the layout that explains the deviations, if their RMS exceeds ``truth_sigma_m``.

        It is the changed line that leaves the smallest RMS, at most half of that found. Two lines are named if
        they leave at most half of that again. The median has to fall too, since outliers alone are no evidence.
        """
        pixels, sigma_m = self.pixels(), self.layout.truth_sigma_m
        pixels = pixels.of(slice(None, None, max(1, len(pixels.bar) // _MAX_TRIED_POINTS)))
        found_m = _deviations(pixels, self.bars)[0]
        groups = list(_changes(self.layout, pixels))
        singles = [(change,) for group in groups for change in group]
        pairs = [pair for two in combinations(groups, 2) for pair in product(*two)]
        least_m, named = _rms(found_m), ""
        for tried in (singles, pairs):
            if least_m <= sigma_m:
                break
            left = [(_deviations(_changed(pixels, changes), self.bars)[0], changes) for changes in tried]
            better = [(_rms(left_m), one) for left_m, one in left if _median(left_m) < _median(found_m)]
            left_rms_m, changes = min(better, key=itemgetter(0), default=(np.inf, ()))
            if left_rms_m <= least_m / 2:
                least_m, named = left_rms_m, " and ".join(line for line, _ in changes)
        if not named:
            return None
        found = f"the points of surveyed bars are {_rms(found_m):.3g} m off their surfaces (RMS)"
        return Problem(
            "conflict", "", f"{found}, and {least_m:.3g} m if read with {named}", f"{named} in the layout"
        )


def _changes(layout: Layout, pixels: _Pixels) -> Iterator[list[_Change]]:
    """Yield the alternatives that are tried, in groups: unit of depth, its kind, the poses, and their unit."""
    depth, poses, length = layout.depth, layout.poses, np.linalg.norm(pixels.ray, axis=1)

    def scaled(factor: float | ndarray) -> Callable[[_Pixels], _Pixels]:
        return lambda one: replace(one, depth_m=one.depth_m * factor)

    def posed(change: Callable[[ndarray], ndarray]) -> Callable[[_Pixels], _Pixels]:
        return lambda one: replace(one, cam_from_world=change(one.cam_from_world))

    def inverse(pose: ndarray) -> ndarray:
        is_turned = poses is not None and poses.axes == "opengl"
        return swap_camera_axes(np.linalg.inv(swap_camera_axes(pose))) if is_turned else np.linalg.inv(pose)

    if depth.kind != "disparity":
        in_place = "" if depth.scale is None else " in place of depth.scale"
        units = {unit: factor / depth.factor for unit, factor in UNITS_M.items() if factor != depth.factor}
        yield [(f'depth.unit = "{unit}"{in_place}', scaled(ratio)) for unit, ratio in units.items()]
        yield [
            ('depth.kind = "range"', scaled(1 / length))
            if depth.kind == "z"
            else ('depth.kind = "z"', scaled(length))
        ]
    kind, axes = "poses inverted", "camera axes turned"
    if poses is not None:
        kind = f'poses.kind = "{"world_from_cam" if poses.kind == "cam_from_world" else "cam_from_world"}"'
        axes = f'poses.axes = "{"opengl" if poses.axes == "opencv" else "opencv"}"'
    both = posed(lambda pose: swap_camera_axes(inverse(pose)))
    yield [(kind, posed(inverse)), (axes, posed(swap_camera_axes)), (f"{kind} and {axes}", both)]
    if poses is not None:
        units = {unit: factor / UNITS_M[poses.unit] for unit, factor in UNITS_M.items() if unit != poses.unit}
        columns = {unit: np.array([[1, 1, 1, ratio]] * 3 + [[1] * 4]) for unit, ratio in units.items()}
        yield [(f'poses.unit = "{unit}"', posed(partial(np.multiply, one))) for unit, one in columns.items()]


def _changed(pixels: _Pixels, changes: Sequence[_Change]) -> _Pixels:
    for _, change in changes:
        pixels = change(pixels)
    return pixels


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
