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

WINDOW_PX = 7
"""Side of the windows that are correlated."""
STEP_PX = 1.0
"""Displacement of a pixel in a neighbour from one plane to the next."""
MIN_PLANES, MAX_PLANES = 24, 256
"""Smallest and largest number of planes."""
MIN_CORRELATION = 0.6
"""Smallest correlation, in [-1, 1], of a pixel with depth."""
MIN_DEVIATION = np.float32(2.0)
"""Standard deviation, grey levels, up to which a window is ignored."""
NO_SCORE = np.float32(-2)
"""Initial score, below every correlation."""


@dataclass(frozen=True, eq=False)
class PosedImage:
    """Grey image and its camera pose in the frame of the reconstruction."""

    grey: UInt8[ndarray, "h w"]
    cam_from_sfm: Float64[ndarray, "4 4"]


PlaneHomography = tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]
"""A, B such that A + B / depth is the homography from view to neighbour induced by the plane z = depth."""


def sweep_depth(
    view: PosedImage,
    neighbours: Sequence[PosedImage],
    K: Float64[ndarray, "3 3"],
    near_far: tuple[float, float],
) -> Float32[ndarray, "h w"]:
    """Return planar depth of a view in the reconstruction's unit; NaN where the correlation is too low.

    ``near_far`` is the depth range.
    """
    reference = _window_statistics(view.grey)
    plane_homographies = [_plane_homography(view, neighbour, K) for neighbour in neighbours]
    sources = [np.asarray(neighbour.grey, np.float32) for neighbour in neighbours]
    inverse = inverse_depths(plane_homographies, view.grey.shape, near_far)
    shape = view.grey.shape
    best_score, before, after, previous = (np.full(shape, NO_SCORE) for _ in range(4))
    best, improved = np.zeros(shape, np.int64), np.zeros(shape, bool)
    for plane, inverse_depth in enumerate(inverse):
        homographies = [rotation + inverse_depth * translation for rotation, translation in plane_homographies]
        score = _matching_score(reference, sources, homographies)
        np.copyto(after, score, where=improved)
        improved = score > best_score
        np.copyto(before, previous, where=improved)
        np.copyto(after, NO_SCORE, where=improved)
        np.copyto(best, plane, where=improved)
        np.maximum(best_score, score, out=best_score)
        previous = score
    return _refine_between_planes(inverse, best, (before, best_score, after))


def inverse_depths(
    plane_homographies: Sequence[PlaneHomography],
    shape: tuple[int, ...],
    near_far: tuple[float, float],
) -> Float64[ndarray, " planes"]:
    """Return evenly spaced inverse depths from far to near, at which pixels move by about ``STEP_PX`` per plane.

    ``plane_homographies`` are the results of ``_plane_homography`` for the neighbours, ``shape`` is (height,
    width).
    """
    near, far = near_far
    height, width = shape
    probes = np.array([[x, y, 1.0] for x in (0, width / 2, width) for y in (0, height / 2, height)])
    shifts = [
        _warped_pixels(probes, plane_homography, 1 / far) - _warped_pixels(probes, plane_homography, 1 / near)
        for plane_homography in plane_homographies
    ]
    largest_shift_px = max(float(np.nanmedian(np.linalg.norm(shift, axis=1))) for shift in shifts)
    count = int(np.clip(np.ceil(largest_shift_px / STEP_PX) + 1, MIN_PLANES, MAX_PLANES))
    return np.linspace(1 / far, 1 / near, count)


def _warped_pixels(
    pixels: Float64[ndarray, "n 3"],
    plane_homography: PlaneHomography,
    inverse_depth: float,
) -> Float64[ndarray, "n 2"]:
    """Return the pixels of homogeneous ``pixels`` in the neighbour; NaN behind its camera."""
    rotation, translation = plane_homography
    warped = pixels @ (rotation + inverse_depth * translation).T
    with np.errstate(all="ignore"):
        return np.where(warped[:, 2:] > 0, warped[:, :2] / warped[:, 2:], np.nan)


def _plane_homography(view: PosedImage, neighbour: PosedImage, K: Float64[ndarray, "3 3"]) -> PlaneHomography:
    """Return A, B with neighbour pixel ~ (A + B / depth) @ (u, v, 1) for points on the plane z = depth."""
    neighbour_from_view = neighbour.cam_from_sfm @ inverse_rigid(view.cam_from_sfm)
    K_inverse = np.linalg.inv(K)
    return K @ neighbour_from_view[:3, :3] @ K_inverse, K @ np.outer(neighbour_from_view[:3, 3], [0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _WindowStatistics:
    """Grey image with mean and standard deviation of the window around each pixel."""

    grey: Float32[ndarray, "h w"]
    mean: Float32[ndarray, "h w"]
    deviation: Float32[ndarray, "h w"]


def _box_mean(values: Float32[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    size = (WINDOW_PX, WINDOW_PX)
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))


def _window_statistics(grey: ndarray) -> _WindowStatistics:
    values = np.asarray(grey, np.float32)
    mean = _box_mean(values)
    variance = _box_mean(values * values) - mean * mean
    return _WindowStatistics(values, mean, np.sqrt(np.maximum(variance, 0)))


def _matching_score(
    reference: _WindowStatistics,
    sources: Sequence[Float32[ndarray, "h w"]],
    homographies: Sequence[Float64[ndarray, "3 3"]],
) -> Float32[ndarray, "h w"]:
    """Return the mean correlation of the two best neighbours; in the others the point may be occluded."""
    best = second_best = np.full(reference.grey.shape, np.float32(-1))
    for source, homography in zip(sources, homographies, strict=True):
        score = _correlation(reference, source, homography)
        second_best = np.maximum(second_best, np.minimum(best, score))
        best = np.maximum(best, score)
    return best if len(sources) == 1 else np.asarray((best + second_best) / 2)


def _correlation(
    reference: _WindowStatistics,
    source: Float32[ndarray, "h w"],
    homography: Float64[ndarray, "3 3"],
) -> Float32[ndarray, "h w"]:
    """Return the correlation of windows with a neighbour; -1 outside its image or where a window is uniform."""
    height, width = reference.grey.shape
    warped = cv2.warpPerspective(
        source, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=-1.0
    )
    other = _window_statistics(warped)
    covariance = _box_mean(reference.grey * warped) - reference.mean * other.mean
    valid = (warped >= 0) & (reference.deviation > MIN_DEVIATION) & (other.deviation > MIN_DEVIATION)
    product = np.maximum(reference.deviation * other.deviation, MIN_DEVIATION * MIN_DEVIATION)
    return np.where(valid, covariance / product, np.float32(-1))


def _refine_between_planes(
    inverse: Float64[ndarray, " planes"],
    best: Int64[ndarray, "h w"],
    scores: tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]],
) -> Float32[ndarray, "h w"]:
    """Return depth at the vertex of the parabola through the scores before, at and after the best plane.

    NaN where the score is below ``MIN_CORRELATION`` or the best plane is the first or last one.
    """
    before, best_score, after = scores
    curvature = before - 2 * best_score + after
    with np.errstate(all="ignore"):
        shift = np.where((before > -1) & (after > -1) & (curvature < 0), (before - after) / (2 * curvature), 0.0)
    depth = 1 / (inverse[best] + np.clip(shift, -0.5, 0.5) * (inverse[1] - inverse[0]))
    inside = (best > 0) & (best < len(inverse) - 1)
    return np.where((best_score >= MIN_CORRELATION) & inside, depth, np.nan).astype(np.float32)
