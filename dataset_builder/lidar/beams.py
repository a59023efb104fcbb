"""Where a scanner's beams go, and the sub-rays that stand for one beam. Scanner frame: x right, y down, z forward.

Azimuth is positive to the right, elevation upwards; beam (row, column) looks along elevation (row + 1/2) steps and
azimuth (column + 1/2) steps, so that cells of one step tile all directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray

from dataset_builder.lidar.scanner import ScannerSpec
from rebar_depth_bench.geometry.cameras import transform

NEAREST_M = 0.1
"""Surfaces nearer than this are not looked for, whatever a scanner's least range: parallax grows without end."""

_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0
_ROUNDING = 1e-9

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
        """Return row and column of every beam, row by row."""
        row, column = np.mgrid[: self.rows, : self.columns].astype(np.int64)
        return row.ravel() + self.first_row, column.ravel() + self.first_column


def angles_of(points: Float64[ndarray, "*n 3"]) -> Angles:
    """Return azimuth and elevation of points or directions in the scanner's frame, radians."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def directions_of(
    azimuth_rad: Float64[ndarray, "*n"], elevation_rad: Float64[ndarray, "*n"]
) -> Float64[ndarray, "*n 3"]:
    """Return unit directions in the scanner's frame: ``angles_of`` undone."""
    level = np.cos(elevation_rad)
    return np.stack([np.sin(azimuth_rad) * level, -np.sin(elevation_rad), np.cos(azimuth_rad) * level], axis=-1)


def beam_angles(spec: ScannerSpec, row: Int64[ndarray, " n"], column: Int64[ndarray, " n"]) -> Angles:
    """Return azimuth and elevation of beams' axes, radians."""
    return (column + 0.5) * spec.azimuth_step_rad, (row + 0.5) * spec.elevation_step_rad


def sector_of(spec: ScannerSpec, rays_left: Float64[ndarray, "h w 3"]) -> Sector:
    """Return the beams in whose cells a pixel of the left frame may fall, at any distance the scanner measures.

    ``rays_left`` holds each pixel's ray (x, y, 1), left camera's frame. Rows beyond the scanner's elevation limits
    are left out; there may be none left.
    """
    border = np.concatenate([rays_left[0], rays_left[-1], rays_left[:, 0], rays_left[:, -1]])
    near_depth_m = max(spec.min_range_m, NEAREST_M) / np.linalg.norm(border, axis=1).max()
    pose = spec.lidar_from_left
    seen = np.concatenate([transform(pose, near_depth_m * border), border @ pose[:3, :3].T])
    azimuth, elevation = angles_of(seen)
    first_column, last_column = _cells(azimuth, spec.azimuth_step_rad)
    first_row, last_row = _cells(elevation, spec.elevation_step_rad)
    lowest, highest = (limit / spec.elevation_step_rad - 0.5 for limit in spec.elevation_limits_rad)
    first_row = max(first_row, math.ceil(lowest - _ROUNDING))
    last_row = min(last_row, math.floor(highest + _ROUNDING))
    return Sector(first_row, max(last_row - first_row + 1, 0), first_column, last_column - first_column + 1)


def _cells(angle_rad: Float64[ndarray, " n"], step_rad: float) -> tuple[int, int]:
    return math.floor(angle_rad.min() / step_rad), math.floor(angle_rad.max() / step_rad)


def bundle(count: int) -> Float64[ndarray, "r 2"]:
    """Return where sub-rays of equal weight cross a round Gaussian beam, in units of its sigma; no randomness.

    Opposite pairs, so that half of the beam is half of the rays; radii are those of equal shares of the light,
    each the root mean square of its ring, so that the variance is 1 each way exactly; angles go round by the
    golden ratio. ``count`` is 1 (the axis) or even.
    """
    if count == 1:
        return np.zeros((1, 2))
    pairs = count // 2
    outside = np.linspace(0.0, 1.0, pairs + 1)  # the share of the light outside a radius: exp(-radius^2 / 2)
    times_log = outside * np.log(np.where(outside > 0, outside, 1.0))
    radius = np.sqrt(2.0 * (1.0 - np.diff(times_log) * pairs))
    turn = np.arange(pairs) * _GOLDEN * math.pi
    half = radius[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return np.concatenate([half, -half])


def sub_rays(
    spec: ScannerSpec, azimuth_rad: Float64[ndarray, " n"], elevation_rad: Float64[ndarray, " n"]
) -> tuple[Float64[ndarray, "n r 3"], Float64[ndarray, "n r 3"]]:
    """Return origins (metres) and directions of every beam's sub-rays, scanner frame.

    Each ray crosses the exit at a pattern point times sigma and leans at a right angle to it by the same point
    times the angle's sigma: these lines rule the hyperboloid d^2 = d0^2 + (divergence * range)^2, so that
    straight rays have the beam's width at every range.
    """
    pattern = bundle(spec.rays_per_beam)
    turned = np.stack([-pattern[:, 1], pattern[:, 0]], axis=-1)
    axis = directions_of(azimuth_rad, elevation_rad)[:, None]
    right = directions_of(azimuth_rad + math.pi / 2, np.zeros_like(elevation_rad))[:, None]
    up = directions_of(azimuth_rad, elevation_rad + math.pi / 2)[:, None]
    exit_m, lean = spec.exit_sigma_m * pattern[..., None], spec.divergence_sigma_rad * turned[..., None]
    return exit_m[:, 0] * right + exit_m[:, 1] * up, axis + lean[:, 0] * right + lean[:, 1] * up
