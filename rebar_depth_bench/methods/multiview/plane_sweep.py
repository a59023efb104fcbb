"""Dense depth on a CPU: a plane sweep with normalised cross-correlation over neighbouring views. Not COLMAP.

Planes are parallel to the picture and evenly spaced in inverse depth. Each pixel takes the plane at which the
windows of two neighbours agree best with the view's own, refined between planes; ``consistent`` then keeps what
views agree on.
Source: R. Collins, "A Space-Sweep Approach to True Multi-Image Matching", CVPR 1996.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import inverse_rigid

BAD = np.float32(-2)
"""Below every correlation."""


@dataclass(frozen=True)
class SweepSpec:
    """How the sweep goes: windows and steps in pixels, correlations from -1 to 1, deviations in grey levels.

    ``step_px`` is how far a pixel may move in a neighbour from one plane to the next. Windows that are flatter
    than ``least_deviation`` say nothing.
    """

    window_px: int = 7
    step_px: float = 1.0
    most_planes: int = 256
    least_planes: int = 24
    least_correlation: float = 0.6
    least_deviation: float = 2.0


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A grey picture and where it was taken from, in the reconstruction's frame."""

    grey: UInt8[ndarray, "h w"]
    cam_from_sfm: Float64[ndarray, "4 4"]


def sweep(
    view: PosedPicture,
    neighbours: Sequence[PosedPicture],
    K: Float64[ndarray, "3 3"],
    near_far: tuple[float, float],
    spec: SweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return a view's planar depth in the reconstruction's unit, NaN where the neighbours do not agree."""
    reference = _windows(view.grey, spec)
    movers = [_mover(view, neighbour, K) for neighbour in neighbours]
    sources = [np.asarray(neighbour.grey, np.float32) for neighbour in neighbours]
    inverse = inverse_depths(movers, view.grey.shape, near_far, spec)
    shape = view.grey.shape
    at, before, after, previous = (np.full(shape, BAD) for _ in range(4))
    best, just_now = np.zeros(shape, np.int64), np.zeros(shape, bool)
    for plane, inverse_depth in enumerate(inverse):
        homographies = [rotation + inverse_depth * translation for rotation, translation in movers]
        score = _agreement(reference, sources, homographies, spec)
        np.copyto(after, score, where=just_now)
        just_now = score > at
        np.copyto(before, previous, where=just_now)
        np.copyto(after, BAD, where=just_now)
        np.copyto(best, plane, where=just_now)
        np.maximum(at, score, out=at)
        previous = score
    return _refined(inverse, best, (before, at, after), spec)


def inverse_depths(
    movers: Sequence[tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]],
    shape: tuple[int, ...],
    near_far: tuple[float, float],
    spec: SweepSpec,
) -> Float64[ndarray, " planes"]:
    """Return evenly spaced inverse depths from far to near: pixels move by about a step from one to the next."""
    near, far = near_far
    height, width = shape
    probes = np.array([[x, y, 1.0] for x in (0, width / 2, width) for y in (0, height / 2, height)])
    longest = max(
        float(
            np.nanmedian(np.linalg.norm(_moved(probes, mover, 1 / far) - _moved(probes, mover, 1 / near), axis=1))
        )
        for mover in movers
    )
    count = int(np.clip(np.ceil(longest / spec.step_px) + 1, spec.least_planes, spec.most_planes))
    return np.linspace(1 / far, 1 / near, count)


def _moved(
    pixels: Float64[ndarray, "n 3"],
    mover: tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]],
    inverse_depth: float,
) -> Float64[ndarray, "n 2"]:
    rotation, translation = mover
    places = pixels @ (rotation + inverse_depth * translation).T
    with np.errstate(all="ignore"):
        return np.where(places[:, 2:] > 0, places[:, :2] / places[:, 2:], np.nan)


def _mover(
    view: PosedPicture, neighbour: PosedPicture, K: Float64[ndarray, "3 3"]
) -> tuple[Float64[ndarray, "3 3"], Float64[ndarray, "3 3"]]:
    """Return A, B with neighbour pixel ~ (A + B / depth) @ (u, v, 1): the homography of each plane z = depth."""
    relative = neighbour.cam_from_sfm @ inverse_rigid(view.cam_from_sfm)
    K_inverse = np.linalg.inv(K)
    return K @ relative[:3, :3] @ K_inverse, K @ np.outer(relative[:3, 3], [0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class _Windows:
    """A picture, and the mean and standard deviation of the window round each pixel."""

    grey: Float32[ndarray, "h w"]
    mean: Float32[ndarray, "h w"]
    deviation: Float32[ndarray, "h w"]


def _box(values: Float32[ndarray, "h w"], spec: SweepSpec) -> Float32[ndarray, "h w"]:
    size = (spec.window_px, spec.window_px)
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101))


def _windows(grey: ndarray, spec: SweepSpec) -> _Windows:
    values = np.asarray(grey, np.float32)
    mean = _box(values, spec)
    variance = _box(values * values, spec) - mean * mean
    return _Windows(values, mean, np.sqrt(np.maximum(variance, 0)))


def _agreement(
    reference: _Windows,
    sources: Sequence[Float32[ndarray, "h w"]],
    homographies: Sequence[Float64[ndarray, "3 3"]],
    spec: SweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return the mean correlation of the two neighbours that agree best: others may not see the point."""
    first = second = np.full(reference.grey.shape, np.float32(-1))
    for source, homography in zip(sources, homographies, strict=True):
        score = _correlation(reference, source, homography, spec)
        second = np.maximum(second, np.minimum(first, score))
        first = np.maximum(first, score)
    return first if len(sources) == 1 else np.asarray((first + second) / 2)


def _correlation(
    reference: _Windows,
    source: Float32[ndarray, "h w"],
    homography: Float64[ndarray, "3 3"],
    spec: SweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return the windows' correlation with a neighbour's, -1 where it does not see the pixel or one is flat."""
    height, width = reference.grey.shape
    warped = cv2.warpPerspective(
        source, homography, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=-1.0
    )
    other = _windows(warped, spec)
    covariance = _box(reference.grey * warped, spec) - reference.mean * other.mean
    flat = np.float32(spec.least_deviation)
    known = (warped >= 0) & (reference.deviation > flat) & (other.deviation > flat)
    product = np.maximum(reference.deviation * other.deviation, flat * flat)
    return np.where(known, covariance / product, np.float32(-1))


def _refined(
    inverse: Float64[ndarray, " planes"],
    best: Int64[ndarray, "h w"],
    scores: tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]],
    spec: SweepSpec,
) -> Float32[ndarray, "h w"]:
    """Return depth at the top of the parabola through the scores before, at and after the best plane."""
    before, at, after = scores
    bend = before - 2 * at + after
    with np.errstate(all="ignore"):
        shift = np.where((before > -1) & (after > -1) & (bend < 0), (before - after) / (2 * bend), 0.0)
    depth = 1 / (inverse[best] + np.clip(shift, -0.5, 0.5) * (inverse[1] - inverse[0]))
    inside = (best > 0) & (best < len(inverse) - 1)
    return np.where((at >= spec.least_correlation) & inside, depth, np.nan).astype(np.float32)
