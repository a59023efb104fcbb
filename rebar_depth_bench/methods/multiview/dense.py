"""Dense depth of all registered views, by COLMAP's PatchMatch or by the plane sweep.

Each method returns a reader: a function from an image name to its depth on the pinhole grid, in the unit of the
reconstruction. For the plane sweep, neighbouring views and depth ranges are selected from the sparse points, and
only depth that is consistent with the depth of neighbouring views is kept.

PatchMatch needs CUDA (``pycolmap-cuda12`` instead of ``pycolmap``). It has never been run here because no CUDA
device was available; only the reader of depth maps is tested. Source: J. L. Schoenberger et al., "Pixelwise View
Selection for Unstructured Multi-View Stereo", ECCV 2016.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import Progress, map_in_threads
from rebar_depth_bench.base.writing import write_bytes
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid, pixel_rays, project, transform
from rebar_depth_bench.methods.multiview.sfm import LeftImages, SparseReconstruction

# Plane sweep on a CPU with normalised cross-correlation over neighbouring views. Planes are parallel to the image
# and evenly spaced in inverse depth. Each pixel takes the plane with the highest mean correlation of two
# neighbours' windows with its own, refined between planes. Source: R. Collins, "A Space-Sweep Approach to True
# Multi-Image Matching", CVPR 1996.

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


_HEADER = re.compile(rb"(\d{1,6})&(\d{1,6})&(\d)&")
_HEADER_BYTES = 24


def read_depth_map(path: Path) -> Float32[ndarray, "h w"]:
    """Return the depth map in a ``.bin`` file of COLMAP, in the unit of the reconstruction.

    Pixels without depth are NaN. The format is the text ``WIDTH&HEIGHT&CHANNELS&`` followed by little-endian
    float32 values, row by row, plane by plane. Raises ``MethodError`` for any other file.
    """
    data = path.read_bytes()
    header = _HEADER.match(data[:_HEADER_BYTES])
    width, height, channels = (int(number) for number in header.groups()) if header else (0, 0, 0)
    body = data[header.end() :] if header else b""
    if channels != 1 or len(body) != 4 * width * height:
        raise MethodError(
            f"{path}: is not a COLMAP depth map: {len(data)} bytes that start with {data[:_HEADER_BYTES]!r}, "
            "expected WIDTH&HEIGHT&1& and WIDTH x HEIGHT float32 values"
        )
    depth = np.frombuffer(body, "<f4").reshape(height, width)
    return np.where(depth > 0, depth, np.float32(np.nan))


MAX_RELATIVE_DIFFERENCE = 0.01
"""Two views are consistent at a point if their depths differ by at most this fraction."""


def consistency_mask(
    depth: Float32[ndarray, "h w"],
    cam_from_sfm: Float64[ndarray, "4 4"],
    neighbours: Sequence[tuple[Float32[ndarray, "h w"], Float64[ndarray, "4 4"]]],
    K: Float64[ndarray, "3 3"],
) -> Bool[ndarray, "h w"]:
    """Return a mask of pixels whose depth is confirmed by at least one of the neighbours.

    ``neighbours`` holds depth and pose (``cam_from_sfm``) of each. The 3-D point of a pixel is projected into each
    neighbour and compared with the depth there.
    """
    height, width = depth.shape
    has_depth = np.isfinite(depth)
    points = transform(
        inverse_rigid(cam_from_sfm),
        pixel_rays(K, width, height)[has_depth] * depth[has_depth][:, None].astype(np.float64),
    )
    confirmed = np.zeros(len(points), bool)
    for other_depth, neighbour_from_sfm in neighbours:
        points_cam = transform(neighbour_from_sfm, points)
        in_front = points_cam[:, 2] > 0
        pixels = np.full((len(points), 2), -1.0)
        pixels[in_front] = project(K, points_cam[in_front])
        u, v = np.rint(pixels).astype(np.int64).T
        inside = in_front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        neighbour_depth = np.full(len(points), np.nan)
        neighbour_depth[inside] = other_depth[v[inside], u[inside]]
        with np.errstate(invalid="ignore"):
            confirmed |= np.abs(neighbour_depth - points_cam[:, 2]) <= MAX_RELATIVE_DIFFERENCE * points_cam[:, 2]
    consistent = np.zeros(depth.shape, bool)
    consistent[has_depth] = confirmed
    return consistent


MAX_NEIGHBOURS = 4
"""Largest number of neighbouring views that a view is matched with."""
BEST_ANGLE_DEG = 12.0
"""Best angle between the rays of two views to a point."""
SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG = 6.0, 10.0
"""Standard deviations of the Gaussian weight of a point below and above the best angle."""
RANGE_MARGIN = 0.15
"""Fraction by which the depth range of the sparse points is extended at both ends."""
RANGE_PERCENTILES = (1.0, 99.0)


def select_neighbours(reconstruction: SparseReconstruction) -> Mapping[str, tuple[str, ...]]:
    """Return the neighbours of each view, best first, by the score of their shared points.

    A shared point is weighted by the angle between its two rays. Source: Y. Yao et al., "MVSNet", ECCV 2018,
    section 4.1.
    """
    names = list(reconstruction.cam_from_sfm)
    centres = {name: camera_centre(reconstruction.cam_from_sfm[name]) for name in names}
    neighbours = {}
    for name in names:
        scores = {other: _pair_score(reconstruction, name, other, centres) for other in names if other != name}
        ranked = sorted((other for other in scores if scores[other] > 0), key=lambda other: -scores[other])
        neighbours[name] = tuple(ranked[:MAX_NEIGHBOURS])
    return neighbours


def depth_range(reconstruction: SparseReconstruction, name: str) -> tuple[float, float]:
    """Return the smallest and largest depth to search in a view, from its sparse points and with a margin."""
    near, far = np.percentile(reconstruction.depths(name), RANGE_PERCENTILES)
    return float(near) * (1 - RANGE_MARGIN), float(far) * (1 + RANGE_MARGIN)


def _pair_score(
    reconstruction: SparseReconstruction, name: str, other: str, centres: Mapping[str, np.ndarray]
) -> float:
    shared = np.intersect1d(
        reconstruction.visible_points[name], reconstruction.visible_points[other], assume_unique=True
    )
    if not len(shared):
        return 0.0
    rays = reconstruction.points[shared] - centres[name]
    other_rays = reconstruction.points[shared] - centres[other]
    cosine = (rays * other_rays).sum(axis=1) / (np.linalg.norm(rays, axis=1) * np.linalg.norm(other_rays, axis=1))
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    sigma_deg = np.where(angle_deg < BEST_ANGLE_DEG, SIGMA_BELOW_DEG, SIGMA_ABOVE_DEG)
    return float(np.exp(-(((angle_deg - BEST_ANGLE_DEG) / sigma_deg) ** 2) / 2).sum())


DepthReader = Callable[[str], Float32[ndarray, "h w"]]
"""Function from an image name to planar depth on the pinhole grid, in the reconstruction's unit; NaN: none."""


def patch_match_depth(
    left_images: LeftImages, reconstruction: SparseReconstruction, work: Path, progress: Progress
) -> DepthReader:
    """Run PatchMatch with geometric consistency and return the reader of its depth maps.

    An interrupted run is resumed: COLMAP skips views whose depth maps exist, even if they are damaged, so damaged
    maps are removed first.
    """
    progress("COLMAP: PatchMatch stereo", 0, len(reconstruction.cam_from_sfm))
    dense = work / "dense"
    maps = dense / "stereo" / "depth_maps"
    for path in maps.glob("*.bin"):
        try:
            read_depth_map(path)
        except MethodError:
            path.unlink()
    if not (dense / "stereo" / "fusion.cfg").is_file():
        pycolmap.undistort_images(dense, work / "model", left_images.folder)
    pycolmap.patch_match_stereo(dense)

    def read(name: str) -> Float32[ndarray, "h w"]:
        path = maps / f"{name}.geometric.bin"  # Views without neighbours have no depth map.
        return read_depth_map(path) if path.is_file() else left_images.no_depth

    return read


def plane_sweep_depth(
    left_images: LeftImages, reconstruction: SparseReconstruction, work: Path, progress: Progress
) -> DepthReader:
    """Sweep all registered views and return the reader of the depth that a neighbour confirms."""
    folder = work / "sweep"
    folder.mkdir(exist_ok=True)
    neighbours = select_neighbours(reconstruction)

    def store_depth(name: str) -> None:
        path = folder / f"{name}.npy"
        if not path.is_file():
            content = io.BytesIO()
            np.save(content, _sweep_view(left_images, reconstruction, name, neighbours[name]))
            write_bytes(path, content.getvalue())

    names = list(reconstruction.cam_from_sfm)
    list(map_in_threads(store_depth, names, len(names), "plane sweep", progress=progress))

    def read(name: str) -> Float32[ndarray, "h w"]:
        poses = reconstruction.cam_from_sfm
        depth = np.load(folder / f"{name}.npy")
        others = [(np.load(folder / f"{other}.npy"), poses[other]) for other in neighbours[name]]
        consistent = consistency_mask(depth, poses[name], others, left_images.grid.K)
        return np.where(consistent, depth, np.float32(np.nan))

    return read


def _sweep_view(
    left_images: LeftImages, reconstruction: SparseReconstruction, name: str, neighbours: tuple[str, ...]
) -> Float32[ndarray, "h w"]:
    if not neighbours or not len(reconstruction.visible_points[name]):
        return left_images.no_depth
    view, *others = (
        PosedImage(
            np.asarray(cv2.imread(str(left_images.folder / image), cv2.IMREAD_GRAYSCALE)),
            reconstruction.cam_from_sfm[image],
        )
        for image in (name, *neighbours)
    )
    return sweep_depth(view, others, left_images.grid.K, depth_range(reconstruction, name))
