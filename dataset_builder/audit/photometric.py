"""The two colour pictures against each other: the right one, fetched through depth and cameras, fits the left one.

The right picture is read where the left pixels' points project, and at whole-pixel shifts of it along u and v. If
depth, poses, K and pictures belong together, the pictures match best without a shift. Whole-pixel shifts read at
equal fractions of a pixel, so noise and interpolation weigh on all alike, and a parabola through the three best
gives the shift to hundredths of a pixel.

Steel is left out of the verdict where it is seen close: the light and dark sides of a round bar belong to the eye
and not to the bar. Between two eyes they move by about half the angle between the eyes times the bar's radius.
So is what lies within three pixels of a jump in depth and is not steel: there a pixel's colour is in part that of
something nearer, which moves otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from dataset_builder.audit.report import Check
from dataset_builder.audit.stereo_consistency import landed_in
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView
from rebar_depth_bench.geometry.cameras import camera_centre

MAX_SHIFT_PX, SHIFT_NOISE_PX = 0.1, 6.0
"""Of all views together: the second over the root of their pixels comes on top. Good renders: under 0.05 px at
1280 x 720, 0.1 px in three noisy views of 160 x 90. Depth 1 % off at 0.35 m is 2 px and 0.25 px there."""
MAX_VIEW_SHIFT_PX = 1.0
SEARCHED_PX = 3
_LEAST_PIXELS, _LEAST_VIEW_PIXELS = 1000, 300
"""With fewer all views together, or a view by itself, are not judged: noise would be."""
_MOST_PIXELS = 20_000
_BLUR_PX = 1.0
"""Both pictures are smoothed by this: the noise of few samples goes, and bilinear reading fits."""
_LEAST_GRADIENT = 4.0
_MOST_DIFFERENCE = 40.0
"""Levels: a highlight that only one eye sees weighs no more than this."""
_SAME_DEPTH = 0.03
_STEADY_PX = 0.05
_JUMP_PX = 0.2
"""Second difference of parallax from pixel to pixel; a plane has none."""
_NEAR_JUMP_PX = 3


@dataclass(frozen=True, eq=False)
class Fit:
    """How a view's pictures fit: ``cost`` of shifts -3 to 3 px along u (row 0) and v (row 1) over ``pixels``.

    ``off_levels`` is the median absolute difference without a shift and ``correlation`` that of the levels, of
    what the verdict rests on and of close steel; not a number where there is none.
    """

    cost: Float64[ndarray, "2 7"]
    pixels: int
    off_levels: tuple[float, float]
    correlation: tuple[float, float]


def view_fit(config: AuditedConfig, view: AuditedView) -> Fit:
    """Return how the right picture of a view fits the left one through ground truth."""
    eyes = (view.left, view.right)
    left_levels, right_levels = (_levels(eye) for eye in eyes)
    baseline_m = float(np.linalg.norm(np.subtract(*(camera_centre(eye.camera.cam_from_world) for eye in eyes))))
    pixels = _textured_pixels(left_levels, view.left, baseline_m)
    landed = landed_in(view.right, view.left.points_m.reshape(-1, 3)[pixels], SEARCHED_PX + 1)
    seen = np.flatnonzero(landed.inside)
    seen = seen[_is_seen(view.right, landed.px[seen], landed.depth_m[seen], view.left.bars.ravel()[pixels[seen]])]
    steady = _is_steady(config, view.left, pixels[seen], baseline_m)
    wanted, found, cost = left_levels.ravel()[pixels[seen]], [], np.zeros((2, 2 * SEARCHED_PX + 1))
    for chosen in (_spread(np.flatnonzero(steady)), _spread(np.flatnonzero(~steady))):
        levels = wanted[chosen]
        there = _read(right_levels, landed.px[seen[chosen]])
        found.append((_median(np.abs(there - levels)), _correlation(there, levels)))
    chosen = _spread(np.flatnonzero(steady))
    for axis in (0, 1):
        for n in range(2 * SEARCHED_PX + 1):
            shift_px = np.zeros(2)
            shift_px[axis] = n - SEARCHED_PX
            off = _read(right_levels, landed.px[seen[chosen]] + shift_px) - wanted[chosen]
            cost[axis, n] = np.minimum(off * off, _MOST_DIFFERENCE**2).sum()
    return Fit(cost, len(chosen), (found[0][0], found[1][0]), (found[0][1], found[1][1]))


def best_shift_px(cost: Float64[ndarray, " n"]) -> float:
    """Return the shift of least cost: the vertex of the parabola through the least value and its neighbours.

    A least value at an end of the searched range is returned as it is, and 0 for costs that are all alike.
    """
    best, middle = int(np.argmin(cost)), len(cost) // 2
    if cost[best] == cost.max():
        return 0.0
    if best in (0, len(cost) - 1):
        return float(best - middle)
    before, here, after = cost[best - 1 : best + 2]
    return float(best - middle + (before - after) / 2 / (before - 2 * here + after))


def photometric_verdict(config: AuditedConfig, fits: Sequence[Fit]) -> Check:
    """Hold the best shift of all views together, and of each by itself, against their bounds."""
    name = f"{config.name}: right colour in left through depth"
    pixels = sum(fit.pixels for fit in fits)
    if pixels < _LEAST_PIXELS:
        return Check(name, f"only {pixels} pixels with texture that both eyes see", "left out")
    u_px, v_px = (best_shift_px(row) for row in np.sum([fit.cost for fit in fits], axis=0))
    judged = [fit for fit in fits if fit.pixels >= _LEAST_VIEW_PIXELS]
    worst_px = max((abs(best_shift_px(row)) for fit in judged for row in fit.cost), default=0.0)
    problems = []
    bound_px = MAX_SHIFT_PX + SHIFT_NOISE_PX / pixels**0.5
    if not max(abs(u_px), abs(v_px)) <= bound_px:
        problems.append(
            f"the right pictures fit best {u_px:+.2f}, {v_px:+.2f} px beside where ground truth puts them"
        )
    if not worst_px <= MAX_VIEW_SHIFT_PX:
        problems.append(f"the pictures of one view fit best {worst_px:.2f} px beside where ground truth puts them")
    surfaces = ("steady surfaces", "close steel")
    told = [
        f"{surface} {_nanmedian([fit.off_levels[n] for fit in fits]):.1f} levels, correlation "
        f"{_nanmedian([fit.correlation[n] for fit in fits]):.2f}"
        for n, surface in enumerate(surfaces)
        if not all(np.isnan(fit.off_levels[n]) for fit in fits)
    ]
    found = f"shift {u_px:+.3f}, {v_px:+.3f} px, one view {worst_px:.2f} px; {'; '.join(told)}"
    bound = f"{bound_px:.2f} px, one view {MAX_VIEW_SHIFT_PX:g} px"
    return Check(name, found, bound, tuple(problems))


def _levels(eye: AuditedEye) -> Float32[ndarray, "h w"]:
    grey = cv2.cvtColor(eye.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX))


def _textured_pixels(levels: Float32[ndarray, "h w"], eye: AuditedEye, baseline_m: float) -> Int64[ndarray, " n"]:
    """Return the flat indices of pixels with depth and some gradient, evenly thinned where they are very many.

    Of what is not steel, those near a jump in depth are left out.
    """
    along_u, along_v = (cv2.Sobel(levels, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    textured = np.hypot(along_u, along_v) >= _LEAST_GRADIENT
    hit = eye.depth_m > 0
    parallax_px = np.divide(eye.camera.K[0, 0] * baseline_m, eye.depth_m, out=np.zeros(hit.shape), where=hit)
    jump = (np.abs(cv2.Laplacian(parallax_px, cv2.CV_64F)) > _JUMP_PX) | eye.mask
    near = np.ones((2 * _NEAR_JUMP_PX + 1,) * 2, dtype=np.uint8)
    near_jump = cv2.dilate(jump.astype(np.uint8), near) > 0
    return _spread(np.flatnonzero(textured & hit & (eye.mask | ~near_jump)), 6)


def _is_seen(
    eye: AuditedEye, px: Float64[ndarray, "n 2"], depth_m: Float64[ndarray, " n"], bars: ndarray
) -> Bool[ndarray, " n"]:
    """Return whether the eye's four pixels round a projection show the same bar, or none, at about its depth."""
    u, v = np.floor(px).astype(int).T
    seen = np.ones(len(px), dtype=bool)
    for dv, du in ((0, 0), (0, 1), (1, 0), (1, 1)):
        seen &= np.abs(eye.depth_m[v + dv, u + du] - depth_m) < _SAME_DEPTH * depth_m
        seen &= eye.bars[v + dv, u + du] == bars
    return seen


def _is_steady(
    config: AuditedConfig, eye: AuditedEye, pixels: Int64[ndarray, " n"], baseline_m: float
) -> Bool[ndarray, " n"]:
    """Return whether a surface looks the same to both eyes: no steel, or a bar so thin and far that its light
    and dark sides move by less than a twentieth of a pixel."""
    radius_of = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in config.steel:
        radius_of[bar.bar_id] = bar.diameter_m / 2
    depth_m = eye.depth_m.ravel()[pixels].astype(np.float64)
    radius_px = radius_of[eye.bars.ravel()[pixels]] * eye.camera.K[0, 0] / depth_m
    return np.asarray(radius_px * baseline_m / depth_m / 2 < _STEADY_PX)


def _read(levels: Float32[ndarray, "h w"], px: Float64[ndarray, "n 2"]) -> Float64[ndarray, " n"]:
    """Read a picture between its pixel centres, bilinearly; all four neighbours lie inside."""
    corner = np.floor(px).astype(int)
    (u, v), (du, dv) = corner.T, (px - corner).T
    above = levels[v, u] * (1 - du) + levels[v, u + 1] * du
    below = levels[v + 1, u] * (1 - du) + levels[v + 1, u + 1] * du
    return np.asarray(above * (1 - dv) + below * dv)


def _spread(values: Int64[ndarray, " n"], times: int = 1) -> Int64[ndarray, " k"]:
    """Return at most ``times`` 20,000 of the values, evenly spread."""
    most = times * _MOST_PIXELS
    return values if len(values) <= most else values[np.linspace(0, len(values) - 1, most).astype(int)]


def _median(values: Float64[ndarray, " n"]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _nanmedian(values: Sequence[float]) -> float:
    return _median(np.array([value for value in values if not np.isnan(value)]))


def _correlation(a: Float64[ndarray, " n"], b: Float64[ndarray, " n"]) -> float:
    if len(a) < 2 or not (np.std(a) > 0 and np.std(b) > 0):
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])
