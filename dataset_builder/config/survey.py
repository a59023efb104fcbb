"""Placement of survey cameras: stereo views at stated distances from points spread over the visible steel.

Random points of the steel's surface are tried, each with a direction near its normal. Of the acceptable views of a
distance, those are taken whose points are farthest from each other, and each of them gives way to the acceptable
view near it that shows the most steel. World frame, metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from dataset_builder.config.camera_site import CameraSite
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import RigSpec, Station, SurveySpec
from dataset_builder.config.surroundings import GROUND_CLEARANCE_M, CameraSpace
from dataset_builder.config.trajectories import look_at_with_rig
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.point_sets import SurfacePoints, farthest_points, short_path
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.geometry.cameras import inverse_rigid

STEEL_CLEARANCE_M = 0.3
STEEL_CLEARANCE = 0.5
"""Least distance of an eye from steel: 0.3 m, or half the distance of the view if that is less."""

NEAR = 0.5
MAX_NEAR_SHARE = 0.02
"""Part of the distance within which steel is near, and the largest share of an eye's image that it may cover."""

_MIDDLE, _FAR = 0.75, 1.5
"""Multiple of the distance up to which steel counts for the choice between views."""

_AZIMUTH_VARIATION_DEG = 20.0
_ELEVATION_VARIATION_DEG = 15.0
"""Largest deviations of a view's direction from the surface normal."""
_MAX_ELEVATION_DEG = 80.0
"""Largest elevation of a view's direction: the picture's up direction is that of the world."""

_DECIMALS = 6
"""Rounding of stations in metres: to the micrometre, so that they are equal on every machine."""

_GRID = (32, 18)
"""Rays cast over the image of an eye, columns and rows."""
_BATCH = 2048
"""Number of points that are tried at once."""
_ACCEPTABLE_PER_VIEW = 16
_POINTS_PER_VIEW = 256
_MIN_POINTS = 8 * _BATCH
"""Number of acceptable views per view after which no more points are tried, and limits of the points tried."""


def with_stations(
    survey: SurveySpec, assembly: Assembly, space: CameraSpace, rig: RigSpec, where: str
) -> SurveySpec:
    """Return the survey with its stations, by distance and then along short paths.

    Raises ``InputError`` that names ``where``, the file of the scene, and every distance at which fewer views than
    requested are acceptable.
    """
    site = _Site(assembly, space, rig, steel_clearance_m(min(survey.distances_m)))
    stations: list[Station] = []
    problems: list[Problem] = []
    for number, distance_m in enumerate(survey.distances_m):
        rng = np.random.default_rng([survey.seed, number])
        views = _acceptable_views(site, distance_m, survey.views_per_distance, rng)
        if len(views.points_m) < survey.views_per_distance:
            found = f"{len(views.points_m)} survey views can be placed {distance_m:g} m from the steel"
            expected = (
                f"{survey.views_per_distance}: elsewhere, a camera would be within "
                f"{steel_clearance_m(distance_m):g} m of steel or {GROUND_CLEARANCE_M:g} m of the ground, more "
                f"than {space.radius_m:g} m from the world's origin, or its view would be blocked. Choose other "
                "distances or fewer views_per_distance"
            )
            problems.append(Problem("conflict", "cameras", found, expected))
        else:
            stations += _spread(views, survey.views_per_distance).stations()
    if problems:
        raise InputError.from_problems(where, problems)
    return replace(survey, stations=tuple(stations))


def steel_clearance_m(distance_m: float) -> float:
    """Return the least distance from steel of the eyes of views at ``distance_m``."""
    return min(STEEL_CLEARANCE_M, STEEL_CLEARANCE * distance_m)


@dataclass(frozen=True, eq=False)
class _Views:
    """Views: centres of the left camera, aimed points, and the share of steel at about their distance."""

    centres_m: Float64[ndarray, "n 3"]
    points_m: Float64[ndarray, "n 3"]
    steel_share: Float64[ndarray, " n"]

    def __getitem__(self, index: Any) -> _Views:
        return _Views(self.centres_m[index], self.points_m[index], self.steel_share[index])

    @classmethod
    def joined(cls, views: list[_Views]) -> _Views:
        """Return the views of all items."""
        return cls(
            np.concatenate([item.centres_m for item in views]),
            np.concatenate([item.points_m for item in views]),
            np.concatenate([item.steel_share for item in views]),
        )

    def stations(self) -> list[Station]:
        """Return the views as stations."""
        pairs = zip(self.centres_m.tolist(), self.points_m.tolist(), strict=True)
        return [((cx, cy, cz), (px, py, pz)) for (cx, cy, cz), (px, py, pz) in pairs]


class _Site:
    """Steel of a scene with the space for cameras: tests of survey views."""

    def __init__(self, assembly: Assembly, space: CameraSpace, rig: RigSpec, clearance_m: float) -> None:
        self._cameras = CameraSite(assembly, space, clearance_m / 5)
        self.surface = self._cameras.surface
        width, height = _GRID
        self._rig = replace(rig, width=width, height=height)
        self._rays = {
            eye: camera.rays().reshape(-1, 3) for eye, camera in rig_cameras(self._rig, np.eye(4)).items()
        }

    def acceptable(
        self, centres_m: Float64[ndarray, "n 3"], points_m: Float64[ndarray, "n 3"], distance_m: float
    ) -> _Views:
        """Return the acceptable ones of the views from left camera centres to points of the steel."""
        chosen = self._is_usable(centres_m, points_m, distance_m)
        centres_m, points_m = centres_m[chosen], points_m[chosen]
        poses = self._world_from_eyes(centres_m, points_m)
        chosen = self._is_usable(poses["right"][:, :3, 3], points_m, distance_m)
        shares = [self._steel_shares(eye, pose[chosen], distance_m) for eye, pose in poses.items()]
        near, middle = np.array(shares).reshape(2, 2, -1).swapaxes(0, 1)
        return _Views(centres_m[chosen], points_m[chosen], middle.mean(axis=0))[near.max(axis=0) <= MAX_NEAR_SHARE]

    def _world_from_eyes(
        self, centres_m: Float64[ndarray, "n 3"], points_m: Float64[ndarray, "n 3"]
    ) -> dict[str, Float64[ndarray, "n 4 4"]]:
        """Return the poses of both eyes of the rigs at left camera centres that are aimed at points."""
        views = zip(centres_m, points_m, strict=True)
        rigs = [rig_cameras(self._rig, look_at_with_rig(*view, self._rig.baseline_m)) for view in views]
        return {
            eye: np.array([inverse_rigid(rig[eye].cam_from_world) for rig in rigs]).reshape(-1, 4, 4)
            for eye in EYES
        }

    def _is_usable(
        self, eyes_m: Float64[ndarray, "n 3"], points_m: Float64[ndarray, "n 3"], distance_m: float
    ) -> Bool[ndarray, " n"]:
        """Return which eyes are in the space for cameras, clear of steel, and see their points."""
        is_usable = self._cameras.is_clear(eyes_m, steel_clearance_m(distance_m))
        is_usable[is_usable] = self._cameras.sees(eyes_m[is_usable], points_m[is_usable])
        return is_usable

    def _steel_shares(
        self, eye: str, world_from_eye: Float64[ndarray, "n 4 4"], distance_m: float
    ) -> tuple[Float64[ndarray, " n"], Float64[ndarray, " n"]]:
        """Return the shares of an eye's image that are near steel, and steel at about the distance."""
        range_m = self._cameras.ranges_m(world_from_eye, self._rays[eye])
        is_middle = (range_m >= _MIDDLE * distance_m) & (range_m <= _FAR * distance_m)
        return (range_m < NEAR * distance_m).mean(axis=1), is_middle.mean(axis=1)


def _acceptable_views(site: _Site, distance_m: float, count: int, rng: np.random.Generator) -> _Views:
    """Return acceptable views of random points of the steel: several times ``count`` if they are found."""
    found: list[_Views] = []
    for _ in range(-(-max(_MIN_POINTS, _POINTS_PER_VIEW * count) // _BATCH)):
        surface = site.surface.sample(_BATCH, rng)
        points_m = np.round(surface.points_m, _DECIMALS)
        centres_m = np.round(points_m + distance_m * _directions(surface, rng), _DECIMALS)
        found.append(site.acceptable(centres_m, points_m, distance_m))
        if sum(len(views.points_m) for views in found) >= _ACCEPTABLE_PER_VIEW * count:
            break
    views = _Views.joined(found)
    return views[np.unique(views.points_m, axis=0, return_index=True)[1]]


def _directions(surface: SurfacePoints, rng: np.random.Generator) -> Float64[ndarray, "n 3"]:
    """Return unit vectors towards the cameras: the normals with small random changes of azimuth and elevation."""
    x, y, z = surface.normals.T
    azimuth_change, elevation_change = rng.uniform(-1.0, 1.0, (2, len(z)))
    azimuth = np.arctan2(y, x) + np.radians(_AZIMUTH_VARIATION_DEG * azimuth_change)
    elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y))) + _ELEVATION_VARIATION_DEG * elevation_change
    elevation = np.radians(np.clip(elevation_deg, -_MAX_ELEVATION_DEG, _MAX_ELEVATION_DEG))
    across = np.cos(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=1)


def _spread(views: _Views, count: int) -> _Views:
    """Return ``count`` views of points far from each other, ordered along a short path of their cameras.

    Around each of the points farthest from each other, the view with the most steel at about its distance is taken
    within a third of the least distance between them, so that no two points come closer than another third.
    """
    from scipy.spatial import cKDTree  # Imported when needed: it takes a while.

    farthest = views.points_m[farthest_points(views.points_m, count)]
    tree = cKDTree(farthest)
    spacing_m = tree.query(farthest, k=2)[0][:, 1].min() if count > 1 else np.inf
    distance_m, group = tree.query(views.points_m)
    score = np.where(distance_m < spacing_m / 3, views.steel_share, -1.0)
    score[distance_m == 0] = np.maximum(score[distance_m == 0], 0.0)
    best = np.lexsort((-score, group))
    chosen = views[best[np.unique(group[best], return_index=True)[1]]]
    return chosen[short_path(chosen.centres_m)]
