"""Plane sweep on a CPU with normalised cross-correlation over neighbouring views; this is not part of COLMAP.

Planes are parallel to the image and evenly spaced in inverse depth. Each pixel takes the plane with the highest
mean correlation of two neighbours' windows with its own, refined between planes; ``dense.consistency_mask`` then
removes depth that is not consistent between views. Source: R. Collins, "A Space-Sweep Approach to True Multi-Image
Matching", CVPR 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import inverse_rigid

NO_SCORE = np.float32(-2)
"""Initial score, below every correlation."""


@dataclass(frozen=True)
class PlaneSweepSpec:
    """Parameters of the plane sweep: windows and steps in pixels, correlations in [-1, 1], deviations in grey
    levels.

    ``step_px`` is the displacement of a pixel in a neighbour from one plane to the next. Windows with a standard
    deviation up to ``min_deviation`` are ignored.
    """

    window_px: int = 7
    step_px: float = 1.0
    max_planes: int = 256
    min_planes: int = 24
    min_correlation: float = 0.6
    min_deviation: float = 2.0


@dataclass(frozen=True, eq=False)
class PosedImage:
    """Grey image and its camera pose in the frame of the reconstruction."""

    grey: UInt8[ndarray, "h w"]
    cam_from_sfm: Float64[ndarray, "4 4"]


def sweep_depth(
    view: PosedImage,
    neighbours: Sequence[PosedImage],
    K: Float64[ndarray, "3 3"],
    near_far: tuple[float, float],
    spec: PlaneSweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return planar depth of a view in the reconstruction's unit; NaN where the correlation is too low.

    ``near_far`` is the depth range.
    """
    reference = _window_statistics(view.grey, spec)
    plane_homographies = [_plane_homography(view, neighbour, K) for neighbour in neighbours]
    sources = [np.asarray(neighbour.grey, np.float32) for neighbour in neighbours]
    inverse = inverse_depths(plane_homographies, view.grey.shape, near_far, spec)
    shape = view.grey.shape
    best_score, before, after, previous = (np.full(shape, NO_SCORE) for _ in range(4))
    best, improved = np.zeros(shape, np.int64), np.zeros(shape, bool)
    for plane, inverse_depth in enumerate(inverse):
        homographies = [rotation + inverse_depth * translation for rotation, translation in plane_homographies]
        score = _matching_score(reference, sources, homographies, spec)
        np.copyto(after, score, where=improved)
        improved = score > best_score
        np.copyto(before, previous, where=improved)
        np.copyto(after, NO_SCORE, where=improved)
        np.copyto(best, plane, where=improved)
        np.maximum(best_score, score, out=best_score)
        previous = score
    return _refine_between_planes(inverse, best, (before, best_score, after), spec)


def inverse_depths(
    plane_homographies: Sequence[tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]],
    shape: tuple[int, ...],
    near_far: tuple[float, float],
    spec: PlaneSweepSpec,
) -> Float64[ndarray, " planes"]:
    """Return evenly spaced inverse depths from far to near, at which pixels move by about ``step_px`` per plane.

    ``plane_homographies`` are the results of ``_plane_homography`` for the neighbours, ``shape`` is (height,
    width).
    """
    near, far = near_far
    height, width = shape
    probes = np.array([[x, y, 1.0] for x in (0, width / 2, width) for y in (0, height / 2, height)])
    largest_shift_px = max(
        float(
            np.nanmedian(
                np.linalg.norm(
                    _warped_pixels(probes, plane_homography, 1 / far)
                    - _warped_pixels(probes, plane_homography, 1 / near),
                    axis=1,
                )
            )
        )
        for plane_homography in plane_homographies
    )
    count = int(np.clip(np.ceil(largest_shift_px / spec.step_px) + 1, spec.min_planes, spec.max_planes))
    return np.linspace(1 / far, 1 / near, count)


def _warped_pixels(
    pixels: Float64[ndarray, "n 3"],
    plane_homography: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]],
    inverse_depth: float,
) -> Float64[ndarray, "n 2"]:
    """Return the pixels of homogeneous ``pixels`` in the neighbour; NaN behind its camera."""
    rotation, translation = plane_homography
    warped = pixels @ (rotation + inverse_depth * translation).T
    with np.errstate(all="ignore"):
        return np.where(warped[:, 2:] > 0, warped[:, :2] / warped[:, 2:], np.nan)


def _plane_homography(
    view: PosedImage, neighbour: PosedImage, K: Float64[ndarray, "3 3"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]:
    """Return A, B such that A + B / depth is the homography from view to neighbour induced by the plane z = depth.

    Neighbour pixel ~ (A + B / depth) @ (u, v, 1).
    """
    neighbour_from_view = neighbour.cam_from_sfm @ inverse_rigid(view.cam_from_sfm)
    K_inverse = np.linalg.inv(K)
    return K @ neighbour_from_view[:3, :3] @ K_inverse, K @ np.outer(neighbour_from_view[:3, 3], [0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _WindowStatistics:
    """Grey image with mean and standard deviation of the window around each pixel."""

    grey: Float32[ndarray, "h w"]
    mean: Float32[ndarray, "h w"]
    deviation: Float32[ndarray, "h w"]


def _box_mean(values: Float32[ndarray, "h w"], spec: PlaneSweepSpec) -> Float32[ndarray, "h w"]:
    size = (spec.window_px, spec.window_px)
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))


def _window_statistics(grey: ndarray, spec: PlaneSweepSpec) -> _WindowStatistics:
    values = np.asarray(grey, np.float32)
    mean = _box_mean(values, spec)
    variance = _box_mean(values * values, spec) - mean * mean
    return _WindowStatistics(values, mean, np.sqrt(np.maximum(variance, 0)))


def _matching_score(
    reference: _WindowStatistics,
    sources: Sequence[Float32[ndarray, "h w"]],
    homographies: Sequence[Float64[ndarray, "3 3"]],
    spec: PlaneSweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return the mean correlation of the two best neighbours; in the others the point may be occluded."""
    best = second_best = np.full(reference.grey.shape, np.float32(-1))
    for source, homography in zip(sources, homographies, strict=True):
        score = _correlation(reference, source, homography, spec)
        second_best = np.maximum(second_best, np.minimum(best, score))
        best = np.maximum(best, score)
    return best if len(sources) == 1 else np.asarray((best + second_best) / 2)


def _correlation(
    reference: _WindowStatistics,
    source: Float32[ndarray, "h w"],
    homography: Float64[ndarray, "3 3"],
    spec: PlaneSweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return the correlation of windows with a neighbour; -1 outside its image or where a window is uniform."""
    height, width = reference.grey.shape
    warped = cv2.warpPerspective(
        source, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=-1.0
    )
    other = _window_statistics(warped, spec)
    covariance = _box_mean(reference.grey * warped, spec) - reference.mean * other.mean
    min_deviation = np.float32(spec.min_deviation)
    valid = (warped >= 0) & (reference.deviation > min_deviation) & (other.deviation > min_deviation)
    product = np.maximum(reference.deviation * other.deviation, min_deviation * min_deviation)
    return np.where(valid, covariance / product, np.float32(-1))


def _refine_between_planes(
    inverse: Float64[ndarray, " planes"],
    best: Int64[ndarray, "h w"],
    scores: tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]],
    spec: PlaneSweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return depth at the vertex of the parabola through the scores before, at and after the best plane.

    NaN where the score is below ``min_correlation`` or the best plane is the first or last one.
    """
    before, best_score, after = scores
    curvature = before - 2 * best_score + after
    with np.errstate(all="ignore"):
        shift = np.where((before > -1) & (after > -1) & (curvature < 0), (before - after) / (2 * curvature), 0.0)
    depth = 1 / (inverse[best] + np.clip(shift, -0.5, 0.5) * (inverse[1] - inverse[0]))
    inside = (best > 0) & (best < len(inverse) - 1)
    return np.where((best_score >= spec.min_correlation) & inside, depth, np.nan).astype(np.float32)
