"""A user's own scene: from a TOML file or an IFC model to the config that ``rebar-build --scene`` builds.

The keys of the TOML file are told in ``scene_toml``; an IFC model takes every default.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.catalog import CONFIGS, LATTICE_DOME, SWEEPS
from dataset_builder.config.scene_schema import SceneToml, name_kind, read_scene_toml
from dataset_builder.config.specs import AssemblySpec, ConfigSpec, DomeSpec, SceneSpec
from dataset_builder.config.trajectories import offsets_m
from dataset_builder.scene.assemblies import aim_point_m, check_fits, make_assembly
from dataset_builder.scene.assemblies.cage_file import cage_file_spec
from dataset_builder.scene.assemblies.mesh_file import mesh_file_spec
from dataset_builder.scene.model import Assembly
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.geometry.aruco_board import BoardSpec

TAKEN_NAMES = (*CONFIGS, *SWEEPS, "meshes", "pictures", "scenes")
"""Names a scene cannot have: the other configs' and those of what else the dataset folder holds."""

NEAREST_PER_REACH = 2.5
"""About as the lattice's dome (2.67): from there an assembly is whole in the frame and fills much of it."""

LABORATORY_STEEL_M = 0.45
LABORATORY_CAMERAS_M = 1.6
"""Level distances from the laboratory's middle: things lie on the bench beyond one, furniture stands beyond the
other."""

OUTDOORS_CAMERAS_M = 19.0
"""Level distance from the origin within which the ground outdoors is clear."""

_DEFAULT_MARKERS = {"laboratory": 6, "outdoors": 0}
_NOTHING_SAID = SceneToml(None, 1.0, (), None, None, None, None, None)


def scene_config(path: str | os.PathLike[str]) -> ConfigSpec:
    """Return the config of a scene file, named after it; rig, colour and seed are those of any config.

    What the file leaves open: the cameras are ``default_dome``; the environment is the laboratory where the steel
    stands within 0.45 m of its middle and all cameras within 1.6 m, else outdoors; the board has 6 markers in the
    laboratory and is left out outdoors.

    Raises ``InputError`` for a file that is neither, for every missing, unknown or wrong key at once, for a name
    that cannot be, and where assembly or cameras do not fit; ``MeshError`` where the cage or mesh cannot serve.
    """
    path = Path(path)
    said = _read(path)
    name = path.stem if said.name is None else said.name
    _check_name(name, path)
    assembly_spec = _assembly_spec(said, path)
    assembly = make_assembly(assembly_spec)
    protocol = said.protocol or default_dome(assembly)
    scene = SceneSpec(name, assembly_spec, None, said.environment or "laboratory")
    config = ConfigSpec(name, scene, protocol)
    cameras_m = _camera_distance_m(assembly, config)
    misfit = _laboratory_misfit(assembly, cameras_m)
    environment = said.environment or ("outdoors" if misfit else "laboratory")
    if environment == "laboratory" and misfit:
        raise InputError(f'{path}: {misfit}: stand it at the origin, or choose environment = "outdoors"')
    if cameras_m > OUTDOORS_CAMERAS_M and said.protocol is None:
        raise InputError(
            f"{path}: the cage is too large for the dome that is fitted to it: cameras would stand "
            f"{cameras_m:.4g} m from the world's origin, at most {OUTDOORS_CAMERAS_M} m is clear; is the "
            "unit right, does the cage stand at the origin? Else give [cameras] in a TOML file"
        )
    if cameras_m > OUTDOORS_CAMERAS_M:
        raise InputError(
            f"{path}: cameras stand {cameras_m:.4g} m from the world's origin, expected at most "
            f"{OUTDOORS_CAMERAS_M} m: is the unit right, and does the cage stand at the origin?"
        )
    check_fits(assembly, config)
    markers = _DEFAULT_MARKERS[environment] if said.board is None else said.board
    board = BoardSpec(markers=markers) if markers else None
    return replace(config, scene=replace(scene, environment=environment, board=board))


def default_dome(assembly: Assembly) -> DomeSpec:
    """Return ``LATTICE_DOME`` enlarged for an assembly: 7 radii x 6 elevations x 12 azimuths, 504 views.

    All radii grow by one factor until the nearest is ``NEAREST_PER_REACH`` times the assembly's reach, the
    greatest distance of its surface from the aim point. They never shrink, since the stereo rig does not. Whole
    millimetres.
    """
    reach_m = float(np.linalg.norm(_vertices_m(assembly) - aim_point_m(assembly), axis=1).max())
    factor = max(1.0, NEAREST_PER_REACH * reach_m / min(LATTICE_DOME.radii_m))
    return replace(LATTICE_DOME, radii_m=tuple(round(factor * radius_m, 3) for radius_m in LATTICE_DOME.radii_m))


def _read(path: Path) -> SceneToml:
    suffix = path.suffix.lower()
    if suffix == ".ifc":
        return replace(_NOTHING_SAID, ifc=path.name)
    if suffix != ".toml":
        raise InputError(f"{path}: scenes of kind {suffix!r} are not read, expected .toml or .ifc")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: the scene file cannot be read: {error.strerror or error}") from error
    return read_scene_toml(content, str(path), TAKEN_NAMES)


def _check_name(name: str, path: Path) -> None:
    """Raise ``InputError`` where a scene takes its file's name and no config may have it."""
    kind = name_kind(TAKEN_NAMES)
    try:
        kind.convert(name)
    except ValueError:
        raise InputError(
            f"{path}: the scene would be named {name!r}, expected {kind.expected}: rename the file, "
            "or give a name in a TOML file"
        ) from None


def _assembly_spec(said: SceneToml, path: Path) -> AssemblySpec:
    if said.mesh is not None:
        return mesh_file_spec(str(path.parent / said.mesh), said.unit_m)
    return cage_file_spec(str(path if said.ifc is None else path.parent / said.ifc))


def _camera_distance_m(assembly: Assembly, config: ConfigSpec) -> float:
    """Return how far, on the level, the farthest left camera stands from the world's origin, metres."""
    aim_m = aim_point_m(assembly)
    return max(float(np.linalg.norm((aim_m + offset)[:2])) for offset in offsets_m(config.protocol))


def _laboratory_misfit(assembly: Assembly, cameras_m: float) -> str | None:
    """Return why the laboratory has no room for an assembly and its cameras, or None."""
    steel_m = float(np.linalg.norm(_vertices_m(assembly)[:, :2], axis=1).max())
    if steel_m > LABORATORY_STEEL_M:
        return f"the steel reaches {steel_m:.4g} m from the laboratory's middle, expected {LABORATORY_STEEL_M} m"
    if cameras_m > LABORATORY_CAMERAS_M:
        return f"cameras stand {cameras_m:.4g} m from the laboratory's middle, expected {LABORATORY_CAMERAS_M} m"
    return None


def _vertices_m(assembly: Assembly) -> Float64[ndarray, "n 3"]:
    return np.concatenate([part.mesh.vertices_m for part in assembly.parts])
