"""Assembly construction: bars and meshes from an assembly spec, with checks against a config's cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.file_specs import CageFileSpec, MeshFileSpec
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
from dataset_builder.scene.assemblies.cage_file import load_cage
from dataset_builder.scene.assemblies.generated import cage_bars, generated_assembly, spec_cage
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.assemblies.pile import pile_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants.registry import SCREEN_DISTANCE, SHADOWS
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, MeshError

_BUILDERS: Mapping[type, Callable[[Any], Assembly]] = {
    CageFileSpec: load_cage,
    GeneratedCageSpec: generated_assembly,
    LatticeSpec: lattice_assembly,
    MeshFileSpec: load_cage,
    PierSpec: pier_assembly,
    PileSpec: pile_assembly,
}
_AIM_POINT_DECIMALS = 3
"""Rounding of the aim point in metres: to the millimetre."""

_BOARD_TOLERANCE_M = 0.001
"""Depth below z = 0 that an assembly may reach, metres."""


def make_assembly(spec: AssemblySpec) -> Assembly:
    """Return the bars and meshes of an assembly (world frame, metres).

    Raises ``MeshError`` if a user's file cannot be used, ``ValueError`` if the bars of a generated assembly
    would collide or not fit.
    """
    return _BUILDERS[type(spec)](spec)


def assembly_bars(spec: AssemblySpec) -> tuple[Bar, ...]:
    """Return the bars of an assembly; for a generated cage, without making meshes. Raises as ``make_assembly``."""
    if isinstance(spec, GeneratedCageSpec):
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
