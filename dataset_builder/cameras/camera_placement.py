"""Placement of the cameras of surveys and of random views of steel. World frame, metres.

Random points of the steel's surface are tried, each with a random direction near the normal there. A view is
acceptable if both eyes are clear of steel, see the point, and have little steel near to them (``ViewRules``). A
random view must have a scored pixel as well. A survey keeps the acceptable views that are farthest apart, of those
with a scored pixel if they are enough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Shaped
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import look_at_with_rig
from dataset_builder.scene.environments.surroundings import GROUND_CLEARANCE_M, CameraSpace
from dataset_builder.scene.model import NOT_STEEL, Assembly, Part
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.point_sets import SurfaceSampler, covering_points, farthest_points, short_path
from dataset_builder.scene.shapes.solids import merge_meshes, world_mesh
from dataset_builder.specs.config_specs import RandomViewsSpec, RigSpec, RolledStation, Station, SurveySpec
from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.data.schema import EYES
from rebar_depth_bench.geometry.cameras import inverse_rigid

NEAR = 0.5
"""Part of the distance of a view within which steel is near, and which an eye keeps from steel at close range."""


@dataclass(frozen=True)
class ViewRules:
    """Rules for acceptable views; shares are those of a ``grid`` (columns, rows) of pixels of an eye's image.

    An eye is at least ``max_clearance_m`` from steel, or half the distance of the view if that is less. Near steel
    covers at most ``max_near_share`` of each image, and steel at least ``min_steel_share``.
    """

    max_clearance_m: float
    max_near_share: float
    min_steel_share: float
    grid: tuple[int, int]

    def clearance_m(self, distance_m: float | Float64[ndarray, " n"]) -> Any:
        """Return the least distance from steel of the eyes of views at distances of the same shape."""
        return np.minimum(self.max_clearance_m, NEAR * distance_m)


SURVEY_RULES = ViewRules(0.3, max_near_share=0.02, min_steel_share=0.0, grid=(32, 18))
RANDOM_RULES = ViewRules(0.15, max_near_share=0.1, min_steel_share=0.02, grid=(48, 27))

SIGHT_TOLERANCE_M = 0.01
"""Largest distance along the line of sight between its first hit and the point in sight: about a bar's radius."""

_MIDDLE, _FAR = 0.75, 1.5
"""Multiple of the distance up to which steel counts for the choice between views of a survey."""

_SURVEY_TURNS_DEG = (20.0, 15.0)
_SURVEY_ELEVATIONS_DEG = (-80.0, 80.0)
_RANDOM_TURN_DEG = 60.0
_RANDOM_ELEVATIONS_DEG = (-20.0, 80.0)
"""Largest deviations of a view's azimuth and elevation from the surface normal, and the range of its elevation.

No elevation is vertical, since the picture's up direction is that of the world.
"""

MAX_ROLL_DEG = 20.0
UPRIGHT_SHARE = 0.1
"""Largest roll of a random view, and the share that is turned by a further 90 degrees, upright pictures."""

MAX_AIM_OFFSET = 0.25
"""Largest offset of the aim of a random view from the steel, along each side of the image, per distance."""

_DECIMALS = 6
_ROLL_DECIMALS = 2
"""Rounding of stations in metres and of rolls in degrees, so that they are equal on every machine."""

_SURVEY_CLEARANCE_PER_SPACING = 5
_RANDOM_SPACING_M = 0.02
"""Largest distance of a point of a surface from those that distances of eyes are measured to.

In a survey it follows from the clearance of the nearest views.
"""

_SURVEY_BATCH = 2048
_ACCEPTABLE_PER_VIEW = 16
_POINTS_PER_VIEW = 256
_MIN_POINTS = 8 * _SURVEY_BATCH
"""Points that are tried at once for a survey, and in all; and acceptable views per view that are enough."""

_RANDOM_BATCH = 64
_RANDOM_BATCHES = 40
"""Views that are tried at once for each random view, and how often."""


@dataclass(frozen=True, eq=False)
class _Views:
    """Views: point of the steel, left camera centre, point aimed at, roll, and distance from the steel."""

    steel_m: Float64[ndarray, "n 3"]
    centres_m: Float64[ndarray, "n 3"]
    aimed_m: Float64[ndarray, "n 3"]
    roll_deg: Float64[ndarray, " n"]
    distance_m: Float64[ndarray, " n"]
    middle_share: Float64[ndarray, " n"]
    """Share of both images with steel at about the distance, 0 until a site has accepted the views."""
    is_scored: Bool[ndarray, " n"]
    """Whether the left image is known to have a scored pixel, False until a site has accepted the views."""

    def __getitem__(self, index: Any) -> _Views:
        return _Views(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def joined(cls, views: Sequence[_Views]) -> _Views:
        """Return the views of all items."""
        return cls(*(np.concatenate([getattr(item, field.name) for item in views]) for field in fields(cls)))

    def stations(self) -> list[RolledStation]:
        """Return the views as stations."""
        places = zip(self.centres_m.tolist(), self.aimed_m.tolist(), self.roll_deg.tolist(), strict=True)
        return [((cx, cy, cz), (ax, ay, az), roll_deg) for (cx, cy, cz), (ax, ay, az), roll_deg in places]


class _Site:
    """Steel of an assembly and ``obstacles``, with the space for cameras: tests of views of a rig.

    Lenses are taken as pinholes. Distances of eyes are to points of the surfaces of which one is within
    ``spacing_m`` of every point. ``surface`` samples the steel.
    """

    def __init__(
        self,
        assembly: Assembly,
        space: CameraSpace,
        rig: RigSpec,
        rules: ViewRules,
        spacing_m: float,
        obstacles: Sequence[Part] = (),
    ) -> None:
        from scipy.spatial import cKDTree  # Imported when needed: it takes a while.

        self.surface = SurfaceSampler(merge_meshes([part.mesh for part in assembly.parts]))
        parts = (*assembly.parts, *obstacles)
        surfaces = world_mesh([part.mesh for part in parts], [part.bar_id for part in parts])
        self._caster = RayCaster(surfaces)
        self._points = cKDTree(covering_points(surfaces, spacing_m))
        self._space, self._rules, self._spacing_m = space, rules, spacing_m
        sides = zip(rules.grid, (rig.width, rig.height), strict=True)
        places = [np.clip((np.arange(n) + 0.5) * side / n, 1, side - 2) for n, side in sides]
        self._rig, self._K = rig, rig_cameras(rig, np.eye(4))["left"].K
        self._blocks = self._block_rays(np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2).astype(int))

    def accepted(self, views: _Views) -> _Views:
        """Return the acceptable ones of the views."""
        views = views[self._is_usable(views.centres_m, views)]
        poses = self._world_from_eyes(views)
        chosen = self._is_usable(poses["right"][:, :3, 3], views)
        views = views[chosen]
        distance_m = views.distance_m[:, None]
        is_accepted, middle_shares = np.ones(len(distance_m), bool), []
        ranges_m = {eye: self._ranges_m(poses[eye][chosen], self._blocks[:, 4]) for eye in EYES}
        for range_m in ranges_m.values():
            is_accepted &= (range_m < NEAR * distance_m).mean(axis=1) <= self._rules.max_near_share
            is_accepted &= np.isfinite(range_m).mean(axis=1) >= self._rules.min_steel_share
            is_middle = (range_m >= _MIDDLE * distance_m) & (range_m <= _FAR * distance_m)
            middle_shares.append(is_middle.mean(axis=1))
        views = replace(views, middle_share=np.mean(middle_shares, axis=0))[is_accepted]
        is_steel = np.isfinite(ranges_m["left"][is_accepted])
        is_scored = self._has_scored_pixel(views, poses["left"][chosen][is_accepted], is_steel)
        return replace(views, is_scored=is_scored)

    def _has_scored_pixel(
        self, views: _Views, world_from_left: Float64[ndarray, "n 4 4"], is_steel: Bool[ndarray, "n g"]
    ) -> Bool[ndarray, " n"]:
        """Return which views have steel all round the pixel of their point, or one of the grid that is steel."""
        view, place = np.nonzero(is_steel)
        in_eye_m = np.einsum("nji,nj->ni", world_from_left[:, :3, :3], views.steel_m - world_from_left[:, :3, 3])
        own = self._block_rays(np.round((in_eye_m / in_eye_m[:, 2:] @ self._K.T)[:, :2]))
        view, rays = np.append(view, np.arange(len(own))), np.concatenate([self._blocks[place], own])
        directions = np.einsum("nij,nrj->nri", world_from_left[view, :3, :3], rays)
        origins_m = np.repeat(world_from_left[view, :3, 3], rays.shape[1], axis=0)
        bar_id = self._caster.bar_ids(origins_m, directions.reshape(-1, 3)).reshape(rays.shape[:2])
        is_scored = np.zeros(len(is_steel), bool)
        is_scored[view[(bar_id != NOT_STEEL).all(axis=1)]] = True
        return is_scored

    def _block_rays(self, pixels: Shaped[ndarray, "n 2"]) -> Float64[ndarray, "n 9 3"]:
        """Return the rays of the 3 x 3 pixels round each pixel (x, y), row by row, in the frame of an eye."""
        v, u = np.indices((3, 3)).reshape(2, 9) - 1
        x = (pixels[:, :1] + u - self._K[0, 2]) / self._K[0, 0]
        y = (pixels[:, 1:] + v - self._K[1, 2]) / self._K[1, 1]
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def _world_from_eyes(self, views: _Views) -> dict[str, Float64[ndarray, "n 4 4"]]:
        stations = zip(views.centres_m, views.aimed_m, views.roll_deg, strict=True)
        poses = [look_at_with_rig(c, aimed, self._rig.baseline_m, roll) for c, aimed, roll in stations]
        rigs = [rig_cameras(self._rig, pose) for pose in poses]
        return {
            eye: np.array([inverse_rigid(rig[eye].cam_from_world) for rig in rigs]).reshape(-1, 4, 4)
            for eye in EYES
        }

    def _is_usable(self, eyes_m: Float64[ndarray, "n 3"], views: _Views) -> Bool[ndarray, " n"]:
        """Return which eyes, one of each view, are in the space for cameras, clear of steel, and see it."""
        is_usable = self._space.contains(eyes_m)
        least_m = self._rules.clearance_m(views.distance_m[is_usable]) + self._spacing_m
        farthest_m = float(least_m.max(initial=self._spacing_m))
        nearest_m, _ = self._points.query(eyes_m[is_usable], distance_upper_bound=farthest_m)
        is_usable[is_usable] = nearest_m >= least_m
        # A point is in sight where the line of sight first meets a surface.
        sight_m = views.steel_m[is_usable] - eyes_m[is_usable]
        range_m = self._caster.hits(eyes_m[is_usable], sight_m).range_m
        is_usable[is_usable] = np.abs(range_m - np.linalg.norm(sight_m, axis=1)) <= SIGHT_TOLERANCE_M
        return is_usable

    def _ranges_m(
        self, world_from_eye: Float64[ndarray, "n 4 4"], rays: Float64[ndarray, "r 3"]
    ) -> Float64[ndarray, "n r"]:
        """Return the distance along each ray (frame of the eye) to steel, infinite where none is in sight."""
        directions = np.einsum("nij,rj->nri", world_from_eye[:, :3, :3], rays)
        origins_m = np.repeat(world_from_eye[:, :3, 3], len(rays), axis=0)
        hits = self._caster.hits(origins_m, directions.reshape(-1, 3))
        return np.asarray(np.where(hits.bar_id == NOT_STEEL, np.inf, hits.range_m).reshape(-1, len(rays)))


def with_stations(
    survey: SurveySpec,
    assembly: Assembly,
    space: CameraSpace,
    rig: RigSpec,
    where: str,
    obstacles: Sequence[Part] = (),
) -> SurveySpec:
    """Return the survey with its stations, by distance and then along short paths.

    Of the acceptable views of a distance, those are taken whose points are farthest from each other, and each of
    them gives way to the acceptable view near it that shows the most steel. ``obstacles`` are avoided as steel is.

    Raises ``InputError`` that names ``where``, the file of the scene, and every distance at which fewer views than
    requested are acceptable.
    """
    spacing_m = SURVEY_RULES.clearance_m(min(survey.distances_m)) / _SURVEY_CLEARANCE_PER_SPACING
    site = _Site(assembly, space, rig, SURVEY_RULES, spacing_m, obstacles)
    stations: list[Station] = []
    problems: list[Problem] = []
    for number, distance_m in enumerate(survey.distances_m):
        rng = np.random.default_rng([survey.seed, number])
        views = _survey_views(site, distance_m, survey.views_per_distance, rng)
        if len(views.steel_m) < survey.views_per_distance:
            found = f"{len(views.steel_m)} survey views can be placed {distance_m:g} m from the steel"
            expected = (
                f"{survey.views_per_distance}: elsewhere, a camera would be within "
                f"{SURVEY_RULES.clearance_m(distance_m):g} m of steel or {GROUND_CLEARANCE_M:g} m of the ground, "
                f"more than {space.radius_m:g} m from the world's origin, or its view would be blocked. Choose "
                "other distances or fewer views_per_distance"
            )
            problems.append(Problem("conflict", "cameras", found, expected))
        else:
            spread = _spread(views, survey.views_per_distance)
            stations += [(centre_m, aimed_m) for centre_m, aimed_m, _ in spread.stations()]
    if problems:
        raise InputError.from_problems(where, problems)
    return replace(survey, stations=tuple(stations))


def _survey_views(site: _Site, distance_m: float, count: int, rng: np.random.Generator) -> _Views:
    """Return acceptable views of random points of steel, several times ``count`` if found, scored if enough."""
    turns_deg = np.array(_SURVEY_TURNS_DEG)[:, None]
    found: list[_Views] = []
    for _ in range(-(-max(_MIN_POINTS, _POINTS_PER_VIEW * count) // _SURVEY_BATCH)):
        surface = site.surface.sample(_SURVEY_BATCH, rng)
        turn_deg, rise_deg = turns_deg * rng.uniform(-1.0, 1.0, (2, _SURVEY_BATCH))
        direction = _directions(surface.normals, turn_deg, rise_deg, _SURVEY_ELEVATIONS_DEG)
        steel_m = np.round(surface.points_m, _DECIMALS)
        centres_m = np.round(steel_m + distance_m * direction, _DECIMALS)
        none = np.zeros(_SURVEY_BATCH)
        views = _Views(steel_m, centres_m, steel_m, none, np.full(_SURVEY_BATCH, distance_m), none, none > 0)
        found.append(site.accepted(views))
        if sum(np.count_nonzero(views.is_scored) for views in found) >= _ACCEPTABLE_PER_VIEW * count:
            break
    views = _Views.joined(found)
    views = views[np.unique(views.steel_m, axis=0, return_index=True)[1]]
    return views[views.is_scored] if np.count_nonzero(views.is_scored) >= count else views


def _spread(views: _Views, count: int) -> _Views:
    """Return ``count`` views of points far from each other, ordered along a short path of their cameras.

    Around each of the points farthest from each other, the view with the most steel at about its distance is taken
    within a third of the least distance between them, so that no two points come closer than another third.
    """
    from scipy.spatial import cKDTree  # Imported when needed: it takes a while.

    farthest = views.steel_m[farthest_points(views.steel_m, count)]
    tree = cKDTree(farthest)
    spacing_m = tree.query(farthest, k=2)[0][:, 1].min() if count > 1 else np.inf
    distance_m, group = tree.query(views.steel_m)
    score = np.where(distance_m < spacing_m / 3, views.middle_share, -1.0)
    score[distance_m == 0] = np.maximum(score[distance_m == 0], 0.0)
    best = np.lexsort((-score, group))
    chosen = views[best[np.unique(group[best], return_index=True)[1]]]
    return chosen[short_path(chosen.centres_m)]


def with_random_stations(
    views: RandomViewsSpec,
    assembly: Assembly,
    space: CameraSpace,
    rig: RigSpec,
    where: str,
    obstacles: Sequence[Part] = (),
) -> RandomViewsSpec:
    """Return random views with their stations: varied distance, direction, aim and roll.

    Each view has its own random numbers, so that it does not depend on how many views there are. It has a scored
    pixel in the images of the rig. No eye is in or near one of the ``obstacles``. Raises ``InputError``, which
    names ``where``, if a view cannot be placed.
    """
    site = _Site(assembly, space, rig, RANDOM_RULES, _RANDOM_SPACING_M, obstacles)
    return replace(
        views, stations=tuple(_random_station(views, number, site, where) for number in range(views.views))
    )


def _random_station(views: RandomViewsSpec, number: int, site: _Site, where: str) -> RolledStation:
    rng = np.random.default_rng([views.seed, number])
    for _ in range(_RANDOM_BATCHES):
        accepted = site.accepted(_random_views(site, views.distances_m, rng))
        if accepted.is_scored.any():
            return accepted[accepted.is_scored][:1].stations()[0]
    low_m, high_m = views.distances_m
    problem = Problem(
        "conflict",
        f"view {number}",
        f"none of {_RANDOM_BATCH * _RANDOM_BATCHES} random views {low_m:g} to {high_m:g} m from the steel is "
        "clear of it, sees it with both eyes, and has a scored pixel",
        "steel that can be seen from outside, and images that are large enough",
    )
    raise InputError.from_problems(where, [problem])


def _random_views(site: _Site, distances_m: tuple[float, float], rng: np.random.Generator) -> _Views:
    """Return random views of points of the steel, at distances that are uniform in their logarithm."""
    n = _RANDOM_BATCH
    surface = site.surface.sample(n, rng)
    low_m, high_m = distances_m
    distance_m = np.exp(rng.uniform(np.log(low_m), np.log(high_m), n))
    turn_deg, rise_deg = rng.uniform(-_RANDOM_TURN_DEG, _RANDOM_TURN_DEG, (2, n))
    direction = _directions(surface.normals, turn_deg, rise_deg, _RANDOM_ELEVATIONS_DEG)
    steel_m = np.round(surface.points_m, _DECIMALS)
    centres_m = np.round(steel_m + distance_m[:, None] * direction, _DECIMALS)
    across = np.cross(direction, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    upwards = np.cross(across, direction)
    u, v = rng.uniform(-MAX_AIM_OFFSET, MAX_AIM_OFFSET, (2, n, 1))
    aimed_m = np.round(steel_m + distance_m[:, None] * (u * across + v * upwards), _DECIMALS)
    turns_deg = 90.0 * (rng.random(n) < UPRIGHT_SHARE) * np.where(rng.random(n) < 0.5, 1.0, -1.0)
    roll_deg = np.round(rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG, n) + turns_deg, _ROLL_DECIMALS)
    return _Views(steel_m, centres_m, aimed_m, roll_deg, distance_m, np.zeros(n), np.zeros(n, bool))


def _directions(
    normals: Float64[ndarray, "n 3"],
    turn_deg: Float64[ndarray, " n"],
    rise_deg: Float64[ndarray, " n"],
    elevations_deg: tuple[float, float],
) -> Float64[ndarray, "n 3"]:
    """Return unit vectors towards the cameras: the normals with changes of azimuth and elevation."""
    x, y, z = normals.T
    azimuth = np.arctan2(y, x) + np.radians(turn_deg)
    elevation = np.radians(np.clip(np.degrees(np.arctan2(z, np.hypot(x, y))) + rise_deg, *elevations_deg))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
