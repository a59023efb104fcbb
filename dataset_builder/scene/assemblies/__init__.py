"""Assembly construction: bars and meshes from an assembly spec, with checks against a config's cameras."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import (
    AssemblySpec,
    ConfigSpec,
    GeneratedCageSpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
    RandomViewsSpec,
    SurveySpec,
)
from dataset_builder.config.trajectories import camera_offsets_m
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants import SHADOWS
from dataset_builder.scene.variants.panels import SCREEN_DISTANCE
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, MeshError

if TYPE_CHECKING:
    from dataset_builder.scene.assemblies.cage import Cage

_AIM_POINT_DECIMALS = 3
"""Rounding of the aim point in metres: to the millimetre."""

_BOARD_TOLERANCE_M = 0.001
"""Depth below z = 0 that an assembly may reach, metres."""


def make_assembly(spec: AssemblySpec, cage: Cage | None = None) -> Assembly:
    """Return the bars and meshes of an assembly (world frame, metres); only modules of its kind are imported.

    A user's file is read unless its ``cage`` is given. Raises ``MeshError`` if the file cannot be used, and
    ``ValueError`` if the bars of a generated assembly would collide or not fit.
    """
    if isinstance(spec, LatticeSpec):
        from dataset_builder.scene.assemblies.lattice import lattice_assembly

        return lattice_assembly(spec)
    if isinstance(spec, PileSpec):
        from dataset_builder.scene.assemblies.pile import pile_assembly

        return pile_assembly(spec)
    if isinstance(spec, PierSpec):
        from dataset_builder.scene.assemblies.pier import pier_assembly

        return pier_assembly(spec)
    if isinstance(spec, GeneratedCageSpec):
        from dataset_builder.scene.assemblies.generated import generated_assembly

        return generated_assembly(spec)
    from dataset_builder.scene.assemblies.cage_file import load_cage

    return load_cage(spec, cage)


def assembly_bars(spec: AssemblySpec) -> tuple[Bar, ...]:
    """Return the bars of an assembly; for a generated cage, without making meshes. Raises as ``make_assembly``."""
    if isinstance(spec, GeneratedCageSpec):
        from dataset_builder.scene.assemblies.generated import cage_bars, spec_cage

        return tuple(bar.bar for bar in cage_bars(spec_cage(spec)))
    return make_assembly(spec).bars


def check_fits(assembly: Assembly, config: ConfigSpec) -> None:
    """Check that an assembly stays above the board and clear of the config's cameras.

    Raises ``MeshError`` if it reaches more than 1 mm below z = 0 or as far as the nearest camera, and
    ``InputError`` if the screen of the variant ``shadows`` would be among the cameras. The cameras of a survey
    and random views may be nearer, since each is clear of the steel by itself.
    """
    check_above_ground(assembly, config.name)
    vertices_m, aim_m = assembly.vertices_m, aim_point_m(assembly)
    reach_m = float(np.linalg.norm(vertices_m - aim_m, axis=1).max())
    camera_distances_m = np.linalg.norm(camera_offsets_m(config.protocol, aim_m, assembly.bars), axis=1)
    nearest_m = float(camera_distances_m.min())
    if reach_m >= nearest_m and not isinstance(config.protocol, SurveySpec | RandomViewsSpec):
        raise MeshError(
            f"the assembly extends {reach_m:.4g} m from its centre, expected less than {nearest_m:.4g} m, "
            f"the distance of the nearest camera of {config.name}: is the unit right?"
        )
    _check_shadow_screen(vertices_m, float(camera_distances_m.max()), config)


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


def aim_point_m(assembly: Assembly) -> Float64[ndarray, 3]:
    """Return the point that cameras aim at (world, metres): the steel's bounding-box centre, to the millimetre.

    Rounding keeps ribs and float32 storage from moving the cameras.
    """
    vertices = assembly.vertices_m
    middle: Float64[ndarray, 3] = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.asarray(np.round(middle, _AIM_POINT_DECIMALS) + 0.0)  # Adding 0.0 turns -0.0 into 0.0.
