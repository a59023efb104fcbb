"""Photometric check of pictures: the right one, warped through depth and cameras, against the left one.

The right image is sampled where the points of the left pixels project, and at whole-pixel shifts from there along
u and v. If depth, poses, K and images are consistent, the images match best at zero shift. Whole-pixel shifts all
sample at the same fractions of a pixel, so that noise and interpolation affect all of them equally; a parabola
through the three lowest costs gives the shift to hundredths of a pixel.

Close steel is reported but not checked: the light and dark sides of a round bar depend on the eye's position.
Between two eyes they move by about half the angle between the eyes times the bar's radius. Non-steel pixels within
three pixels of a depth discontinuity are left out: their colour is mixed with that of a nearer surface of another
parallax. So are those near ground so far and low that its depth changes by percents from pixel to pixel: its own
pixels do not pass the test of visibility, and of the edge where a wall or a wood stands on it only one side would
be compared, at different costs for shifts to both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from dataset_builder.audit.checks import AuditedConfig, AuditedEye, AuditedView, Check
from dataset_builder.audit.independent_depth import project_into
from rebar_depth_bench.geometry.cameras import camera_centre

MAX_SHIFT_PX, SHIFT_NOISE_PX = 0.1, 6.0
"""Bound on the shift of all views together: the first plus the second over the square root of the pixel count.

Correct renders give under 0.05 px at 1280 x 720, and 0.1 px in three noisy views of 160 x 90. A depth error of 1 %
at 0.35 m gives 2 px and 0.25 px respectively.
"""
MAX_VIEW_SHIFT_PX = 1.0
"""Largest shift of a single view, pixels."""
SEARCH_RADIUS_PX = 3
"""Largest tested shift along u and v, pixels."""
_MIN_PIXELS, _MIN_VIEW_PIXELS = 1000, 300
"""Least number of pixels to check all views together, and a single view: with fewer, noise dominates."""
_MAX_PIXELS = 20_000
_BLUR_PX = 1.0
"""Standard deviation of the Gaussian blur of both images, pixels.

It removes the noise of low sample counts and makes bilinear interpolation adequate.
"""
_MIN_GRADIENT = 4.0
"""Least gradient of a textured pixel, levels per pixel."""
_MAX_DIFFERENCE_LEVELS = 40.0
"""Clipping limit of the intensity difference, levels: bounds the weight of highlights that only one eye sees."""
_RELATIVE_DEPTH_TOLERANCE = 0.03
_WHOLE_PX = 1e-6
"""Largest difference of a whole coordinate from a whole number, pixels."""
_MAX_SHADING_SHIFT_PX = 0.05
"""Largest shift of a bar's shading between the eyes for the bar to count as view-independent, pixels."""
_DEPTH_JUMP_PX = 0.2
"""Second difference of the parallax that marks a depth discontinuity, pixels; a plane has none."""
_DEPTH_JUMP_MARGIN_PX = 3
"""Distance from a depth discontinuity within which non-steel pixels are left out, pixels."""


@dataclass(frozen=True, eq=False)
class PhotometricFit:
    """Photometric match of the two images of a view.

    ``cost`` is that of shifts from -3 to 3 px along u (row 0) and v (row 1), summed over ``pixels`` pixels.
    ``off_levels`` is the median absolute difference at zero shift, in grey levels, and ``correlation`` the
    correlation of the levels. Each is a pair: of the view-independent surfaces, on which the check is based, and
    of close steel. NaN if there are no such pixels.
    """

    cost: Float64[ndarray, "2 7"]
    pixels: int
    off_levels: tuple[float, ...]
    correlation: tuple[float, ...]


def photometric_fit(config: AuditedConfig, view: AuditedView) -> PhotometricFit:
    """Return the photometric match of a view: the right image, warped through ground truth, with the left."""
    eyes = (view.left, view.right)
    left_levels, right_levels = (_smoothed_grey(eye) for eye in eyes)
    baseline_m = float(np.linalg.norm(np.subtract(*(camera_centre(eye.camera.cam_from_world) for eye in eyes))))
    pixels = _textured_pixels(left_levels, view.left, baseline_m)
    projected = project_into(view.right, view.left.points_m.reshape(-1, 3)[pixels], SEARCH_RADIUS_PX + 1)
    visible = np.flatnonzero(projected.inside)
    visible = visible[
        _is_visible(
            view.right, projected.px[visible], projected.depth_m[visible], view.left.bars.ravel()[pixels[visible]]
        )
    ]
    view_independent = _is_view_independent(config, view.left, pixels[visible], baseline_m)
    left_values = left_levels.ravel()[pixels[visible]]
    samples = [_evenly_subsampled(np.flatnonzero(chosen)) for chosen in (view_independent, ~view_independent)]
    levels = [
        (_bilinear(right_levels, projected.px[visible[sampled]]), left_values[sampled]) for sampled in samples
    ]
    checked_px, expected_levels = projected.px[visible[samples[0]]], left_values[samples[0]]
    cost = np.zeros((2, 2 * SEARCH_RADIUS_PX + 1))
    for axis in (0, 1):
        for n in range(2 * SEARCH_RADIUS_PX + 1):
            shift_px = np.zeros(2)
            shift_px[axis] = n - SEARCH_RADIUS_PX
            difference = _bilinear(right_levels, checked_px + shift_px) - expected_levels
            cost[axis, n] = np.minimum(difference * difference, _MAX_DIFFERENCE_LEVELS**2).sum()
    return PhotometricFit(
        cost,
        len(samples[0]),
        off_levels=tuple(_median(np.abs(right - left)) for right, left in levels),
        correlation=tuple(_correlation(right, left) for right, left in levels),
    )


def best_shift_px(cost: Float64[ndarray, " n"]) -> float:
    """Return the shift of least cost, pixels: the vertex of the parabola through the minimum and its neighbours.

    The costs belong to whole-pixel shifts, zero in the middle. A minimum at an end of the range is returned
    without interpolation; the result is 0 if the minimum equals the maximum.
    """
    best, middle = int(np.argmin(cost)), len(cost) // 2
    if cost[best] == cost.max():
        return 0.0
    if best in (0, len(cost) - 1):
        return float(best - middle)
    before, here, after = cost[best - 1 : best + 2]
    return float(best - middle + (before - after) / 2 / (before - 2 * here + after))


def photometric_verdict(config: AuditedConfig, fits: Sequence[PhotometricFit]) -> Check:
    """Return the check of the best shift of all views together, and of each view alone."""
    name = "right image warped to the left by depth"
    pixels = sum(fit.pixels for fit in fits)
    if pixels < _MIN_PIXELS:
        return Check.skip(name, f"only {pixels} textured pixels visible to both eyes")
    u_px, v_px = (best_shift_px(row) for row in np.sum([fit.cost for fit in fits], axis=0))
    judged = [fit for fit in fits if fit.pixels >= _MIN_VIEW_PIXELS]
    worst_px = max((abs(best_shift_px(row)) for fit in judged for row in fit.cost), default=0.0)
    problems = []
    bound_px = MAX_SHIFT_PX + SHIFT_NOISE_PX / pixels**0.5
    if not max(abs(u_px), abs(v_px)) <= bound_px:
        problems.append(
            f"the right images match best at an offset of {u_px:+.2f}, {v_px:+.2f} px from the ground-truth "
            "position"
        )
    if not worst_px <= MAX_VIEW_SHIFT_PX:
        problems.append(
            f"the images of one view match best at an offset of {worst_px:.2f} px from the ground-truth position"
        )
    surfaces = ("view-independent surfaces", "close-range steel")
    surface_texts = [
        f"{surface} {_nanmedian([fit.off_levels[n] for fit in fits]):.1f} levels, correlation "
        f"{_nanmedian([fit.correlation[n] for fit in fits]):.2f}"
        for n, surface in enumerate(surfaces)
        if not all(np.isnan(fit.off_levels[n]) for fit in fits)
    ]
    measured = f"shift {u_px:+.3f}, {v_px:+.3f} px, one view {worst_px:.2f} px; {'; '.join(surface_texts)}"
    bound = f"{bound_px:.2f} px, one view {MAX_VIEW_SHIFT_PX:g} px"
    return Check(name, measured, bound, tuple(problems))


def _smoothed_grey(eye: AuditedEye) -> Float32[ndarray, "h w"]:
    assert eye.rgb is not None
    grey = cv2.cvtColor(eye.rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), _BLUR_PX))


def _textured_pixels(levels: Float32[ndarray, "h w"], eye: AuditedEye, baseline_m: float) -> Int64[ndarray, " n"]:
    """Return the flat indices of pixels with depth and texture, evenly subsampled to at most 120,000.

    Non-steel pixels near a depth discontinuity or a steep change of depth are left out.
    """
    along_u, along_v = (cv2.Sobel(levels, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    textured = np.hypot(along_u, along_v) >= _MIN_GRADIENT
    has_depth = eye.depth_m > 0
    parallax_px = np.divide(
        eye.camera.K[0, 0] * baseline_m, eye.depth_m, out=np.zeros(has_depth.shape), where=has_depth
    )
    around = np.ones((3, 3), dtype=np.uint8)
    rise_m = np.maximum(
        cv2.dilate(eye.depth_m, around) - eye.depth_m, eye.depth_m - cv2.erode(eye.depth_m, around)
    )
    jump = (np.abs(cv2.Laplacian(parallax_px, cv2.CV_64F)) > _DEPTH_JUMP_PX) | eye.mask
    jump |= rise_m >= _RELATIVE_DEPTH_TOLERANCE * eye.depth_m
    near = np.ones((2 * _DEPTH_JUMP_MARGIN_PX + 1,) * 2, dtype=np.uint8)
    near_jump = cv2.dilate(jump.astype(np.uint8), near) > 0
    return _evenly_subsampled(np.flatnonzero(textured & has_depth & (eye.mask | ~near_jump)), 6)


def _is_visible(
    eye: AuditedEye, px: Float64[ndarray, "n 2"], depth_m: Float64[ndarray, " n"], bars: ndarray
) -> Bool[ndarray, " n"]:
    """Return whether the eye's pixels around each projection have the point's bar id and about its depth.

    They are four, or fewer where a coordinate is whole. The rows of parallel eyes are: a row more, always the one
    below, would leave out the lower sides of thin bars only.
    """
    low, high = np.floor(px + _WHOLE_PX).astype(int), np.ceil(px - _WHOLE_PX).astype(int)
    visible = np.ones(len(px), dtype=bool)
    for u, v in product((low[:, 0], high[:, 0]), (low[:, 1], high[:, 1])):
        visible &= np.abs(eye.depth_m[v, u] - depth_m) < _RELATIVE_DEPTH_TOLERANCE * depth_m
        visible &= eye.bars[v, u] == bars
    return visible


def _is_view_independent(
    config: AuditedConfig, eye: AuditedEye, pixels: Int64[ndarray, " n"], baseline_m: float
) -> Bool[ndarray, " n"]:
    """Return whether each pixel's surface looks the same to both eyes.

    This holds for non-steel surfaces, and for bars so thin and far that their shading moves by less than 0.05 px.
    """
    radius_of = np.zeros(np.iinfo(np.uint16).max + 1)
    for bar in config.steel:
        radius_of[bar.bar_id] = bar.diameter_m / 2 if bar.has_axis else np.inf
    depth_m = eye.depth_m.ravel()[pixels].astype(np.float64)
    radius_px = radius_of[eye.bars.ravel()[pixels]] * eye.camera.K[0, 0] / depth_m
    return np.asarray(radius_px * baseline_m / depth_m / 2 < _MAX_SHADING_SHIFT_PX)


def _bilinear(levels: Float32[ndarray, "h w"], px: Float64[ndarray, "n 2"]) -> Float64[ndarray, " n"]:
    """Return the bilinearly interpolated image at ``px``, whose four neighbours must lie inside the image."""
    corner = np.floor(px).astype(int)
    (u, v), (du, dv) = corner.T, (px - corner).T
    above = levels[v, u] * (1 - du) + levels[v, u + 1] * du
    below = levels[v + 1, u] * (1 - du) + levels[v + 1, u + 1] * du
    return np.asarray(above * (1 - dv) + below * dv)


def _evenly_subsampled(values: Int64[ndarray, " n"], multiple: int = 1) -> Int64[ndarray, " k"]:
    """Return at most ``multiple`` x 20,000 of the values, evenly spaced."""
    max_count = multiple * _MAX_PIXELS
    return values if len(values) <= max_count else values[np.linspace(0, len(values) - 1, max_count).astype(int)]


def _median(values: Float64[ndarray, " n"]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _nanmedian(values: Sequence[float]) -> float:
    return _median(np.array([value for value in values if not np.isnan(value)]))


def _correlation(a: Float64[ndarray, " n"], b: Float64[ndarray, " n"]) -> float:
    if len(a) < 2 or not (np.std(a) > 0 and np.std(b) > 0):
        return float("nan")
    return float(np.corrcoef(a, b)[0, 1])
