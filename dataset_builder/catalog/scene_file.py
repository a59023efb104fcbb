"""Configs from user scene files (TOML files or IFC models) for ``rebar-build --scene``.

The keys of the TOML file are documented in ``scene_schema``. An IFC model uses the default of every key.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dataset_builder.cameras.camera_fit import check_above_ground, check_fits, misfit
from dataset_builder.cameras.camera_placement import with_stations
from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m
from dataset_builder.catalog.cages_config import CAGES
from dataset_builder.catalog.named_configs import CONFIGS, LATTICE_DOME, SWEEPS
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.variants.formwork import form_sheet
from dataset_builder.specs.config_specs import ConfigSpec, DomeSpec, RigSpec, SceneSpec, SurveySpec
from dataset_builder.specs.file_specs import CageFileSpec, MeshFileSpec
from dataset_builder.user_files.cage_file import cage_file_spec, mesh_file_spec, read_cage, unsupported_type
from dataset_builder.user_files.make_assembly import make_assembly
from dataset_builder.user_files.mesh_import import SUFFIXES as MESH_SUFFIXES
from dataset_builder.user_files.scene_schema import SCENE_NAME, SceneToml, read_scene_toml
from rebar_depth_bench.base.errors import InputError, MeshError
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import read_file
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import NOMINAL_FOCAL_PX, NOMINAL_HEIGHT, NOMINAL_WIDTH

RESERVED_NAMES = (*CONFIGS, *SWEEPS, CAGES, "bars", "crossings", "meshes", "pictures", "scenes")
"""Names that a user scene cannot have: names of configs, of tables and of other entries of the dataset folder."""

NEAREST_RADIUS_PER_REACH = 2.5
"""Nearest dome radius per reach of the assembly, close to the value of the lattice dome (2.67).

At this distance the whole assembly is in the frame of the default rig and fills much of it. For another rig,
it is multiplied by the ratio of the focal lengths per side of the image, of the side that shows less.
"""

MAX_DOME_M = 1.0
"""Largest radius of a default dome, metres: from farther away, thin bars have hardly a scored pixel."""

_SMALL, _LARGE = "laboratory", "outdoors"
"""Environment of steel and cameras that fit in it, and of others."""

_ADVICE_OF_ROOMS = f'place the cage at the origin, or set environment = "{_LARGE}"'
_ADVICE = (
    "is the unit right, and is the cage at the origin? [[select]] tables choose a part of an IFC or mesh file"
)


@dataclass(frozen=True, eq=False)
class UserScene:
    """Scene of a user's file: its config, and the cage that was read from the file."""

    config: ConfigSpec
    cage: Cage


def read_scene(path: str | os.PathLike[str]) -> UserScene:
    """Return the config of a scene file, with the default colour settings and seed, and its cage.

    Defaults of omitted keys: the name is the file name in lower case, with hyphens; the cameras are
    ``default_dome``, or a survey if that exceeds ``MAX_DOME_M``; the environment is the laboratory if all steel is
    within 0.45 m and all cameras are within 1.6 m of its centre (wherever a survey places them), otherwise
    outdoors; the board has 6 markers in the laboratory without forms, and there is no board otherwise; the rig is
    ``RigSpec()``.

    Raises ``InputError`` if the file is neither TOML nor IFC, listing every missing, unknown or invalid key, for
    an invalid name, and if the assembly or the cameras do not fit. Raises ``MeshError`` if the cage or mesh is
    unusable.
    """
    path = Path(path)
    scene_toml = _read_scene(path)
    name = scene_name_of(path) if scene_toml.name is None else scene_toml.name
    if name in RESERVED_NAMES or not SCENE_NAME.accept(name):
        raise InputError(
            f"{path}: the scene would be named {name!r}, expected {SCENE_NAME.text}, none of "
            f"{', '.join(RESERVED_NAMES)}: rename the file, or set its name in a TOML file"
        )
    with _scene_and_key_named(scene_toml, path):
        assembly_spec = _assembly_spec(scene_toml, path)
        cage = read_cage(assembly_spec)
        assembly = make_assembly(assembly_spec, cage)
    rig = RigSpec() if scene_toml.rig is None else scene_toml.rig.rig(path, scene_toml.unit_m, "rig")
    trajectory = scene_toml.cameras or _default_trajectory(assembly, scene_toml.environment, rig)
    forms = scene_toml.forms
    environment = scene_toml.environment or (_LARGE if misfit(_SMALL, assembly, trajectory, forms) else _SMALL)
    if problem := misfit(environment, assembly, trajectory, forms):
        raise InputError(f"{path}: {problem}: {_ADVICE if environment == _LARGE else _ADVICE_OF_ROOMS}")
    try:
        check_above_ground(assembly, name)
        if isinstance(trajectory, SurveySpec):
            space = SURROUNDINGS[environment].cameras
            sheets = [form_sheet(form) for form in forms]
            trajectory = with_stations(trajectory, assembly, space, rig, str(path), sheets)
        scene = SceneSpec(name, assembly_spec, None, environment, forms=forms)
        config = ConfigSpec(name, scene, trajectory, rig)
        check_fits(assembly, config)
    except InputError as error:
        if error.problems:  # They are of this file.
            raise
        raise type(error)(f"{path}: {error}") from None
    markers = (0 if forms else SURROUNDINGS[environment].markers) if scene_toml.board is None else scene_toml.board
    board = BoardSpec(markers=markers) if markers else None
    return UserScene(replace(config, scene=replace(config.scene, board=board)), cage)


def scene_cage(path: str | os.PathLike[str], mesh_unit: str | float = "m") -> Cage:
    """Return the bars of a scene file or of a mesh file, placed in the world frame, with what they leave out.

    A mesh file is in the unit ``mesh_unit`` and keeps its coordinates, as with ``--mesh``. Raises ``InputError``
    and ``MeshError`` as ``read_scene`` where a file cannot be read; reasons for which a build refuses the bars
    are in ``Cage.problems``.
    """
    path = Path(path)
    if path.suffix.lower() in MESH_SUFFIXES:
        return read_cage(mesh_file_spec(path, mesh_unit))
    scene_toml = _read_scene(path)
    with _scene_and_key_named(scene_toml, path):
        return replace(read_cage(_assembly_spec(scene_toml, path)), forms=scene_toml.forms)


def files_of_scene(path: str | os.PathLike[str]) -> list[Path]:
    """Return a scene file and the file that it names. Raises ``InputError`` as ``read_scene``."""
    path = Path(path)
    if path.suffix.lower() in MESH_SUFFIXES:
        return [path]
    scene_toml = _read_scene(path)
    named = scene_toml.mesh or scene_toml.ifc
    return [path] if named is None else [path, path.parent / named]


def _default_trajectory(assembly: Assembly, environment: str | None, rig: RigSpec) -> DomeSpec | SurveySpec:
    """Return the default dome, or a survey without its stations if a radius exceeds ``MAX_DOME_M``.

    In the laboratory, which is too small for a survey of such steel, it is the dome.
    """
    dome = default_dome(assembly, rig)
    return dome if environment == _SMALL or max(dome.radii_m) <= MAX_DOME_M else SurveySpec()


def default_dome(assembly: Assembly, rig: RigSpec) -> DomeSpec:
    """Return ``LATTICE_DOME`` scaled to an assembly: 7 radii x 6 elevations x 12 azimuths, 504 views.

    All radii are multiplied by the factor, at least 1, for which the nearest radius is
    ``NEAREST_RADIUS_PER_REACH`` times the reach of the assembly: the greatest distance of its surface from the aim
    point, for a rig with the default field of view, and in proportion to the focal length for others. They are
    never reduced, because the stereo rig keeps its size. Radii are rounded to millimetres.
    """
    reach_m = float(np.linalg.norm(assembly.vertices_m - aim_point_m(assembly), axis=1).max())
    K = rig_cameras(rig, np.eye(4))["left"].K
    focal_px = max(K[0, 0] * NOMINAL_WIDTH / rig.width, K[1, 1] * NOMINAL_HEIGHT / rig.height)
    radius_per_reach = NEAREST_RADIUS_PER_REACH * focal_px / NOMINAL_FOCAL_PX
    factor = max(1.0, radius_per_reach * reach_m / min(LATTICE_DOME.radii_m))
    return replace(LATTICE_DOME, radii_m=tuple(round(factor * radius_m, 3) for radius_m in LATTICE_DOME.radii_m))


def _read_scene(path: Path) -> SceneToml:
    suffix = path.suffix.lower()
    if suffix == ".ifc":
        return SceneToml.model_construct(ifc=path.name)
    if suffix != ".toml":
        raise InputError(unsupported_type(path, "scene", ".toml or .ifc"))
    return read_scene_toml(read_file(path, TOML_BYTES, "a scene file", InputError), str(path), RESERVED_NAMES)


def scene_name_of(path: Path) -> str:
    """Return the scene name that a file name gives: lower case, with hyphens for all but letters and digits.

    Accents are removed, and letters without an ASCII form are left out; the name may be empty or reserved.
    """
    letters = unicodedata.normalize("NFKD", path.stem).casefold()
    plain = "".join(character for character in letters if not unicodedata.combining(character))
    return re.sub("[^a-z0-9]+", "-", plain).strip("-")


def _assembly_spec(scene_toml: SceneToml, path: Path) -> CageFileSpec | MeshFileSpec:
    if scene_toml.mesh is not None:
        mesh = str(path.parent / scene_toml.mesh)
        return mesh_file_spec(mesh, scene_toml.unit_m, scene_toml.placement, scene_toml.selections)
    file = path if scene_toml.ifc is None else path.parent / scene_toml.ifc
    return cage_file_spec(str(file), scene_toml.placement, scene_toml.selections, scene_toml.trust)


@contextmanager
def _scene_and_key_named(scene_toml: SceneToml, path: Path) -> Iterator[None]:
    """Add the scene file and its key to the errors of a file that it names."""
    key = "mesh" if scene_toml.mesh is not None else "ifc"
    try:
        yield
    except MeshError as error:
        if path.suffix.lower() != ".toml" or scene_toml.bar:
            raise
        named = type(error)(f"{path}: {key}: {error}")
        named.problems = error.problems
        raise named from error
