"""Checks that an assembly and its cameras fit each other and their environment. World frame, metres."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import Cylinders, aim_point_m, camera_offsets_m, poses
from dataset_builder.scene.environments.surroundings import (
    GROUND_CLEARANCE_M,
    LIFE_SIZE_ENVIRONMENTS,
    SURROUNDINGS,
)
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants.formwork import SHEET_M, form_sheet, world_from_form
from dataset_builder.scene.variants.registry import SCREEN_DISTANCE, SHADOWS
from dataset_builder.specs.config_specs import (
    ConfigSpec,
    FormSpec,
    PosesSpec,
    RandomViewsSpec,
    SurveySpec,
    TrajectorySpec,
)
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.data.bars import with_axis
from rebar_depth_bench.data.schema import EYES
from rebar_depth_bench.geometry.cameras import camera_centre, inverse_rigid, transform

_BOARD_TOLERANCE_M = 0.001
"""Depth below z = 0 that an assembly may reach, metres."""


def check_fits(assembly: Assembly, config: ConfigSpec) -> None:
    """Check that an assembly stays above the board and clear of the config's cameras.

    Raises ``MeshError`` if it reaches more than 1 mm below z = 0 or as far as the nearest camera, and
    ``InputError`` if the screen of the variant ``shadows`` would be among the cameras, if an eye is inside of a
    bar or not above the ground, if a form is below the ground or at a camera, and as ``look_at_with_rig``. The
    cameras of a survey, random views and given poses may be nearer, since each eye is tested by itself.
    """
    check_above_ground(assembly, config.name)
    vertices_m, aim_m = assembly.vertices_m, aim_point_m(assembly)
    reach_m = float(np.linalg.norm(vertices_m - aim_m, axis=1).max())
    try:
        lefts = poses(config.protocol, aim_m, config.rig, assembly.bars)
    except InputError as error:
        raise InputError(f"{config.name}: {error}") from None
    # In the frame of the physical left camera, which rectification does not move.
    centres_m = [camera_centre(eye.cam_from_world) for eye in rig_cameras(config.rig, np.eye(4)).values()]
    eyes_m = np.concatenate([transform(inverse_rigid(left), np.array(centres_m)) for left in lefts])
    camera_distances_m = np.linalg.norm(eyes_m[:: len(EYES)] - aim_m, axis=1)
    nearest_m = float(camera_distances_m.min())
    if reach_m >= nearest_m and not isinstance(config.protocol, SurveySpec | RandomViewsSpec | PosesSpec):
        raise MeshError(
            f"the assembly extends {reach_m:.4g} m from its centre, expected less than {nearest_m:.4g} m, "
            f"the distance of the nearest camera of {config.name}: is the unit right?"
        )
    in_box = ((eyes_m >= vertices_m.min(axis=0)) & (eyes_m <= vertices_m.max(axis=0))).all(axis=1)
    in_steel = np.zeros(len(eyes_m), bool)
    if in_box.any() and with_axis(assembly.bars):
        in_steel[in_box] = Cylinders.from_bars(assembly.bars).distance_m(eyes_m[in_box]) == 0
    for found, is_refused in (("not above the ground", eyes_m[:, 2] <= 0), ("inside of a bar", in_steel)):
        if is_refused.any():
            view, eye = divmod(int(is_refused.argmax()), len(EYES))
            raise InputError(
                f"the {EYES[eye]} camera of view {view + 1} of {config.name} is {found}, at "
                f"{np.round(eyes_m[2 * view + eye], 4).tolist()} m, expected above z = 0 and outside of the steel"
            )
    _check_shadow_screen(vertices_m, float(camera_distances_m.max()), config)
    if config.scene.forms and "formwork" in config.scene.appearance.variants:
        found = f"{config.name}: the variant 'formwork' adds panels to a scene with [[form]] tables"
        raise InputError(f"{found}, expected one of both")
    for form in config.scene.forms:
        where = f"{config.name}: the sheet of form {form.name!r}"
        lowest_m = float(form_sheet(form).mesh.vertices_m[:, 2].min())
        if lowest_m < -_BOARD_TOLERANCE_M:
            raise InputError(
                f"{where}, {SHEET_M:g} m thick, extends down to z = {lowest_m:.4g} m, expected 0 or above (the "
                "ground is at z = 0): place form and steel higher"
            )
        from_middle_m = (eyes_m - form.point_m) @ world_from_form(form) + [0, 0, SHEET_M / 2]
        outside_m = np.maximum(np.abs(from_middle_m) - [*np.divide(form.size_m, 2), SHEET_M / 2], 0.0)
        distance_m = np.linalg.norm(outside_m, axis=1)
        nearest = int(distance_m.argmin())
        if distance_m[nearest] < GROUND_CLEARANCE_M:
            raise InputError(
                f"{where} is {distance_m[nearest]:.4g} m from a camera of view {nearest // 2 + 1}, expected "
                f"{GROUND_CLEARANCE_M:g} m or more: move the form or the [cameras]"
            )


def check_above_ground(assembly: Assembly, where: str) -> None:
    """Raise ``MeshError``, which begins with ``where``, if an assembly reaches more than 1 mm below z = 0."""
    lowest = min(assembly.parts, key=lambda part: float(part.mesh.vertices_m[:, 2].min()))
    lowest_m = float(lowest.mesh.vertices_m[:, 2].min())
    if lowest_m < -_BOARD_TOLERANCE_M:
        raise MeshError(
            f"{where}: {lowest.name} extends down to z = {lowest_m:.4g} m, including its ribs, expected 0 "
            "or above (the board or the ground is at z = 0)"
        )


def _check_shadow_screen(vertices_m: Float64[ndarray, "n 3"], farthest_m: float, config: ConfigSpec) -> None:
    """Raise ``InputError`` if the screen of the variant ``shadows`` would be among the cameras."""
    if SHADOWS not in config.scene.appearance.variants:
        return
    right_eye_m = float(np.hypot(farthest_m, config.rig.baseline_m))
    screen_m = SCREEN_DISTANCE * float(np.linalg.norm(np.ptp(vertices_m, axis=0))) / 2
    if right_eye_m >= screen_m:
        raise InputError(
            f"the screen of the variant {SHADOWS!r} would be among the cameras: {screen_m:.4g} m from the steel, "
            f"expected more than {right_eye_m:.4g} m, the distance of the farthest camera of {config.name}"
        )


def misfit(
    environment: str, assembly: Assembly, trajectory: TrajectorySpec, forms: Sequence[FormSpec] = ()
) -> str | None:
    """Return why the assembly, its forms or its cameras do not fit into an environment, or None if they do.

    A survey has no stations yet: in an environment for life-size steel its cameras are placed where they fit, in
    the laboratory all places that they could have must fit.
    """
    steel_radius_m = float(np.linalg.norm(assembly.vertices_m[:, :2], axis=1).max())
    limit_m = SURROUNDINGS[environment].steel_radius_m
    if steel_radius_m > limit_m:
        return _outside("the steel extends", steel_radius_m, limit_m, environment)
    for form in forms:
        radius_m = float(np.linalg.norm(form_sheet(form).mesh.vertices_m[:, :2], axis=1).max())
        if radius_m > limit_m:
            return _outside(f"form {form.name!r} extends", radius_m, limit_m, environment)
    space = SURROUNDINGS[environment].cameras
    if isinstance(trajectory, SurveySpec):
        if environment in LIFE_SIZE_ENVIRONMENTS:
            return None
        radius_m, height_m = steel_radius_m + max(trajectory.distances_m), 0.0
    else:
        aim_m = aim_point_m(assembly)
        centres_m = aim_m + np.array(camera_offsets_m(trajectory, aim_m, assembly.bars))
        radius_m = float(np.linalg.norm(centres_m[:, :2], axis=1).max())
        height_m = float(centres_m[:, 2].max())
    if radius_m > space.radius_m:
        return _outside("cameras are", radius_m, space.radius_m, environment)
    if height_m > space.ceiling_m:
        return (
            f"cameras are {height_m:.4g} m high, "
            f"expected at most {space.ceiling_m:g} m in the environment {environment}"
        )
    return None


def _outside(what: str, radius_m: float, limit_m: float, environment: str) -> str:
    return (
        f"{what} {radius_m:.4g} m from the world's origin, "
        f"expected at most {limit_m:g} m in the environment {environment}"
    )
