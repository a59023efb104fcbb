"""Steel without an axis in what is placed by, measured from or exported along axes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from dataset_builder.cameras.steel_distance import Cylinders
from dataset_builder.catalog.named_configs import CONFIGS
from dataset_builder.export.camera_formats import axis_points_m
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import Assembly
from dataset_builder.scene.shapes.solids import box
from dataset_builder.scene.variants.props import make_props
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended.axes import cage_truth
from tests.builder.scene.cages import assembly_of

ROD = Bar(1, "bar", 0.01, ((-0.2, 0.0, 0.1), (0.2, 0.0, 0.1)))
UNKNOWN = Bar.without_axis(2, "imported")
PLATE = CageBar("plate", UNKNOWN, mesh=box((-0.1, 0.05, 0.05), (0.1, 0.06, 0.15)))


@cache
def rod_and_plate() -> Assembly:
    return assembly_of([CageBar("rod", ROD), PLATE], "cage.ifc")


def test_cage_keeps_mesh_of_bar_without_axis_and_names_it() -> None:
    assembly = rod_and_plate()
    assert [bar.has_axis for bar in assembly.bars] == [True, False]
    assert assembly.parts[1].mesh is PLATE.mesh
    (note,) = assembly.notes
    assert (note.source, note.code) == ("cage.ifc", "axis")
    assert "1 of 2" in note.text
    assert "plate" in note.text


@pytest.mark.parametrize("variant", ["clutter", "formwork", "spacers", "tie-wire"])
def test_props_are_placed_by_known_axes(variant: str) -> None:
    scene = CONFIGS["lattice"]().scene
    scene = replace(scene, appearance=replace(scene.appearance, variants=(variant,)))
    only_plate = assembly_of([PLATE], "cage.ifc")
    for assembly in (rod_and_plate(), only_plate):
        for part in make_props(assembly, scene):
            assert np.isfinite(part.mesh.vertices_m).all()


def test_measures_leave_bar_without_axis_out() -> None:
    assert cage_truth([ROD, UNKNOWN]).start_m.tolist() == cage_truth([ROD]).start_m.tolist()
    np.testing.assert_array_equal(axis_points_m([ROD, UNKNOWN]), axis_points_m([ROD]))
    assert axis_points_m([UNKNOWN]).shape == (0, 3)
    assert len(Cylinders.from_bars([ROD, UNKNOWN]).radius_m) == 1
    with pytest.raises(ValueError, match="no bars"):
        Cylinders.from_bars([UNKNOWN])
