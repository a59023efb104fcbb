"""Bars of the ``[[bar]]`` tables of a scene TOML file (``user_files.scene_schema``)."""

from __future__ import annotations

import numpy as np

from dataset_builder.scene.assemblies.cage import Cage, CageBar, unit_scale
from dataset_builder.scene.model import axis_of
from dataset_builder.scene.shapes.bending import bent_line_m, mandrel_diameter_m
from dataset_builder.user_files.scene_schema import read_scene_toml
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import InputError, MeshError, Problem


def toml_cage(content: bytes, where: str) -> Cage:
    """Return the bars of a scene TOML file, in its order (the file's frame, metres).

    Raises ``MeshError`` that names the file ``where`` and all bars that cannot be bent.
    """
    try:
        scene = read_scene_toml(content, where)
    except InputError as error:
        raise MeshError.from_problems(where, error.problems) from error
    cage_bars, problems = [], []
    for number, bar in enumerate(scene.bars, start=1):
        label = f"bar {bar.bar_id} ({bar.role}, diameter {bar.diameter_m:g} m)"
        mandrel_m = mandrel_diameter_m(bar.diameter_m) if bar.mandrel_m is None else bar.mandrel_m
        try:
            line_m = bent_line_m(np.array(bar.corners_m), (mandrel_m + bar.diameter_m) / 2)
        except ValueError as error:
            problems.append(Problem("invalid", label, str(error), "a path that is long enough for its bends"))
            continue
        bent = Bar(bar.bar_id, bar.role, bar.diameter_m, axis_of(line_m))
        cage_bars.append(CageBar(label, bent, bar.ribs, source=f"bar {number}"))
    if problems:
        raise MeshError.from_problems(where, problems)
    return Cage(tuple(cage_bars), (), unit_scale(scene.unit_m))
