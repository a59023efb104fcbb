"""The door for cages given bar by bar: a TOML file (``scene_toml``) or an IFC model (``ifc_bars``).

Nothing is moved: the file's frame is the world, z up, with board or ground at z = 0.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from dataset_builder.config.scene_schema import TomlBar, read_scene_toml
from dataset_builder.config.specs import CageFileSpec
from dataset_builder.scene.assemblies.cage_assembly import CageBar, cage_assembly, refuse
from dataset_builder.scene.assemblies.ifc.bars import ifc_bars
from dataset_builder.scene.model import Assembly, Bar
from dataset_builder.scene.shapes.bending import bent_line_m, mandrel_diameter_m
from rebar_depth_bench.errors import InputError, MeshError


def cage_file_spec(path: str | os.PathLike[str]) -> CageFileSpec:
    """Return the spec that pins a cage file's present content.

    Raises ``MeshError`` where it cannot be read or is neither TOML nor IFC by its suffix.
    """
    return CageFileSpec(os.fspath(path), hashlib.sha256(_content(path)).hexdigest())


def load_cage(spec: CageFileSpec) -> Assembly:
    """Return the file's bars, in its order, and a mesh in world metres for each of them.

    Raises ``MeshError`` where the file cannot be read, is not the one that ``spec.sha256`` pins, breaks its
    format, or has bars that cannot be (see ``cage_assembly``); ``InputError`` where IFC is not installed.
    """
    content = _content(spec.path)
    found = hashlib.sha256(content).hexdigest()
    if found != spec.sha256:
        raise MeshError(f"{spec.path}: changed since it was chosen: sha256 {found} found, {spec.sha256} expected")
    return cage_assembly(_READERS[_suffix(spec.path)](content, spec.path), spec.path)


def _toml_bars(content: bytes, where: str) -> list[CageBar]:
    try:
        bars = read_scene_toml(content, where).bars
    except InputError as error:
        raise MeshError(str(error)) from error
    found, problems = [], []
    for bar in bars:
        try:
            found.append(_bent(bar))
        except ValueError as error:
            problems.append(f"{_label(bar)}: {error}, expected a path with room for its bends")
    refuse(problems, where)
    return found


def _bent(bar: TomlBar) -> CageBar:
    """Return the bar along its bent path; raise ``ValueError`` where its bends do not fit its legs."""
    mandrel_m = mandrel_diameter_m(bar.diameter_m) if bar.mandrel_m is None else bar.mandrel_m
    line_m = bent_line_m(np.array(bar.corners_m), (mandrel_m + bar.diameter_m) / 2)
    axis_m = tuple((x, y, z) for x, y, z in line_m.tolist())
    return CageBar(_label(bar), Bar(bar.bar_id, bar.role, bar.diameter_m, axis_m), bar.ribs)


def _label(bar: TomlBar) -> str:
    return f"bar {bar.bar_id} ({bar.role}, diameter {bar.diameter_m:g} m)"


_READERS: Mapping[str, Callable[[bytes, str], list[CageBar]]] = {".toml": _toml_bars, ".ifc": ifc_bars}


def _suffix(path: str | os.PathLike[str]) -> str:
    return Path(path).suffix.lower()


def _content(path: str | os.PathLike[str]) -> bytes:
    if _suffix(path) not in _READERS:
        raise MeshError(f"{path}: cages of kind {_suffix(path)!r} are not read, expected {', '.join(_READERS)}")
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: the cage file cannot be read: {error.strerror or error}") from error
