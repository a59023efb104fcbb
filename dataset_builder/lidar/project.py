"""A scan on the left camera's grid: each return is its beam's cell at its own depth, and the nearest one wins.

A return of planar depth z answers a pixel if the pixel's point at z lies in the beam's cell as the scanner sees
it. Cells tile the scanner's sphere, so that a wall is covered without gaps, at any step, and nothing is filled in
beyond a cell. Where the scanner sees what the left camera does not, the z-buffer settles it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from dataset_builder.lidar.beams import Sector, angles_of, beam_angles, directions_of
from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.geometry.cameras import fold_radius, inverse_rigid, project, transform

_CANDIDATES_AT_ONCE = 1 << 19
_LARGEST_REACH = 1.0
_BOX_MARGIN_PX = 0.1


@dataclass(frozen=True, eq=False)
class LeftCamera:
    """The left camera's grid: ``K`` pixels, ``distortion`` k1 k2 p1 p2 k3, and each pixel's ray (x, y, 1)."""

    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, 5]
    rays: Float64[ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Returns: beam, planar depth in the left frame (metres), and how far a cell may reach beyond its edge."""

    row: Int64[ndarray, " n"]
    column: Int64[ndarray, " n"]
    depth_m: Float64[ndarray, " n"]
    reach: Float64[ndarray, " n"]

    def __getitem__(self, chosen: ndarray | slice) -> _Cells:
        return _Cells(self.row[chosen], self.column[chosen], self.depth_m[chosen], self.reach[chosen])


def left_depth_m(
    spec: ScannerSpec, sector: Sector, range_m: Float64[ndarray, "rows columns"], camera: LeftCamera
) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left grid, metres; NaN where no beam answers.

    Between cells of a slanted surface parallax opens slits of up to the tangent of the slant times the scanner's
    distance from the camera over depth, in steps. Cells reach that far beyond their edge for a slant of 45
    degrees, but only into pixels that no cell holds.
    """
    cells = _cells(spec, sector, range_m)
    height, width, _ = camera.rays.shape
    held, reached = (np.full(height * width, np.inf) for _ in range(2))
    for part, pixel in _candidates(spec, cells, camera):
        inside, beside = _holds(spec, part, camera, pixel)
        depth_m = np.broadcast_to(part.depth_m[:, None], pixel.shape)
        np.minimum.at(held, pixel[inside], depth_m[inside])
        np.minimum.at(reached, pixel[beside], depth_m[beside])
    depth_m = np.where(np.isfinite(held), held, reached)
    return np.where(np.isfinite(depth_m), depth_m, np.nan).astype(np.float32).reshape(height, width)


def _cells(spec: ScannerSpec, sector: Sector, range_m: Float64[ndarray, "rows columns"]) -> _Cells:
    row, column = sector.beams()
    heard = np.isfinite(range_m.ravel())
    row, column = row[heard], column[heard]
    points_lidar = range_m.ravel()[heard, None] * directions_of(*beam_angles(spec, row, column))
    depth_m = transform(inverse_rigid(spec.lidar_from_left), points_lidar)[:, 2]
    apart_m = float(np.linalg.norm(spec.position_left_m))
    reach = np.minimum(apart_m / np.where(depth_m > 0, depth_m, np.inf), _LARGEST_REACH)
    return _Cells(row, column, depth_m, reach)[depth_m > 0]


def _candidates(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera
) -> Iterator[tuple[_Cells, Int64[ndarray, "n p"]]]:
    """Yield returns and the pixels of a box around each one's cell, as many of them at once as memory is for."""
    width = camera.rays.shape[1]
    low, high, seen = _boxes(spec, cells, camera)
    low, high, cells = low[seen], high[seen], cells[seen]
    sizes, group = np.unique(high - low + 1, axis=0, return_inverse=True)
    for number, (across, down) in enumerate(sizes):
        members = np.flatnonzero(group.ravel() == number)
        v, u = (offsets.ravel() for offsets in np.mgrid[:down, :across])
        at_once = max(_CANDIDATES_AT_ONCE // len(u), 1)
        for start in range(0, len(members), at_once):
            part = members[start : start + at_once]
            pixel_u, pixel_v = low[part, 0, None] + u, low[part, 1, None] + v
            yield cells[part], pixel_v * width + pixel_u


def _boxes(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera
) -> tuple[Int64[ndarray, "n 2"], Int64[ndarray, "n 2"], Bool[ndarray, " n"]]:
    """Return first and last pixel (u, v) of a box around each cell, cut to the frame, and whether there is any."""
    height, width, _ = camera.rays.shape
    centre_m = np.asarray(spec.position_left_m)
    rotation = spec.lidar_from_left[:3, :3].T
    azimuth, elevation = beam_angles(spec, cells.row, cells.column)
    half = 0.5 * (1.0 + cells.reach)
    least, most = np.full((len(half), 2), np.inf), np.full((len(half), 2), -np.inf)
    sound = np.ones(len(half), bool)
    fold = fold_radius(camera.distortion)
    for side, end in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        corner = directions_of(
            azimuth + side * half * spec.azimuth_step_rad, elevation + end * half * spec.elevation_step_rad
        )
        direction = corner @ rotation.T
        ahead = direction[:, 2] > 0
        step = (cells.depth_m - centre_m[2]) / np.where(ahead, direction[:, 2], 1.0)
        point = centre_m + step[:, None] * direction
        ahead &= np.hypot(point[:, 0], point[:, 1]) < fold * cells.depth_m
        pixel = project(camera.K, np.where(ahead[:, None], point, [0.0, 0.0, 1.0]), camera.distortion)
        least, most, sound = np.minimum(least, pixel), np.maximum(most, pixel), sound & ahead
    # A cell's edges are bent: by no more than the square of its size.
    bend = np.diag(camera.K)[:2] * max(spec.azimuth_step_rad, spec.elevation_step_rad) ** 2
    limit = np.array([width - 1, height - 1])
    low = np.clip(np.ceil(least - bend - _BOX_MARGIN_PX), 0, limit + 1).astype(np.int64)
    high = np.clip(np.floor(most + bend + _BOX_MARGIN_PX), -1, limit).astype(np.int64)
    return low, high, sound & (low <= high).all(axis=1)


def _holds(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera, pixel: Int64[ndarray, "n p"]
) -> tuple[Bool[ndarray, "n p"], Bool[ndarray, "n p"]]:
    """Tell which pixels, at each return's depth, lie in its cell, and which beside it but within its reach."""
    rays = camera.rays.reshape(-1, 3)[pixel]
    azimuth, elevation = angles_of(transform(spec.lidar_from_left, cells.depth_m[:, None, None] * rays))
    across, up = azimuth / spec.azimuth_step_rad, elevation / spec.elevation_step_rad
    row, column = cells.row[:, None], cells.column[:, None]
    inside = (np.floor(across) == column) & (np.floor(up) == row)
    off = np.maximum(np.abs(across - (column + 0.5)), np.abs(up - (row + 0.5)))
    return inside, off <= 0.5 * (1.0 + cells.reach[:, None])
