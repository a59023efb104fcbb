"""Entry points that read scene files, IFC models, meshes and calibrations, each from one file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from dataset_builder.catalog.scene_file import scene_config
from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage, mesh_file_spec
from rebar_depth_bench.captures.calibration_files import read_calibration
from tests.bench.geometry.calibrations import CONF, TOML
from tests.building import TWO_BARS
from tests.fuzz.entry_point import EntryPoint
from tests.fuzz.workspace import CASE, Workspace

EXAMPLES = Path(__file__).parents[2] / "examples"
_RODS = tuple(
    trimesh.creation.cylinder(diameter_m / 2, segment=[[0.0, y_m, 0.1], [0.5, y_m, 0.1]], sections=12)
    for diameter_m, y_m in ((0.016, 0.0), (0.010, 0.1), (0.020, 0.2))
)


def _rods() -> trimesh.Trimesh:
    return trimesh.util.concatenate(_RODS)


def _dataset_ply(path: Path) -> None:
    bar_id = np.repeat(range(1, len(_RODS) + 1), [len(rod.faces) for rod in _RODS])
    write_mesh_ply(path, WorldMesh(np.asarray(_rods().vertices), np.asarray(_rods().faces), bar_id))


def _read_mesh(path: Path) -> object:
    return [(bar.bar_id, bar.diameter_m, bar.axis_m) for bar in load_cage(mesh_file_spec(path, "m")).bars]


def _read_cage(path: Path) -> object:
    return [(bar.bar_id, bar.diameter_m, bar.axis_m) for bar in load_cage(cage_file_spec(path)).bars]


def _read_calibration(path: Path) -> object:
    return read_calibration(path, 1280, 720)


def _copy(source: Path, path: Path) -> None:
    path.write_bytes(source.read_bytes())


def _text(content: str, path: Path) -> None:
    path.write_text(content)


def _file_entry(
    title: str,
    share: int,
    file: str,
    write: Callable[[Path], object],
    read: Callable[[Path], object],
    *,
    shows_truncation: bool = False,
) -> EntryPoint:
    """Return the entry point of a reader of one file; its result is what the reader returns."""

    def run(workspace: Workspace) -> None:
        (workspace.out / "result").write_text(repr(read(workspace.case / file)))

    return EntryPoint(
        title,
        share,
        prepare=lambda workspace: write(workspace.case / file),
        run=run,
        targets=(f"{CASE}/{file}",),
        result=lambda workspace: (workspace.out / "result").read_bytes(),
        shows_truncation=shows_truncation,
    )


_mesh = partial(_file_entry, read=_read_mesh, shows_truncation=True)
_calibration = partial(_file_entry, read=_read_calibration)

SCENE_ENTRIES = (
    _file_entry("scene TOML", 8, "scene.toml", partial(_copy, TWO_BARS), scene_config),
    _file_entry("scene TOML: beam", 2, "beam.toml", partial(_copy, EXAMPLES / "beam.toml"), scene_config),
    _file_entry("IFC", 5, "c.ifc", partial(_copy, EXAMPLES / "column.ifc"), _read_cage, shows_truncation=True),
    _mesh("mesh: dataset PLY", 4, "a.ply", _dataset_ply),
    _mesh("mesh: binary PLY", 4, "a.ply", lambda path: _rods().export(path)),
    _mesh("mesh: ASCII PLY", 6, "a.ply", lambda path: _rods().export(path, encoding="ascii")),
    _mesh("mesh: binary STL", 4, "a.stl", lambda path: _rods().export(path)),
    _mesh("mesh: ASCII STL", 4, "a.stl", lambda path: _rods().export(path, file_type="stl_ascii")),
    # A truncated OBJ file is a shorter OBJ file.
    _mesh("mesh: OBJ", 4, "a.obj", lambda path: _rods().export(path), shows_truncation=False),
    _calibration("calibration: TOML", 8, "rig.toml", partial(_text, TOML)),
    _calibration("calibration: conf", 8, "SN1.conf", partial(_text, CONF)),
)
