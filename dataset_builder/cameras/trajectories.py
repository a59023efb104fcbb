"""Camera trajectories: poses of the left camera of the rig, view by view. World frame, metres."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from math import cos, radians, sin
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.steel_distance import radii_at_steel_distance_m
from dataset_builder.scene.model import Assembly
from dataset_builder.specs.config_specs import (
    DistanceSweepSpec,
    DomeSpec,
    RandomViewsSpec,
    RigSpec,
    RingSpec,
    SurveySpec,
    TrajectorySpec,
)
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.data.schema import NEAREST_STEEL
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

    Each is aimed at the target, or at the point of its own station if it has one. Arguments and errors are those
    of ``camera_offsets_m``.
    """
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
    stations.
    """
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
    if isinstance(trajectory, SurveySpec):
        return len(trajectory.stations)
    if isinstance(trajectory, RandomViewsSpec):
        return trajectory.views
    return len(_places(trajectory))


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
    target, so that the scene turns counter-clockwise in the images.
    """
    centred_from_world = matrix_product(_roll(roll_deg), look_at(left_centre_m, target_m))
    distance_m = vector_length(target_m - left_centre_m)
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
