"""Cage files as assemblies: bars from a scene TOML (``config.scene_schema``) or an IFC model (``ifc.process``).

Nothing is moved: the file's frame is the world frame, z up, with board or ground at z = 0.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from dataset_builder.config.scene_schema import TomlBar, read_scene_toml
from dataset_builder.config.specs import CageFileSpec, read_assembly_file
from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.assemblies.cage_assembly import cage_assembly, raise_problems
from dataset_builder.scene.assemblies.ifc.process import ifc_bars
from dataset_builder.scene.model import Assembly, axis_of
from dataset_builder.scene.shapes.bending import bent_line_m, mandrel_diameter_m
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, MeshError, Problem


def cage_file_spec(path: str | os.PathLike[str]) -> CageFileSpec:
    """Return the spec of a cage file, which fixes its present content by SHA-256.

    Raises ``MeshError`` if it cannot be read or its suffix is neither ``.toml`` nor ``.ifc``.
    """
    return CageFileSpec(os.fspath(path), hashlib.sha256(read_assembly_file(path, "cage", _READERS)).hexdigest())


def load_cage(spec: CageFileSpec) -> Assembly:
    """Return the file's bars, in its order, and a mesh (world, metres) for each of them.

    Raises ``MeshError`` if the file cannot be read, does not match ``spec.sha256``, violates its format or has
    invalid bars (see ``cage_assembly``); ``InputError`` if it is an IFC file and ifcopenshell is not installed.
    """
    return cage_assembly(read_cage(spec).bars, spec.path)


def read_cage(spec: CageFileSpec) -> Cage:
    """Return the bars of a file (world, metres), in its order. Raises as ``load_cage`` where reading fails."""
    content = spec.check(read_assembly_file(spec.path, "cage", _READERS))
    return Cage(tuple(_READERS[Path(spec.path).suffix.lower()](content, spec.path)))


def _toml_bars(content: bytes, where: str) -> list[CageBar]:
    """Return the bars of a scene TOML; raise ``MeshError`` that names the file ``where`` and all bad bars."""
    try:
        bars = read_scene_toml(content, where).bars
    except InputError as error:
        raise MeshError.from_problems(where, error.problems) from error
    cage_bars, problems = [], []
    for bar in bars:
        try:
            cage_bars.append(_bent_bar(bar))
        except ValueError as error:
            expected = "a path that is long enough for its bends"
            problems.append(Problem("invalid", _label(bar), str(error), expected))
    raise_problems(problems, where)
    return cage_bars


def _bent_bar(bar: TomlBar) -> CageBar:
    """Return the bar bent along its corners; raise ``ValueError`` if its bends do not fit its legs."""
    mandrel_m = mandrel_diameter_m(bar.diameter_m) if bar.mandrel_m is None else bar.mandrel_m
    line_m = bent_line_m(np.array(bar.corners_m), (mandrel_m + bar.diameter_m) / 2)
    return CageBar(_label(bar), Bar(bar.bar_id, bar.role, bar.diameter_m, axis_of(line_m)), bar.ribs)


def _label(bar: TomlBar) -> str:
    """Return the bar's name in error messages."""
    return f"bar {bar.bar_id} ({bar.role}, diameter {bar.diameter_m:g} m)"


_READERS: Mapping[str, Callable[[bytes, str], list[CageBar]]] = {".toml": _toml_bars, ".ifc": ifc_bars}
