"""Beam directions of a scanner, and the sub-rays that sample one beam.

Scanner frame: x right, y down, z forward. Azimuth is positive to the right, elevation is positive upwards. Beam
(row, column) has elevation (row + 1/2) steps and azimuth (column + 1/2) steps, so that cells of one step tile all
directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.geometry.cameras import transform

MIN_SECTOR_RANGE_M = 0.1
"""Lower bound of the range used to determine the sector, metres, for scanners with a smaller minimum range.

Parallax grows without bound towards range 0.
"""

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
"""Golden ratio minus 1."""

_ROUNDING = 1e-9
"""Tolerance of the elevation limits, in steps."""


Angles = tuple[Float64[ndarray, "*n"], Float64[ndarray, "*n"]]
"""Azimuth and elevation, radians."""


@dataclass(frozen=True)
class Sector:
    """A block of beams: rows ``first_row`` to ``first_row + rows - 1``, and columns likewise."""

    first_row: int
    rows: int
    first_column: int
    columns: int

    def beams(self) -> tuple[Int64[ndarray, " n"], Int64[ndarray, " n"]]:
        """Return row and column of every beam, in row-major order."""
        row, column = np.mgrid[: self.rows, : self.columns].astype(np.int64)
        return row.ravel() + self.first_row, column.ravel() + self.first_column


def angles_from_directions(points: Float64[ndarray, "*n 3"]) -> Angles:
    """Return azimuth and elevation of points or directions in the scanner's frame, radians."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def directions_from_angles(
    azimuth_rad: Float64[ndarray, "*n"], elevation_rad: Float64[ndarray, "*n"]
) -> Float64[ndarray, "*n 3"]:
    """Return unit directions in the scanner's frame: the inverse of ``angles_from_directions``."""
    cos_elevation = np.cos(elevation_rad)
    return np.stack(
        [np.sin(azimuth_rad) * cos_elevation, -np.sin(elevation_rad), np.cos(azimuth_rad) * cos_elevation], axis=-1
    )


def beam_angles(spec: ScannerSpec, row: Int64[ndarray, " n"], column: Int64[ndarray, " n"]) -> Angles:
    """Return azimuth and elevation of the beams' axes, radians."""
    return (column + 0.5) * spec.azimuth_step_rad, (row + 0.5) * spec.elevation_step_rad


def visible_sector(spec: ScannerSpec, rays_left: Float64[ndarray, "h w 3"]) -> Sector:
    """Return the beams whose cells can contain a pixel of the left image, at any distance the scanner measures.

    ``rays_left`` holds each pixel's ray (x, y, 1) in the left camera's frame. Rows beyond the scanner's elevation
    limits are excluded; the sector can be empty.
    """
    border = np.concatenate([rays_left[0], rays_left[-1], rays_left[:, 0], rays_left[:, -1]])
    near_depth_m = max(spec.min_range_m, MIN_SECTOR_RANGE_M) / np.linalg.norm(border, axis=1).max()
    pose = spec.lidar_from_left
    directions = np.concatenate([transform(pose, near_depth_m * border), border @ pose[:3, :3].T])
    azimuth, elevation = angles_from_directions(directions)
    first_column, last_column = _cell_range(azimuth, spec.azimuth_step_rad)
    first_row, last_row = _cell_range(elevation, spec.elevation_step_rad)
    lowest, highest = (limit / spec.elevation_step_rad - 0.5 for limit in spec.elevation_limits_rad)
    first_row = max(first_row, math.ceil(lowest - _ROUNDING))
    last_row = min(last_row, math.floor(highest + _ROUNDING))
    return Sector(first_row, max(last_row - first_row + 1, 0), first_column, last_column - first_column + 1)


def _cell_range(angle_rad: Float64[ndarray, " n"], step_rad: float) -> tuple[int, int]:
    """Return the first and last cell that contain the angles."""
    return math.floor(angle_rad.min() / step_rad), math.floor(angle_rad.max() / step_rad)


def beam_pattern(count: int) -> Float64[ndarray, "r 2"]:
    """Return where sub-rays of equal weight cross a round Gaussian beam, in units of its sigma; deterministic.

    The points are opposite pairs, so that half of the beam has half of the rays. Their radii divide the intensity
    into equal shares, each the root mean square radius of its ring, so that the variance is exactly 1 in each
    direction; their angles advance by the golden ratio. ``count`` is 1 (the axis) or even.
    """
    if count == 1:
        return np.zeros((1, 2))
    pairs = count // 2
    outside = np.linspace(0.0, 1.0, pairs + 1)  # share of the intensity outside a radius: exp(-radius^2 / 2)
    times_log = outside * np.log(np.where(outside > 0, outside, 1.0))
    radius = np.sqrt(2.0 * (1.0 - np.diff(times_log) * pairs))
    angle = np.arange(pairs) * _GOLDEN * math.pi
    half = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([half, -half])


def sub_rays(
    spec: ScannerSpec, azimuth_rad: Float64[ndarray, " n"], elevation_rad: Float64[ndarray, " n"]
) -> tuple[Float64[ndarray, "n r 3"], Float64[ndarray, "n r 3"]]:
    """Return origins (metres) and directions of every beam's sub-rays, scanner frame.

    Each ray crosses the exit aperture at a pattern point times the exit sigma and is inclined, perpendicular to
    that offset, by the same point times the divergence sigma. These lines generate the hyperboloid d^2 = d0^2 +
    (divergence * range)^2, so that straight rays reproduce the beam's width at every range.
    """
    pattern = beam_pattern(spec.rays_per_beam)
    rotated = np.stack([-pattern[:, 1], pattern[:, 0]], axis=-1)
    axis = directions_from_angles(azimuth_rad, elevation_rad)[:, None]
    right = directions_from_angles(azimuth_rad + math.pi / 2, np.zeros_like(elevation_rad))[:, None]
    up = directions_from_angles(azimuth_rad, elevation_rad + math.pi / 2)[:, None]
    exit_m, inclination = spec.exit_sigma_m * pattern[..., None], spec.divergence_sigma_rad * rotated[..., None]
    return exit_m[:, 0] * right + exit_m[:, 1] * up, axis + inclination[:, 0] * right + inclination[:, 1] * up
