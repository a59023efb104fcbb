"""From the description of an assembly to its bars and meshes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import (
    AssemblySpec,
    CageFileSpec,
    ConfigSpec,
    LatticeSpec,
    MeshFileSpec,
    PierSpec,
    PileSpec,
)
from dataset_builder.config.trajectories import offsets_m
from dataset_builder.scene.assemblies.cage_file import load_cage
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.assemblies.mesh_file import load_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.assemblies.pile import pile_assembly
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants import SHADOWS
from dataset_builder.scene.variants.panels import DISTANCE
from rebar_depth_bench.errors import InputError, MeshError

_MAKERS: Mapping[type, Callable[[Any], Assembly]] = {
    CageFileSpec: load_cage,
    LatticeSpec: lattice_assembly,
    MeshFileSpec: load_assembly,
    PierSpec: pier_assembly,
    PileSpec: pile_assembly,
}
_TARGET_DECIMALS = 3
_BELOW_BOARD_M = 0.001


def make_assembly(spec: AssemblySpec) -> Assembly:
    """Return the bars and meshes of an assembly; raise ``MeshError`` where a user's file cannot serve."""
    return _MAKERS[type(spec)](spec)


def check_fits(assembly: Assembly, config: ConfigSpec) -> None:
    """Raise ``MeshError`` where an assembly reaches below the board or out to the config's nearest camera."""
    vertices_m = assembly.vertices_m
    lowest = min(assembly.parts, key=lambda part: float(part.mesh.vertices_m[:, 2].min()))
    lowest_m = float(lowest.mesh.vertices_m[:, 2].min())
    if lowest_m < -_BELOW_BOARD_M:
        raise MeshError(
            f"{config.name}: {lowest.name} reaches down to z = {lowest_m:.4g} m, ribs and all, expected 0 or "
            "above, where the board or the ground is"
        )
    reach_m = float(np.linalg.norm(vertices_m - aim_point_m(assembly), axis=1).max())
    nearest_m = min(float(np.linalg.norm(offset)) for offset in offsets_m(config.protocol))
    if reach_m >= nearest_m:
        raise MeshError(
            f"the assembly reaches {reach_m:.4g} m from its middle, expected less than the {nearest_m:.4g} m "
            f"at which the cameras of {config.name} stand: is the unit right?"
        )
    _check_screen(vertices_m, config)


def _check_screen(vertices_m: Float64[ndarray, "n 3"], config: ConfigSpec) -> None:
    """Raise ``InputError`` where the screen of the variant ``shadows`` would hang among the cameras."""
    if SHADOWS not in config.scene.appearance.variants:
        return
    farthest_m = max(float(np.linalg.norm(offset)) for offset in offsets_m(config.protocol))
    right_eye_m = float(np.hypot(farthest_m, config.rig.baseline_m))
    screen_m = DISTANCE * float(np.linalg.norm(np.ptp(vertices_m, axis=0))) / 2
    if right_eye_m >= screen_m:
        raise InputError(
            f"the screen of the variant {SHADOWS!r} would hang {screen_m:.4g} m from the steel, expected it "
            f"beyond the cameras of {config.name}, which stand up to {right_eye_m:.4g} m from it"
        )


def aim_point_m(assembly: Assembly) -> Float64[ndarray, 3]:
    """Return what cameras look at: the middle of the steel's bounding box, to the millimetre.

    Rounding keeps ribs and float32 storage from moving the cameras.
    """
    vertices = assembly.vertices_m
    middle: Float64[ndarray, 3] = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.asarray(np.round(middle, _TARGET_DECIMALS) + 0.0)  # no negative zero
