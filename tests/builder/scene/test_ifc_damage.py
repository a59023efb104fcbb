"""Damaged and hostile IFC models: a one-line error instead of a traceback, a hang or wrong bars."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.config.scene_file import scene_config
from dataset_builder.scene.assemblies.cage_file import cage_file_spec, load_cage
from dataset_builder.scene.assemblies.ifc import tessellation
from dataset_builder.scene.assemblies.ifc.bars import _swept_shapes, ifc_bars
from dataset_builder.scene.model import Assembly
from rebar_depth_bench.errors import InputError, MeshError
from tests.builder.scene.ifc_writer import Ifc, extruded_circle

COLUMN = Path("examples/column.ifc")


def assert_rejected(content: str | bytes, words: str) -> None:
    with pytest.raises(MeshError, match=f"^a.ifc: .*{words}"):
        ifc_bars(content.encode() if isinstance(content, str) else content, "a.ifc")


@pytest.mark.slow
def test_bar_without_readable_shape_is_named() -> None:
    ifc = Ifc()
    bar = ifc.rooted("IfcReinforcingBar")
    assert_rejected(
        ifc.file.to_string(), f"{bar.GlobalId.replace('$', '[$]')} .* no readable shape: .*tessellation"
    )


@pytest.mark.slow
def test_slow_or_crashing_tessellation_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    ifc = Ifc()
    for _ in range(2):
        ifc.bar(extruded_circle(ifc))
    slow = "import time; time.sleep(60)"
    code = f"import signal, runpy; signal.alarm(1); {slow}"
    monkeypatch.setattr(tessellation, "COMMAND", (sys.executable, "-c", code))
    assert_rejected(ifc.file.to_string(), "IfcReinforcingBar .* tessellation: took more than 60 s")
    monkeypatch.setattr(tessellation, "COMMAND", (sys.executable, "-c", "import os; os.abort()"))
    assert_rejected(ifc.file.to_string(), "IfcReinforcingBar .* tessellation: the geometry kernel crashed")


@pytest.mark.slow
def test_exponential_maps_and_placement_cycles_are_rejected() -> None:
    ifc = Ifc()
    origin, identity = (
        ifc.axes((0, 0, 0)),
        ifc.new("IfcCartesianTransformationOperator3D", LocalOrigin=ifc.point((0, 0, 0))),
    )
    item = ifc.mapped(identity, origin, ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0))))
    for _ in range(40):  # Each map contains the previous one twice: 2^40 bars.
        item = ifc.mapped(identity, origin, item, item)
    with pytest.raises(ValueError, match="more than 10000 items"):
        _swept_shapes(ifc.bar(item), 0.001, 1.0)
    placement = ifc.at((0, 0, 0))
    placement.PlacementRelTo = placement
    with pytest.raises(ValueError, match="is circular"):
        _swept_shapes(ifc.bar(ifc.disc(ifc.polyline((0, 0, 0), (500, 0, 0))), at=placement), 0.001, 1.0)


def column_with(old: str, new: str) -> str:
    text = COLUMN.read_text()
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "does not begin with ISO-10303-21"),
        ("solid cage", "does not begin with ISO-10303-21"),
        (COLUMN.read_text()[:5000], "does not end with END-ISO-10303-21.*truncated"),
        (column_with("'IFC4'", "'IFC9'"), "not a readable IFC file"),
        (column_with("IFCLOCALPLACEMENT(", "IFCLOCALPLAZEMENT("), "1 of its instances cannot be read, first #11"),
        (column_with("#31=", "#9031="), "1 referenced instances are not defined, first #31"),
        (column_with("#31=", "#30="), "#30 is defined twice"),
        (COLUMN.read_text().replace("IFCREINFORCINGBAR", "IFCBEAM"), "contains no IfcReinforcingBar"),
        (column_with(".LENGTHUNIT.,.MILLI.,.METRE.", ".AREAUNIT.,.MILLI.,.SQUARE_METRE."), "no known length unit"),
    ],
)  # fmt: skip
def test_damaged_files_are_rejected(content: str, words: str) -> None:
    assert_rejected(content, words)


def test_implausible_dimensions_are_rejected(tmp_path: Path) -> None:
    for old, new, words in [
        (".MILLI.", ".KILO.", "IfcReinforcingBar .* diameter is 8000 m, expected .* is the unit right"),
        ("(-46.,-46.,0.1)", "(-46.,-46.,1.E9)", "bar 1, .* extends 1e.06 m from the world's origin"),
        ("(-46.,-46.,0.1)", "(-46.,0.,0.1)", "bar"),
    ]:
        (tmp_path / "a.ifc").write_text(column_with(old, new))
        if words == "bar":
            assert len(load_cage(cage_file_spec(tmp_path / "a.ifc")).bars) == 13
            continue
        with pytest.raises(MeshError, match=words):
            load_cage(cage_file_spec(tmp_path / "a.ifc"))


@pytest.mark.slow
def test_random_damage_raises_only_mesh_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Check that 1-3 changed characters give bars or a ``MeshError``. The slow geometry kernel is disabled."""
    monkeypatch.setattr(tessellation, "COMMAND", ("false",))
    text = COLUMN.read_text()
    rng = random.Random(7)
    outcomes = {"bars": 0, "refused": 0}
    for _ in range(60):
        characters = list(text)
        for _ in range(rng.randint(1, 3)):
            position = rng.randrange(300, len(characters))
            characters[position] = rng.choice("0123456789#$*().,;'AE- \x00\xff")
        (tmp_path / "a.ifc").write_text("".join(characters))
        try:
            assembly: Assembly = load_cage(cage_file_spec(tmp_path / "a.ifc"))
            outcomes["bars"] += 1
            assert all(np.isfinite(part.mesh.vertices_m).all() for part in assembly.parts)
        except MeshError as error:
            assert str(error).startswith(f"{tmp_path}/a.ifc: ")  # noqa: PT017
            outcomes["refused"] += 1
    assert min(outcomes.values()) > 3


def test_missing_ifcopenshell_names_pip_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ifcopenshell", None)
    with pytest.raises(InputError, match=r"pip install 'rebar-depth-bench\[ifc\]'"):
        scene_config(COLUMN)


@pytest.mark.usefixtures("blender")
def test_blender_and_ifcopenshell_share_a_process() -> None:
    code = """
import bpy
from dataset_builder.scene.assemblies.cage_file import cage_file_spec, load_cage
from dataset_builder.scene.assemblies.ifc.model import open_model, world_mesh
from pathlib import Path
assert len(load_cage(cage_file_spec("examples/column.ifc")).bars) == 13
model = open_model(Path("examples/column.ifc").read_bytes(), "a")
assert len(world_mesh(model, 33)[0]) > 100
bpy.ops.wm.read_factory_settings(use_empty=True)
"""
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
