"""Selection and placement of a model of life size at site coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dataset_builder.catalog.scene_file import scene_cage, scene_config
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.user_files.cage_file import cage_assembly
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import MeshError
from tests.builder.catalog.scene_files import write_scene
from tests.builder.user_files.site_model import (
    COLUMN_BARS,
    FITTING_BARS,
    SITE_TURN_DEG,
    WALL_BARS,
    site_from_world_m,
    write_site_model,
)

BOTH = WALL_BARS + COLUMN_BARS


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_site_model(tmp_path_factory.mktemp("site") / "Site Model.ifc")


def cage_with(model: Path, content: str) -> Cage:
    return scene_cage(write_scene(model.parent, f'ifc = "{model.name}"\n{content}', "scene.toml"))


@pytest.mark.parametrize(
    ("tables", "bars"),
    [
        ("", BOTH),
        ("[[select]]\nhost = 'W-*'", WALL_BARS),
        ("[[select]]\nstorey = 'EG*'", WALL_BARS),
        ("[[select]]\nstorey = 'Level ?'", COLUMN_BARS),
        ("[[select]]\nlayer = 'Stirrups'", COLUMN_BARS - 4),
        ("[[select]]\nname = 'Bar 25'\n[[select]]\nname = 'Bar 10'", COLUMN_BARS),
        ("[[select]]\nname = 'Bar 1?'\nstorey = 'Level 1'", COLUMN_BARS - 4),
        ("[[select]]\nclass = 'ifcbuildingelement*'", FITTING_BARS),
        ("[[select]]\nclass = 'IfcReinforcing*'", BOTH),
        ("[[select]]\nname = '*'", BOTH),
        ("[[select]]\nname = 'bar 25'\n[[select]]\nname = '*5'", 4),
    ],
)
def test_selected_bars(model: Path, tables: str, bars: int) -> None:
    cage = cage_with(model, tables)
    assert len(cage.bars) == bars
    assert [bar.bar.bar_id for bar in cage.bars] == list(range(1, bars + 1))
    assert not cage.problems
    left_out = {record.source for record in cage.left_out}
    assert not left_out & {bar.source for bar in cage.bars}
    taken = {bar.source for bar in cage.bars}
    assert len(left_out) == BOTH + 3 - len(taken)  # Also the wall, the slab and the fitting.


@pytest.mark.parametrize("schema", ["IFC4", "IFC2X3", "IFC4X3"])
def test_bars_have_hosts_and_storeys(tmp_path: Path, schema: str) -> None:
    bars = scene_cage(write_site_model(tmp_path / "a.ifc", schema)).bars
    assert {(bar.host, bar.storey) for bar in bars[:WALL_BARS]} == {("W-1", "EG Erdgeschoss")}
    assert {(bar.host, bar.storey) for bar in bars[WALL_BARS:]} == {(None, "Level 1")}


def test_box_takes_the_objects_that_are_wholly_inside(model: Path) -> None:
    from_site = np.linalg.inv(site_from_world_m())
    around_m = (from_site @ np.array([7.0, 1.0, 5.5, 1.0]))[:3]
    for half_m, expected in ((2.0, COLUMN_BARS), (0.5, 6), (0.05, 0)):
        lower, upper = ((around_m + sign * half_m) * 1000 for sign in (-1, 1))
        table = f"[[select]]\nbox = [{upper.tolist()}, {lower.tolist()}]"
        if expected:
            assert len(cage_with(model, table).bars) == expected
        else:
            with pytest.raises(MeshError, match="no object is inside the box"):
                cage_with(model, table)


@pytest.mark.parametrize("tables", ["[[select]]\nname = 'x'", "[[select]]\nclass = 'IfcDoor'"])
def test_selection_of_nothing_names_what_there_is(model: Path, tables: str) -> None:
    with pytest.raises(MeshError, match=r"no object is selected.*144 IfcReinforcingBar.*1 IfcWall"):
        cage_with(model, tables)


@pytest.mark.parametrize(
    ("keys", "rotate_deg", "move_m"),
    [
        ("", 0.0, (0, 0, 0)),
        (f"rotate_deg = {-SITE_TURN_DEG}\ntranslate = [1, -2.5, 0.25]\n", -SITE_TURN_DEG, (1, -2.5, 0.25)),
    ],
)
def test_cage_is_centred_by_whole_millimetres(
    model: Path, keys: str, rotate_deg: float, move_m: tuple[float, float, float]
) -> None:
    """Compare the axes with those of the site's frame, which the placement does not know."""
    keys += "[[select]]\nhost = 'W-1'\n"
    cage = cage_with(model, keys)
    spec = scene_config(model.parent / "scene.toml").scene.assembly
    vertices_m = make_assembly(spec).vertices_m - move_m
    lower_m, upper_m = vertices_m.min(axis=0), vertices_m.max(axis=0)
    assert 0 <= lower_m[2] <= 0.001
    assert np.abs(lower_m + upper_m)[:2].max() / 2 <= (0.0006 if not rotate_deg else 0.002)
    source_from_world = np.linalg.inv(cage.world_from_source)
    for bar in cage.bars[:3]:
        points = np.column_stack([bar.bar.axis_m, np.ones(len(bar.bar.axis_m))])
        source_mm = (points @ source_from_world.T)[:, :3]
        site_m = np.column_stack([source_mm / 1000, np.ones(len(points))]) @ site_from_world_m().T
        number = bar.bar.bar_id - 1
        expected_m = [[0.075 + 0.15 * number, 0.041, 0.04], [0.075 + 0.15 * number, 0.041, 2.96]]
        np.testing.assert_allclose(site_m[:, :3], expected_m, rtol=0, atol=2e-6)
    lengths_m = [bar.bar.length_m for bar in cage.bars]
    np.testing.assert_allclose(lengths_m[:40], 2.92, rtol=0, atol=1e-6)
    np.testing.assert_allclose(lengths_m[40:60], 5.92, rtol=0, atol=1e-6)
    if rotate_deg:  # The wall is parallel to the x axis again.
        assert np.ptp(vertices_m[:, 0]) == pytest.approx(5.92, abs=0.02)
        assert np.ptp(vertices_m[:, 1]) == pytest.approx(0.204, abs=0.01)
    rotation = cage.world_from_source[:3, :3] * 1000
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_site_coordinates_that_are_kept_are_refused(model: Path) -> None:
    cage = cage_with(model, 'origin = "keep"\n[[select]]\nhost = "W-1"\n')
    assert len(cage.problems) == WALL_BARS
    np.testing.assert_array_equal(cage.world_from_source, np.diag([0.001, 0.001, 0.001, 1]))
    with pytest.raises(MeshError, match="from the world's origin"):
        scene_config(model.parent / "scene.toml")


def test_ifc_file_alone_is_centred(model: Path) -> None:
    config = scene_config(model)
    assert (config.name, config.scene.environment) == ("site-model", "outdoors")
    assert config.protocol.kind == "survey"  # The dome would be too large.
    cage = scene_cage(model)
    assembly = cage_assembly(cage, str(model))
    assert 0 <= assembly.vertices_m[:, 2].min() <= 0.001
    assert assembly.world_from_source is cage.world_from_source
    codes = [note.code for note in assembly.notes]
    assert codes == ["left-out"]
    assert "1 (IfcWall: not reinforcement)" in assembly.notes[0].text
