"""Projection of a scan to the left camera's grid: each return fills its beam's cell at its own depth.

Where cells overlap, the nearest return is used. A return of planar depth z covers a pixel if the pixel's point at
depth z lies in the beam's cell as seen from the scanner. Cells tile the scanner's sphere, so that a wall is
covered without gaps at any step size, and nothing is interpolated beyond a cell. Surfaces that the scanner sees
but the left camera does not are removed by the z-buffer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from numpy import ndarray

from dataset_builder.lidar.beams import Sector, angles_from_directions, beam_angles, directions_from_angles
from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.geometry.cameras import fold_radius, inverse_rigid, project, transform

_MAX_CANDIDATES_PER_BATCH = 1 << 19
"""Maximum number of candidate pixels per batch; bounds memory."""

_MAX_REACH = 1.0
"""Upper bound of ``_Cells.reach``, in steps."""

_BOX_MARGIN_PX = 0.1
"""Safety margin of the bounding boxes, pixels."""


@dataclass(frozen=True, eq=False)
class LeftCamera:
    """Grid of the left camera: ``K`` in pixels, ``distortion`` k1 k2 p1 p2 k3, and each pixel's ray (x, y, 1)."""

    K: Float64[ndarray, "3 3"]
    distortion: Float64[ndarray, 5]
    rays: Float64[ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class _Cells:
    """Returns of a scan: the beam's row and column and the planar depth in the left frame (metres).

    An extended cell is ``1 + reach`` steps wide, with half of the extension on each side.
    """

    row: Int64[ndarray, " n"]
    column: Int64[ndarray, " n"]
    depth_m: Float64[ndarray, " n"]
    reach: Float64[ndarray, " n"]

    def __getitem__(self, chosen: ndarray | slice) -> _Cells:
        """Return the selected returns."""
        return _Cells(self.row[chosen], self.column[chosen], self.depth_m[chosen], self.reach[chosen])


def left_depth_m(
    spec: ScannerSpec, sector: Sector, range_m: Float64[ndarray, "rows columns"], camera: LeftCamera
) -> Float32[ndarray, "h w"]:
    """Return planar depth on the left grid, metres; NaN where no beam has a return.

    On a slanted surface, parallax opens gaps between cells. They are up to as wide, in steps, as the tangent of
    the slant times the scanner's distance from the camera over depth. Cells are widened by that much (half on
    each side) for a slant of 45 degrees, but only into pixels that are in no cell.
    """
    cells = _returned_cells(spec, sector, range_m)
    height, width, _ = camera.rays.shape
    in_cell_m, extended_m = (np.full(height * width, np.inf) for _ in range(2))
    for part, pixel in _candidates(spec, cells, camera):
        inside, in_extended_cell = _pixels_in_cells(spec, part, camera, pixel)
        depth_m = np.broadcast_to(part.depth_m[:, None], pixel.shape)
        np.minimum.at(in_cell_m, pixel[inside], depth_m[inside])
        np.minimum.at(extended_m, pixel[in_extended_cell], depth_m[in_extended_cell])
    depth_m = np.where(np.isfinite(in_cell_m), in_cell_m, extended_m)
    return np.where(np.isfinite(depth_m), depth_m, np.nan).astype(np.float32).reshape(height, width)


def _returned_cells(spec: ScannerSpec, sector: Sector, range_m: Float64[ndarray, "rows columns"]) -> _Cells:
    """Return the cells of all beams with a return in front of the left camera."""
    row, column = sector.beams()
    has_return = np.isfinite(range_m.ravel())
    row, column = row[has_return], column[has_return]
    points_lidar = range_m.ravel()[has_return, None] * directions_from_angles(*beam_angles(spec, row, column))
    depth_m = transform(inverse_rigid(spec.lidar_from_left), points_lidar)[:, 2]
    camera_distance_m = float(np.linalg.norm(spec.position_left_m))
    reach = np.minimum(camera_distance_m / np.where(depth_m > 0, depth_m, np.inf), _MAX_REACH)
    return _Cells(row, column, depth_m, reach)[depth_m > 0]


def _candidates(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera
) -> Iterator[tuple[_Cells, Int64[ndarray, "n p"]]]:
    """Yield batches of returns, bounded by memory, with the pixels of a bounding box around each one's cell."""
    width = camera.rays.shape[1]
    low, high, valid = _bounding_boxes(spec, cells, camera)
    low, high, cells = low[valid], high[valid], cells[valid]
    sizes, group = np.unique(high - low + 1, axis=0, return_inverse=True)
    for number, (across, down) in enumerate(sizes):
        members = np.flatnonzero(group.ravel() == number)
        v, u = (offsets.ravel() for offsets in np.mgrid[:down, :across])
        batch_size = max(_MAX_CANDIDATES_PER_BATCH // len(u), 1)
        for start in range(0, len(members), batch_size):
            part = members[start : start + batch_size]
            pixel_u, pixel_v = low[part, 0, None] + u, low[part, 1, None] + v
            yield cells[part], pixel_v * width + pixel_u


def _bounding_boxes(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera
) -> tuple[Int64[ndarray, "n 2"], Int64[ndarray, "n 2"], Bool[ndarray, " n"]]:
    """Return first and last pixel (u, v) of a box around each cell, clipped to the image, and whether it is valid.

    A box is invalid if it is empty or a corner of the cell cannot be projected.
    """
    height, width, _ = camera.rays.shape
    centre_m = np.asarray(spec.position_left_m)
    rotation = spec.lidar_from_left[:3, :3].T
    azimuth, elevation = beam_angles(spec, cells.row, cells.column)
    half = 0.5 * (1.0 + cells.reach)
    lowest, highest = np.full((len(half), 2), np.inf), np.full((len(half), 2), -np.inf)
    valid = np.ones(len(half), bool)
    fold = fold_radius(camera.distortion)
    for side, end in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        corner = directions_from_angles(
            azimuth + side * half * spec.azimuth_step_rad, elevation + end * half * spec.elevation_step_rad
        )
        direction = corner @ rotation.T
        projectable = direction[:, 2] > 0
        step = (cells.depth_m - centre_m[2]) / np.where(projectable, direction[:, 2], 1.0)
        point = centre_m + step[:, None] * direction
        projectable &= np.hypot(point[:, 0], point[:, 1]) < fold * cells.depth_m
        pixel = project(camera.K, np.where(projectable[:, None], point, [0.0, 0.0, 1.0]), camera.distortion)
        lowest, highest, valid = np.minimum(lowest, pixel), np.maximum(highest, pixel), valid & projectable
    # The edges of a projected cell are curved, by no more than the square of the cell's size.
    bend = np.diag(camera.K)[:2] * max(spec.azimuth_step_rad, spec.elevation_step_rad) ** 2
    limit = np.array([width - 1, height - 1])
    low = np.clip(np.ceil(lowest - bend - _BOX_MARGIN_PX), 0, limit + 1).astype(np.int64)
    high = np.clip(np.floor(highest + bend + _BOX_MARGIN_PX), -1, limit).astype(np.int64)
    return low, high, valid & (low <= high).all(axis=1)


def _pixels_in_cells(
    spec: ScannerSpec, cells: _Cells, camera: LeftCamera, pixel: Int64[ndarray, "n p"]
) -> tuple[Bool[ndarray, "n p"], Bool[ndarray, "n p"]]:
    """Return which pixels, at each return's depth, lie in its cell, and which lie within its extended cell."""
    rays = camera.rays.reshape(-1, 3)[pixel]
    azimuth, elevation = angles_from_directions(
        transform(spec.lidar_from_left, cells.depth_m[:, None, None] * rays)
    )
    across, up = azimuth / spec.azimuth_step_rad, elevation / spec.elevation_step_rad
    row, column = cells.row[:, None], cells.column[:, None]
    inside = (np.floor(across) == column) & (np.floor(up) == row)
    offset = np.maximum(np.abs(across - (column + 0.5)), np.abs(up - (row + 0.5)))
    return inside, offset <= 0.5 * (1.0 + cells.reach[:, None])
