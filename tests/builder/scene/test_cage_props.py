"""Props of generated cages: formwork at the cover, life-size clutter, and blocks under cages above the ground."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.surroundings import FORMWORK_FAMILIES
from dataset_builder.scene.model import NOT_STEEL, Assembly, Part, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import merge_meshes
from dataset_builder.scene.variants.props import make_props
from dataset_builder.specs.config_specs import AppearanceSpec, GeneratedCageSpec, SceneSpec
from dataset_builder.user_files.make_assembly import make_assembly

LYING = ("beam", "slab", "footing")
STANDING = ("column", "wall", "joint")


def spec(family: str, number: int = 0) -> GeneratedCageSpec:
    return GeneratedCageSpec("train", number, 7, family)


@cache
def cage(family: str) -> Assembly:
    return make_assembly(spec(family))


@cache
def props(family: str, *variants: str, environment: str = "hall", seed: int = 0) -> tuple[Part, ...]:
    scene = SceneSpec("s", spec(family), None, environment, AppearanceSpec(variants), seed)
    return make_props(cage(family), scene)


def box_m(family: str) -> Float64[ndarray, "2 3"]:
    vertices_m = cage(family).vertices_m
    return np.array([vertices_m.min(axis=0), vertices_m.max(axis=0)])


def named(parts: tuple[Part, ...], word: str) -> list[Part]:
    return [part for part in parts if word in part.name]


def body(part: Part) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)


def heights_above_m(points_m: ndarray, assembly: Assembly) -> Float64[ndarray, " n"]:
    """Return the distances of points from the steel above them, infinite where there is none."""
    mesh = merge_meshes([part.mesh for part in assembly.parts])
    steel = RayCaster(WorldMesh(mesh.vertices_m, mesh.faces, np.ones(len(mesh.faces), np.uint16)))
    return steel.hits(points_m, np.tile([0.0, 0.0, 1.0], (len(points_m), 1))).range_m


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_props_are_closed_non_steel_and_above_ground(family: str) -> None:
    parts = props(family, "formwork", "clutter", "spacers")
    assert len({part.name for part in parts}) == len(parts)
    for part in parts:
        assert part.bar_id == NOT_STEEL
        assert body(part).is_watertight, part.name
        assert body(part).volume > 0, part.name
        assert part.mesh.vertices_m[:, 2].min() > 1e-4, part.name


@pytest.mark.slow
@pytest.mark.parametrize("family", LYING)
def test_blocks_carry_cages_above_the_ground(family: str) -> None:
    (support,) = props(family)
    blocks = body(support).split()
    corners_m = box_m(family)[:, :2]
    assert len(blocks) >= 4
    for block in blocks:
        x, y = np.linspace(block.bounds[0, :2], block.bounds[1, :2], 9).T
        top_m = block.bounds[1, 2]
        grid_m = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.full(81, top_m)], axis=1)
        assert 1e-4 < heights_above_m(grid_m, cage(family)).min() < 5e-3, "it carries a bar"
        is_inside = (cage(family).vertices_m > block.bounds[0]) & (cage(family).vertices_m < block.bounds[1])
        assert not is_inside.all(axis=1).any()
        assert block.bounds[0, 2] < 2e-3
        assert (block.bounds[:, :2] > corners_m[0] - 0.02).all()
        assert (block.bounds[:, :2] < corners_m[1] + 0.02).all()
    # The middle of the cage is between blocks.
    middles_m = np.array([block.bounds[:, :2].mean(axis=0) for block in blocks])
    assert (middles_m.min(axis=0) < corners_m.mean(axis=0)).all()
    assert (middles_m.max(axis=0) > corners_m.mean(axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("family", STANDING)
def test_standing_cages_have_no_blocks(family: str) -> None:
    assert props(family) == ()


@pytest.mark.slow
@pytest.mark.parametrize("family", FORMWORK_FAMILIES)
@pytest.mark.parametrize("seed", range(4))
def test_sheets_stand_at_the_cover(family: str, seed: int) -> None:
    low, high = box_m(family)
    sheets = named(props(family, "formwork", seed=seed), "sheet")
    for sheet in sheets:
        corners_m = sheet.mesh.vertices_m
        beyond_m = np.maximum(low - corners_m.max(axis=0), corners_m.min(axis=0) - high)[:2]
        assert 0.02 < beyond_m.max() < 0.08, "the cover of its face"
        top_m = corners_m[:, 2].max()
        assert top_m < high[2] + 0.08
        assert top_m > 0.25 * high[2]
        assert np.ptp(corners_m, axis=0).max() < 2.6, "a sheet of plywood"


@pytest.mark.slow
@pytest.mark.parametrize("family", FORMWORK_FAMILIES)
def test_formwork_closes_some_sides_and_leaves_others_open(family: str) -> None:
    low, high = box_m(family)
    middle_m, reach_m = (low + high) / 2, float(np.ptp([low, high], axis=0)[:2].max())
    height_m = 0.5 * min(high[2], 0.3)
    sheets = trimesh.util.concatenate([body(part) for part in named(props(family, "formwork"), "sheet")])
    towards = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
    # Not from the middle itself, where two sheets of a long panel meet.
    origin_m = [*(middle_m[:2] + 0.05 * (high - low)[:2]), height_m]
    is_closed = sheets.ray.intersects_any(np.tile(origin_m, (4, 1)), towards * reach_m)
    assert is_closed.sum() == (3 if family == "slab" else 2)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["beam", "slab"])
def test_base_is_below_the_blocks_except_on_the_deck(family: str) -> None:
    low, high = box_m(family)
    (base,) = named(props(family, "formwork"), "formwork-base")
    assert (base.mesh.vertices_m.min(axis=0)[:2] < low[:2]).all()
    assert (base.mesh.vertices_m.max(axis=0)[:2] > high[:2]).all()
    assert base.mesh.vertices_m[:, 2].max() < low[2] - 0.005
    assert not named(props(family, "formwork", environment="deck"), "formwork-base")
    assert not named(props("column", "formwork"), "formwork-base")


@pytest.mark.slow
def test_clutter_has_the_same_size_beside_every_cage() -> None:
    sizes_m = [
        np.ptp(next(part for part in props(family, "clutter") if "bucket" in part.name).mesh.vertices_m[:, 2])
        for family in ("column", "beam", "slab")
    ]
    np.testing.assert_allclose(sizes_m, sizes_m[0])
    assert 0.25 < sizes_m[0] < 0.35
