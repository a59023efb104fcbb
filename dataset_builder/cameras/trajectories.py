"""Camera trajectories: poses of the left camera, and distances of points to the nearest steel. World, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from math import cos, radians, sin
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.capsules import Capsules
from dataset_builder.specs.config_specs import (
    DistanceSweepSpec,
    DomeSpec,
    PosesSpec,
    RandomViewsSpec,
    RigSpec,
    RingSpec,
    SurveySpec,
    TrajectorySpec,
)
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.schema import NEAREST_STEEL, trajectory_of
from rebar_depth_bench.geometry.cameras import look_at, matrix_product, rigid, vector_length

GOLDEN_TURN_DEG = 360.0 * (5**0.5 - 1) / 2
"""Azimuth offset between successive rings of a dome, degrees (golden angle): no two rings share azimuths."""

_RADIUS_DECIMALS = 3
"""Rounding of solved distances in metres: to the millimetre, so that they are equal on every machine."""

_AIM_POINT_DECIMALS = 3
"""Rounding of the aim point in metres: to the millimetre."""


class _Place(NamedTuple):
    """Place of the left camera in spherical coordinates round the target."""

    radius_m: float
    elevation_deg: float
    azimuth_deg: float


def aim_point_m(assembly: Assembly) -> Float64[ndarray, 3]:
    """Return the point that cameras aim at (world, metres): the steel's bounding-box centre, to the millimetre.

    Rounding keeps ribs and float32 storage from moving the cameras.
    """
    vertices = assembly.vertices_m
    middle: Float64[ndarray, 3] = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.asarray(np.round(middle, _AIM_POINT_DECIMALS) + 0.0)  # Adding 0.0 turns -0.0 into 0.0.


def poses(
    trajectory: TrajectorySpec, target_m: Float64[ndarray, 3], rig: RigSpec, bars: Sequence[Bar] = ()
) -> list[Float64[ndarray, "4 4"]]:
    """Return ``cam_from_world`` of the left camera for every view of the full trajectory, in order.

    Each is aimed at the target, or at the point of its own station if it has one. Given poses are those of the
    left camera itself, all others those of a rig that is aimed. Arguments and errors are those of
    ``camera_offsets_m``.
    """
    if isinstance(trajectory, PosesSpec):
        positions_m, targets_m = np.broadcast_arrays(trajectory.positions_m, trajectory.targets_m)
        up = np.array(trajectory.up) / vector_length(np.array(trajectory.up))
        return [look_at(*places, up) for places in zip(positions_m, targets_m, strict=True)]
    if isinstance(trajectory, SurveySpec | RandomViewsSpec):
        return [
            look_at_with_rig(np.array(centre_m), np.array(aimed_m), rig.baseline_m, *roll_deg)
            for centre_m, aimed_m, *roll_deg in trajectory.stations
        ]
    return [
        look_at_with_rig(target_m + direction, target_m, rig.baseline_m)
        for direction in camera_offsets_m(trajectory, target_m, bars)
    ]


def camera_offsets_m(
    trajectory: TrajectorySpec, target_m: Float64[ndarray, 3], bars: Sequence[Bar]
) -> list[Float64[ndarray, 3]]:
    """Return the centre of the left camera relative to the target for every view, metres, world axes.

    ``bars`` are those of the assembly round the target. Only a dome whose ``distance_to`` is ``NEAREST_STEEL``
    needs them: it keeps the directions of its rings and azimuths, and the distance of a camera from the target is
    the one at which the nearest point of any bar's surface is a shell's radius away from the left camera, to half
    a millimetre. Raises ``ValueError`` if no bars are given, or for a radius that is too small for the bars.

    The views of a dome are ordered by shell, then ring, then azimuth, so that consecutive views are close to each
    other. The views of a sweep are ordered by distance, then azimuth; the first azimuth is half a step off the
    x axis, so that square cages are not seen face-on. The views of a survey and random views are those of their
    stations, and given poses those of their positions.
    """
    if isinstance(trajectory, PosesSpec):
        return [np.array(position_m) - target_m for position_m in trajectory.positions_m]
    if isinstance(trajectory, SurveySpec | RandomViewsSpec):
        return [np.array(centre_m) - target_m for centre_m, *_ in trajectory.stations]
    places = _places(trajectory)
    if isinstance(trajectory, DomeSpec) and trajectory.distance_to == NEAREST_STEEL:
        directions = np.array([_spherical(1.0, *angles) for _, *angles in places])
        distances_m = np.array([place.radius_m for place in places])
        radii_m = radii_at_steel_distance_m(target_m, directions, distances_m, bars)
        rounded_m = np.round(radii_m, _RADIUS_DECIMALS).tolist()
        places = [_Place(radius_m, *angles) for radius_m, (_, *angles) in zip(rounded_m, places, strict=True)]
    return [_spherical(*place) for place in places]


def view_count(trajectory: TrajectorySpec) -> int:
    """Return the number of views of the full trajectory."""
    return trajectory_of(asdict(trajectory)).views


def _places(trajectory: DomeSpec | RingSpec | DistanceSweepSpec) -> list[_Place]:
    """Return the places of the views in order, with the radii of the trajectory."""
    radii_m = (trajectory.radius_m,) if isinstance(trajectory, RingSpec) else trajectory.radii_m
    first = 0.5 if isinstance(trajectory, DistanceSweepSpec) else 0.0
    if isinstance(trajectory, DomeSpec):
        elevations_deg, turn_deg = trajectory.elevations_deg, GOLDEN_TURN_DEG
    else:
        elevations_deg, turn_deg = (trajectory.elevation_deg,), 0.0
    return [
        _Place(radius_m, elevation_deg, turn_deg * ring + 360.0 * (first + k) / trajectory.azimuths)
        for ring, (radius_m, elevation_deg) in enumerate(product(radii_m, elevations_deg))
        for k in range(trajectory.azimuths)
    ]


def look_at_with_rig(
    left_centre_m: Float64[ndarray, 3], target_m: Float64[ndarray, 3], baseline_m: float, roll_deg: float = 0.0
) -> Float64[ndarray, "4 4"]:
    """Return ``cam_from_world`` of a left camera at ``left_centre_m`` whose rig is aimed at the target.

    The central axis of the rig, not the axis of the left camera, passes through the target. The target is thus at
    x = baseline / 2 in the left camera and at x = -baseline / 2 in the right one, which keeps the assembly in both
    images at short range. The rig is turned by ``roll_deg`` clockwise about the line from the left camera to the
    target, so that the scene turns counter-clockwise in the images. Raises ``InputError`` for a target that is
    nearer than the baseline.
    """
    centred_from_world = matrix_product(_roll(roll_deg), look_at(left_centre_m, target_m))
    distance_m = vector_length(target_m - left_centre_m)
    if distance_m < baseline_m:
        found = f"a camera is {distance_m:.4g} m from the point that it is aimed at"
        raise InputError(
            f"{found}, expected at least the baseline of the rig, {baseline_m:.4g} m: is the unit right?"
        )
    sine = baseline_m / 2 / distance_m
    cosine = (1.0 - sine * sine) ** 0.5
    yaw = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    return matrix_product(rigid(yaw, np.zeros(3)), centred_from_world)


def _roll(roll_deg: float) -> Float64[ndarray, "4 4"]:
    """Return the rotation of camera coordinates that a clockwise turn of the camera about its axis causes."""
    c, s = cos(radians(roll_deg)), sin(radians(roll_deg))
    return rigid(np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


def subset(total: int, count: int | None) -> list[int]:
    """Return ``count`` indices spread evenly over ``range(total)``: the midpoints of equal intervals.

    Returns all indices if ``count`` is None or at least ``total``.
    """
    if count is None or count >= total:
        return list(range(total))
    return [(2 * i + 1) * total // (2 * count) for i in range(count)]


def _spherical(radius_m: float, elevation_deg: float, azimuth_deg: float) -> Float64[ndarray, 3]:
    elevation, azimuth = radians(elevation_deg), radians(azimuth_deg)
    horizontal = cos(elevation)
    return np.array(
        [radius_m * horizontal * cos(azimuth), radius_m * horizontal * sin(azimuth), radius_m * sin(elevation)]
    )


# Distance of points from the nearest steel, computed from the axes and diameters of the bars.

_CHUNK = 32
_STEP_TOLERANCE_M = 1e-7
_MAX_STEPS = 200


@dataclass(frozen=True, eq=False)
class Cylinders:
    """Solid cylinders with flat ends: one for each segment of the bars' centrelines.

    Where two segments meet in a bend of small steps, their union is the bar to a thousandth of its radius.
    """

    start_m: Float64[ndarray, "s 3"]
    direction: Float64[ndarray, "s 3"]
    length_m: Float64[ndarray, " s"]
    radius_m: Float64[ndarray, " s"]

    @classmethod
    def from_bars(cls, bars: Sequence[Bar]) -> Cylinders:
        """Return the cylinders of the bars that have an axis; raise ``ValueError`` if there is no segment."""
        measured = with_axis(bars)
        lines_m = [np.array(bar.axis_m, dtype=np.float64) for bar in measured]
        pieces = Capsules.of_lines(lines_m, [bar.diameter_m / 2 for bar in measured])
        along_m = pieces.b_m - pieces.a_m
        length_m = np.linalg.norm(along_m, axis=1)
        used = length_m > 0
        if not used.any():
            raise ValueError("there are no bars to measure the distance from")
        direction = along_m[used] / length_m[used, None]
        return cls(pieces.a_m[used], direction, length_m[used], pieces.radius_m[used])

    def distance_m(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the Euclidean distance of each point from the nearest cylinder, 0 inside of one."""
        chunks = (points_m[first : first + _CHUNK] for first in range(0, len(points_m), _CHUNK))
        return np.concatenate([np.zeros(0), *map(self._chunk_distance_m, chunks)])

    def _chunk_distance_m(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " n"]:
        """Return the distances of a few points; matrix products compute squares and products with all segments."""
        along_m = points_m @ self.direction.T - (self.start_m * self.direction).sum(axis=1)
        square = (points_m * points_m).sum(axis=1, keepdims=True) - 2 * points_m @ self.start_m.T
        square += (self.start_m * self.start_m).sum(axis=1)
        beyond_m = np.maximum(np.maximum(-along_m, along_m - self.length_m), 0.0)
        across_m = np.sqrt(np.maximum(square - along_m * along_m, 0.0))
        outside_m = np.maximum(across_m - self.radius_m, 0.0)
        return np.asarray(np.sqrt((beyond_m * beyond_m + outside_m * outside_m).min(axis=1)))

    def reach_m(self, point_m: Float64[ndarray, 3]) -> float:
        """Return an upper bound of the distance of steel from a point."""
        ends_m = np.concatenate([self.start_m, self.start_m + self.length_m[:, None] * self.direction])
        return float(np.linalg.norm(ends_m - point_m, axis=1).max() + self.radius_m.max())


def radii_at_steel_distance_m(
    target_m: Float64[ndarray, 3],
    directions: Float64[ndarray, "n 3"],
    distance_m: Float64[ndarray, " n"],
    bars: Sequence[Bar],
) -> Float64[ndarray, " n"]:
    """Return how far from the target each view lies whose nearest steel is ``distance_m`` away.

    The views lie on the rays from ``target_m`` along the unit ``directions``. Of several such points of a ray, the
    outermost is returned. The search starts beyond it and moves each point inward by its excess distance. Such a
    step cannot pass the solution, because the distance from steel changes by at most the length of the step.

    Raises ``ValueError`` if there are no bars, or if the target is farther from them than a ``distance_m``: some
    rays would then have no solution.
    """
    cylinders = Cylinders.from_bars(bars)
    if cylinders.distance_m(target_m[None])[0] > distance_m.min():
        raise ValueError(f"no steel is within {distance_m.min():g} m of the point that the cameras aim at")
    radii_m = distance_m + cylinders.reach_m(target_m)
    for _ in range(_MAX_STEPS):
        excess_m = cylinders.distance_m(target_m + radii_m[:, None] * directions) - distance_m
        radii_m = radii_m - excess_m
        if excess_m.max() < _STEP_TOLERANCE_M:
            break
    return radii_m
