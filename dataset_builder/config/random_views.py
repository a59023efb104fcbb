"""Placement of random cameras round steel: varied distance, direction, aim and roll. World frame, metres.

Every view sees steel with both eyes, and no eye is in or near steel. Each view has its own random numbers, so that
it does not depend on how many views there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.config.camera_site import CameraSite
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import RandomViewsSpec, RigSpec, RolledStation
from dataset_builder.config.trajectories import look_at_with_rig
from dataset_builder.scene.shapes.point_sets import SurfacePoints
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.geometry.cameras import inverse_rigid

STEEL_CLEARANCE_M = 0.15
STEEL_CLEARANCE = 0.5
"""Least distance of an eye from steel: 0.15 m, or half the distance of the view if that is less."""

MIN_STEEL_SHARE = 0.02
"""Least share of the image of either eye that steel covers, by a grid of rays."""

NEAR = 0.5
MAX_NEAR_SHARE = 0.1
"""Part of the distance within which steel is near, and the largest share of an eye's image that it may cover."""

MAX_ROLL_DEG = 20.0
UPRIGHT_SHARE = 0.1
"""Largest roll of a view, and the share of views that are turned by a further 90 degrees, upright pictures."""

MAX_AIM_OFFSET = 0.25
"""Largest offset of the point aimed at from the steel, along each side of the image, per distance."""

_MAX_TURN_DEG = 60.0
"""Largest deviations of a view's azimuth and elevation from the surface normal."""
_ELEVATIONS_DEG = (-20.0, 80.0)
"""Range of the elevation of the camera as seen from the steel."""

_DECIMALS = 6
_ROLL_DECIMALS = 2
"""Rounding of stations in metres and of rolls in degrees, so that they are equal on every machine."""

_GRID = (48, 27)
"""Rays cast over the image of an eye, columns and rows."""
SPACING_M = 0.02
"""Largest distance of a point of a surface from those that distances of eyes are measured to."""
_BATCH = 64
_BATCHES = 40
"""Views that are tried at once for each view, and how often."""


@dataclass(frozen=True, eq=False)
class _Candidates:
    """Views that are tried: a point of the steel, left camera centre, point aimed at, roll and distance."""

    steel_m: Float64[ndarray, "n 3"]
    centres_m: Float64[ndarray, "n 3"]
    aimed_m: Float64[ndarray, "n 3"]
    roll_deg: Float64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]

    def station(self, index: int) -> RolledStation:
        """Return a view as a station."""
        (cx, cy, cz), (ax, ay, az) = self.centres_m[index].tolist(), self.aimed_m[index].tolist()
        return (cx, cy, cz), (ax, ay, az), float(self.roll_deg[index])


def with_random_stations(views: RandomViewsSpec, site: CameraSite, rig: RigSpec, where: str) -> RandomViewsSpec:
    """Return random views with the stations of a rig at a site, which has points every ``SPACING_M`` or less.

    Raises ``InputError``, which names ``where``, if one cannot be placed.
    """
    tests = _ViewTests(site, rig)
    return replace(views, stations=tuple(_station(views, number, tests, where) for number in range(views.views)))


def _station(views: RandomViewsSpec, number: int, tests: _ViewTests, where: str) -> RolledStation:
    rng = np.random.default_rng([views.seed, number])
    for _ in range(_BATCHES):
        candidates = _candidates(views.distances_m, tests.site.surface.sample(_BATCH, rng), rng)
        if len(found := np.flatnonzero(tests.accept(candidates))):
            return candidates.station(int(found[0]))
    low_m, high_m = views.distances_m
    problem = Problem(
        "conflict",
        f"view {number}",
        f"none of {_BATCH * _BATCHES} random views {low_m:g} to {high_m:g} m from the steel is clear of it and "
        "sees it with both eyes",
        "steel that can be seen from outside",
    )
    raise InputError.from_problems(where, [problem])


def _candidates(distances_m: tuple[float, float], surface: SurfacePoints, rng: np.random.Generator) -> _Candidates:
    """Return random views of points of the steel, at distances that are uniform in their logarithm."""
    n = len(surface.points_m)
    low_m, high_m = distances_m
    distance_m = np.exp(rng.uniform(np.log(low_m), np.log(high_m), n))
    direction = _directions(surface.normals, rng)
    steel_m = np.round(surface.points_m, _DECIMALS)
    centres_m = np.round(steel_m + distance_m[:, None] * direction, _DECIMALS)
    across = np.cross(direction, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upwards = np.cross(across, direction)
    u, v = rng.uniform(-MAX_AIM_OFFSET, MAX_AIM_OFFSET, (2, n, 1))
    aimed_m = np.round(steel_m + distance_m[:, None] * (u * across + v * upwards), _DECIMALS)
    turns_deg = 90.0 * (rng.random(n) < UPRIGHT_SHARE) * np.where(rng.random(n) < 0.5, 1.0, -1.0)
    roll_deg = np.round(rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG, n) + turns_deg, _ROLL_DECIMALS)
    return _Candidates(steel_m, centres_m, aimed_m, roll_deg, distance_m)


def _directions(normals: Float64[ndarray, "n 3"], rng: np.random.Generator) -> Float64[ndarray, "n 3"]:
    """Return unit vectors towards the cameras: the normals with random changes of azimuth and elevation."""
    x, y, z = normals.T
    turn_deg, rise_deg = rng.uniform(-_MAX_TURN_DEG, _MAX_TURN_DEG, (2, len(z)))
    azimuth = np.arctan2(y, x) + np.radians(turn_deg)
    elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y))) + rise_deg
    elevation = np.radians(np.clip(elevation_deg, *_ELEVATIONS_DEG))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


class _ViewTests:
    """Tests of random views of a rig at a site."""

    def __init__(self, site: CameraSite, rig: RigSpec) -> None:
        self.site = site
        width, height = _GRID
        self._rig = replace(rig, width=width, height=height)
        cameras = rig_cameras(self._rig, np.eye(4))
        self._rays = {eye: camera.rays().reshape(-1, 3) for eye, camera in cameras.items()}

    def accept(self, views: _Candidates) -> Bool[ndarray, " n"]:
        """Return which views have both eyes clear of steel, the same point of it in sight, and enough of it."""
        is_accepted = np.ones(len(views.roll_deg), bool)
        for eye, world_from_eye in self._world_from_eyes(views).items():
            for test in (self._is_clear, self._sees_point, self._shows_steel):
                chosen = np.flatnonzero(is_accepted)
                is_accepted[chosen] = test(views, chosen, world_from_eye[chosen], self._rays[eye])
        return is_accepted

    def _world_from_eyes(self, views: _Candidates) -> dict[str, Float64[ndarray, "n 4 4"]]:
        stations = zip(views.centres_m, views.aimed_m, views.roll_deg, strict=True)
        poses = [look_at_with_rig(c, aimed, self._rig.baseline_m, roll) for c, aimed, roll in stations]
        rigs = [rig_cameras(self._rig, pose) for pose in poses]
        return {eye: np.array([inverse_rigid(rig[eye].cam_from_world) for rig in rigs]) for eye in EYES}

    def _is_clear(
        self, views: _Candidates, chosen: ndarray, world_from_eye: ndarray, _rays: ndarray
    ) -> Bool[ndarray, " n"]:
        clearance_m = np.minimum(STEEL_CLEARANCE_M, STEEL_CLEARANCE * views.distance_m[chosen])
        return self.site.is_clear(world_from_eye[:, :3, 3], clearance_m)

    def _sees_point(
        self, views: _Candidates, chosen: ndarray, world_from_eye: ndarray, _rays: ndarray
    ) -> Bool[ndarray, " n"]:
        return self.site.sees(world_from_eye[:, :3, 3], views.steel_m[chosen])

    def _shows_steel(
        self, views: _Candidates, chosen: ndarray, world_from_eye: ndarray, rays: ndarray
    ) -> Bool[ndarray, " n"]:
        range_m = self.site.ranges_m(world_from_eye, rays)
        is_near = range_m < NEAR * views.distance_m[chosen, None]
        share, near_share = np.isfinite(range_m).mean(axis=1), is_near.mean(axis=1)
        return np.asarray((share >= MIN_STEEL_SHARE) & (near_share <= MAX_NEAR_SHARE))
