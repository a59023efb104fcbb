"""Props of the appearance variants: closed meshes, none of them steel, none intersecting a bar.

All props stay out of the bounding box of the steel, except tie wire and spacers. These lie within a millimetre of
the envelope of a bar (the circle round its ribs) and never inside one. Generated cages are life-size: formwork
stands at their cover, and blocks carry those that do not stand on the ground.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import ConvexHull

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import Cylinders, aim_point_m, poses
from dataset_builder.catalog.named_configs import LATTICE_DOME, LATTICE_RING, PIER_DOME, PILE_DOME
from dataset_builder.export.camera_formats import axis_points_m
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.cages.generate import FAMILIES
from dataset_builder.scene.environments.outdoors import SLAB_HALF_M
from dataset_builder.scene.environments.surroundings import FORMWORK_FAMILIES
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part, WorldMesh
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.solids import box, merge_meshes
from dataset_builder.scene.variants.props import PROP_BUILDERS, make_props
from dataset_builder.specs.config_specs import (
    AppearanceSpec,
    AssemblySpec,
    GeneratedCageSpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
    RigSpec,
    SceneSpec,
)
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.extended.axes import cage_truth
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import camera_centre
from tests.builder.scene.cages import assembly_of, point_distances_m, segments_m, square_cage

SCENES: dict[str, tuple[AssemblySpec, BoardSpec | None]] = {
    "lattice": (LatticeSpec(), BoardSpec()),
    "lattice-12": (LatticeSpec(pitch_m=0.05), BoardSpec(markers=12)),
    "square cage": (LatticeSpec(), None),
    "pile": (PileSpec(), BoardSpec(markers=12)),
    "pier": (PierSpec(), None),
}
FREE_STANDING = ("formwork", "clutter", "shadows")


def spec_of(kind: str) -> AssemblySpec:
    return GeneratedCageSpec("train", 0, 7, kind) if kind in FAMILIES else SCENES[kind][0]


@cache
def steel(kind: str) -> Assembly:
    return square_cage() if kind == "square cage" else make_assembly(spec_of(kind))


@cache
def props(kind: str, *variants: str, environment: str | None = None, seed: int = 0) -> tuple[Part, ...]:
    place = environment or ("hall" if kind in FAMILIES else "laboratory")
    board = None if kind in FAMILIES else SCENES[kind][1]
    scene = SceneSpec("s", spec_of(kind), board, place, AppearanceSpec(variants), seed)
    return make_props(steel(kind), scene)


def body(part: Part) -> trimesh.Trimesh:
    return trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)


def bodies(part: Part) -> list[Part]:
    """Return the connected components of a part, each as a part."""
    return [
        replace(part, mesh=Mesh(np.asarray(piece.vertices), np.asarray(piece.faces)))
        for piece in body(part).split(only_watertight=False)
    ]


def surface_points_m(part: Part, samples: int = 600) -> Float64[ndarray, "n 3"]:
    """Return the vertices of a part and points sampled on its surface."""
    sampled, _ = trimesh.sample.sample_surface(body(part), samples, seed=1)
    return np.concatenate([part.mesh.vertices_m, sampled])


def box_of(points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "2 3"]:
    return np.array([points_m.min(axis=0), points_m.max(axis=0)])


def distance_to_box_m(points_m: Float64[ndarray, "n 3"], box_m: Float64[ndarray, "2 3"]) -> float:
    """Return the distance of the nearest of the points, 0 inside."""
    return float(np.linalg.norm(points_m - np.clip(points_m, *box_m), axis=1).min())


def distance_to_steel_m(points_m: Float64[ndarray, "n 3"], assembly: Assembly) -> float:
    """Return the smallest distance from the points to the envelope of any bar."""
    low, high = points_m.min(axis=0) - 0.05, points_m.max(axis=0) + 0.05
    nearest_m = np.inf
    for bar in assembly.bars:
        pieces_m = segments_m(np.array(bar.axis_m))
        near_m = pieces_m[((pieces_m.min(axis=1) <= high) & (pieces_m.max(axis=1) >= low)).all(axis=1)]
        nearest_m = min(nearest_m, point_distances_m(points_m, near_m).min() - outer_radius_m(bar.diameter_m))
    return float(nearest_m)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "names"),
    [(kind, (name,)) for kind in SCENES for name in PROP_BUILDERS]
    + [(family, ("formwork", "clutter", "spacers")) for family in FAMILIES],
)
def test_props_are_closed_non_steel_and_above_the_ground(kind: str, names: tuple[str, ...]) -> None:
    parts = props(kind, *names)
    assert len({part.name for part in parts}) == len(parts) > 0
    for part in parts:
        assert part.bar_id == NOT_STEEL
        assert body(part).is_watertight, part.name
        assert body(part).volume > 0, part.name
        assert part.mesh.vertices_m[:, 2].min() > 1e-4, f"{part.name} lies in the board or the slab"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lattice-12", "wall"])
@pytest.mark.parametrize("name", PROP_BUILDERS)
def test_seed_determines_placement(kind: str, name: str) -> None:
    layouts = [
        b"".join(part.mesh.vertices_m.tobytes() for part in props.__wrapped__(kind, name, seed=seed))
        for seed in (0, 0, 1, 2, 3)
    ]
    assert layouts[0] == layouts[1]
    assert len(set(layouts)) > 1 or name == "shadows"


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("name", FREE_STANDING)
def test_free_standing_props_stay_out_of_the_steel(kind: str, name: str) -> None:
    box_m = box_of(steel(kind).vertices_m)
    span_m = float(np.ptp(box_m, axis=0)[:2].max())
    for part in props(kind, name):
        assert distance_to_box_m(surface_points_m(part), box_m) > 0.02 * span_m


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("name", ["tie-wire", "spacers"])
def test_ties_and_spacers_touch_bars_without_intersection(kind: str, name: str) -> None:
    parts = props(kind, name)
    if name == "tie-wire":  # A spacer wheel consists of several bodies; each tie is a single body.
        parts = tuple(piece for part in parts for piece in bodies(part))
    assert len(parts) >= (2 if kind == "pile" else 4)
    for part in parts[:40]:
        assert 0 < distance_to_steel_m(surface_points_m(part, 300), steel(kind)) < 1e-3


@pytest.mark.slow
def test_each_tie_is_at_two_bars() -> None:
    (wire,) = props("lattice", "tie-wire")
    ties = bodies(wire)
    assert len(ties) > 40
    axes_m = [segments_m(np.array(bar.axis_m)) for bar in steel("lattice").bars]
    for tie in ties:
        middle_m = box_of(tie.mesh.vertices_m).mean(axis=0)
        assert sum(point_distances_m(middle_m[None], axis_m)[0] < 0.010 for axis_m in axes_m) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENES)
def test_clutter_intersects_neither_formwork_nor_clutter(kind: str) -> None:
    parts = props(kind, "clutter", "formwork")
    panels = [part for part in parts if part.name.startswith("formwork")]
    clutter = [(part.name.split("-")[1], part) for part in parts if part.name.startswith("clutter")]
    assert len({number for number, _ in clutter}) >= 6
    for number, part in clutter:
        points_m = surface_points_m(part)
        for panel in panels:
            assert distance_to_box_m(points_m, box_of(panel.mesh.vertices_m)) > 0
        planes = ConvexHull(part.mesh.vertices_m).equations
        others_m = np.concatenate([surface_points_m(other, 100) for n, other in clutter if n != number])
        assert (others_m @ planes[:, :3].T + planes[:, 3] > 0).any(axis=1).all()


@pytest.mark.parametrize("kind", ["lattice", "lattice-12"])
def test_clutter_covers_no_marker(kind: str) -> None:
    board = SCENES[kind][1]
    assert board is not None
    for seed in range(5):
        points_m = np.concatenate([surface_points_m(part, 200) for part in props(kind, "clutter", seed=seed)])
        for corners_m in marker_corners_m(board).values():
            low, high = box_of(corners_m)[:, :2]
            assert not ((points_m[:, :2] > low) & (points_m[:, :2] < high)).all(axis=1).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "protocol"),
    [("lattice", LATTICE_DOME), ("lattice", LATTICE_RING), ("pile", PILE_DOME), ("pier", PIER_DOME)],
)
def test_no_camera_is_inside_a_prop(kind: str, protocol: Any) -> None:
    rig, aim_m = RigSpec(), aim_point_m(steel(kind))
    cameras = [rig_cameras(rig, pose).values() for pose in poses(protocol, aim_m, rig, steel(kind).bars)]
    centres_m = np.array([camera_centre(eye.cam_from_world) for eyes in cameras for eye in eyes])
    farthest_m = np.linalg.norm(centres_m - aim_m, axis=1).max()
    for seed in range(4):
        for part in props(kind, *FREE_STANDING, seed=seed):
            if part.name.startswith("screen"):
                assert np.linalg.norm(surface_points_m(part) - aim_m, axis=1).min() > farthest_m + 0.02
            else:
                assert distance_to_box_m(centres_m, box_of(part.mesh.vertices_m)) > 0.02


@pytest.mark.slow
def test_clutter_stays_on_slab() -> None:
    for seed in range(3):
        for part in props("pier", "clutter", "formwork", seed=seed):
            assert np.abs(part.mesh.vertices_m[:, :2]).max() < SLAB_HALF_M


@pytest.mark.slow
@settings(max_examples=12)
@given(
    side_m=st.floats(0.08, 6.0),
    flatness=st.floats(0.15, 2.0),
    slenderness=st.floats(0.006, 0.03),
    seed=st.integers(0, 2**31 - 1),
)
def test_props_fit_cages_of_any_size(side_m: float, flatness: float, slenderness: float, seed: int) -> None:
    assembly = square_cage(side_m, flatness * side_m, slenderness * side_m)
    spec = SceneSpec("any", LatticeSpec(), None, appearance=AppearanceSpec(tuple(PROP_BUILDERS)), seed=seed)
    parts = make_props(assembly, spec)
    assert {part.bar_id for part in parts} == {NOT_STEEL}
    for part in parts:
        assert np.isfinite(part.mesh.vertices_m).all()
        assert part.mesh.vertices_m[:, 2].min() > 1e-4
        if part.name.startswith(("tie", "spacer")):
            assert distance_to_steel_m(part.mesh.vertices_m, assembly) > 0
        else:
            assert distance_to_box_m(part.mesh.vertices_m, box_of(assembly.vertices_m)) > 0


def test_steel_without_an_axis_is_left_out_of_what_needs_axes() -> None:
    unknown = Bar.without_axis(2, "imported")
    plate = CageBar("plate", unknown, mesh=box((-0.1, 0.05, 0.05), (0.1, 0.06, 0.15)))
    rod = Bar(1, "bar", 0.01, ((-0.2, 0.0, 0.1), (0.2, 0.0, 0.1)))
    both = assembly_of([CageBar("rod", rod), plate], "cage.ifc")
    assert [bar.has_axis for bar in both.bars] == [True, False]
    assert both.parts[1].mesh is plate.mesh
    (note,) = both.notes
    assert (note.source, note.code) == ("cage.ifc", "axis")
    assert "1 of 2" in note.text
    assert "plate" in note.text
    for variant in PROP_BUILDERS:
        scene = SceneSpec("s", LatticeSpec(), BoardSpec(), appearance=AppearanceSpec((variant,)))
        for assembly in (both, assembly_of([plate], "cage.ifc")):
            assert all(np.isfinite(part.mesh.vertices_m).all() for part in make_props(assembly, scene))
    assert cage_truth([rod, unknown]).start_m.tolist() == cage_truth([rod]).start_m.tolist()
    np.testing.assert_array_equal(axis_points_m([rod, unknown]), axis_points_m([rod]))
    assert axis_points_m([unknown]).shape == (0, 3)
    assert len(Cylinders.from_bars([rod, unknown]).radius_m) == 1
    with pytest.raises(ValueError, match="no bars"):
        Cylinders.from_bars([unknown])


def named(parts: tuple[Part, ...], word: str) -> list[Part]:
    return [part for part in parts if word in part.name]


@pytest.mark.slow
@pytest.mark.parametrize("family", ["beam", "slab", "footing"])
def test_blocks_carry_cages_that_do_not_stand_on_the_ground(family: str) -> None:
    assert [props(standing) for standing in ("column", "wall")] == [()] * 2
    (support,) = props(family)
    blocks = bodies(support)
    low, high = box_of(steel(family).vertices_m)[:, :2]
    mesh = merge_meshes([part.mesh for part in steel(family).parts])
    above = RayCaster(WorldMesh(mesh.vertices_m, mesh.faces, np.ones(len(mesh.faces), np.uint16)))
    assert len(blocks) >= 4
    for block in blocks:
        lower, upper = box_of(block.mesh.vertices_m)
        x, y = np.meshgrid(*np.linspace(lower[:2], upper[:2], 9).T)
        top_m = np.stack([x.ravel(), y.ravel(), np.full(81, upper[2])], axis=1)
        heights_m = above.hits(top_m, np.tile([0.0, 0.0, 1.0], (81, 1))).range_m
        assert 1e-4 < heights_m.min() < 5e-3, "it carries a bar"
        assert not ((mesh.vertices_m > lower) & (mesh.vertices_m < upper)).all(axis=1).any()
        assert lower[2] < 2e-3
        assert (lower[:2] > low - 0.02).all()
        assert (upper[:2] < high + 0.02).all()
    middles_m = np.array([box_of(block.mesh.vertices_m).mean(axis=0)[:2] for block in blocks])
    assert (middles_m.min(axis=0) < (low + high) / 2).all(), "the middle of the cage is between blocks"
    assert (middles_m.max(axis=0) > (low + high) / 2).all()


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_arms_of_a_beam_rest_on_falsework(number: int) -> None:
    assembly = make_assembly(GeneratedCageSpec("train", number, 3, "joint"))
    parts = make_props(assembly, SceneSpec("any", GeneratedCageSpec("train", number, 3, "joint"), None))
    assert {part.bar_id for part in parts} == {NOT_STEEL}
    steel_m = assembly.vertices_m
    mesh = merge_meshes([part.mesh for part in assembly.parts])
    above = RayCaster(WorldMesh(mesh.vertices_m, mesh.faces, np.ones(len(mesh.faces), np.uint16)))
    feet_m = np.concatenate([part.mesh.vertices_m for part in assembly.parts[:4]])
    arms = [sign for sign in (-1, 1) if (sign * steel_m[:, 0]).max() > (sign * feet_m[:, 0]).max() + 0.5]
    assert len(named(parts, "sheet")) == len(arms) >= 1
    for sheet, sign in zip(named(parts, "sheet"), arms, strict=True):
        carriers = [part for part in parts if part.name[:11] == sheet.name[:11]]
        lower, upper = box_of(sheet.mesh.vertices_m)
        arm_m = steel_m[sign * steel_m[:, 0] > (sign * feet_m[:, 0]).max() + 0.15]
        assert 0.02 < arm_m[:, 2].min() - upper[2] < 0.05, "the cover"
        assert (lower[:2] < arm_m[:, :2].min(axis=0) + 0.02).all()
        assert (upper[:2] > arm_m[:, :2].max(axis=0) - 0.02).all()
        assert len(bodies(named(tuple(carriers), "blocks")[0])) >= 2
        for block in bodies(named(tuple(carriers), "blocks")[0]):
            at, top = box_of(block.mesh.vertices_m)
            assert 0 < at[2] - upper[2] < 0.002
            x, y = np.meshgrid(*np.linspace(at[:2], top[:2], 9).T)
            from_m = np.stack([x.ravel(), y.ravel(), np.full(81, top[2])], axis=1)
            assert 1e-4 < above.hits(from_m, np.tile([0.0, 0.0, 1.0], (81, 1))).range_m.min() < 5e-3
        boxes = [box_of(piece.mesh.vertices_m) for part in carriers[:3] for piece in bodies(part)]
        ends_m = np.array(sorted({(round(low[2], 6), round(high[2], 6)) for low, high in boxes}))
        assert 0 < ends_m[0, 0] < 0.001, "props stand on the ground"
        gaps_m = ends_m[1:, 0] - ends_m[:-1, 1]
        assert ((gaps_m > 0) & (gaps_m < 0.002)).all(), "each piece lies on the one below"
    for part in parts:
        assert distance_to_steel_m(part.mesh.vertices_m, assembly) > 0


@pytest.mark.slow
def test_wheels_keep_the_cover_of_a_pile_and_are_not_at_the_ends_of_its_bars() -> None:
    cage = GeneratedCageSpec("train", 3, 7, "pile-cage")
    assembly = make_assembly(cage)
    low, high = box_of(assembly.vertices_m)
    assert high[0] - low[0] > 1.5 * (high[1] - low[1]), "it lies along x"
    for seed in range(8):
        spec = SceneSpec("any", cage, None, appearance=AppearanceSpec(("spacers",)), seed=seed)
        for wheel in named(make_props(assembly, spec), "spacer"):
            lower, upper = box_of(wheel.mesh.vertices_m)
            assert lower[1] < low[1] or upper[1] > high[1]


@pytest.mark.slow
@pytest.mark.parametrize("family", FORMWORK_FAMILIES)
def test_sheets_stand_at_the_cover_and_leave_sides_open(family: str) -> None:
    low, high = box_of(steel(family).vertices_m)
    for seed in range(4):
        for sheet in named(props(family, "formwork", seed=seed), "sheet"):
            lower, upper = box_of(sheet.mesh.vertices_m)
            assert 0.02 < np.maximum(low - upper, lower - high)[:2].max() < 0.08, "the cover of its face"
            assert 0.25 * high[2] < upper[2] < high[2] + 0.08
            assert (upper - lower).max() < 2.6, "a sheet of plywood"
    sheets = trimesh.util.concatenate([body(part) for part in named(props(family, "formwork"), "sheet")])
    towards = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]) * np.ptp([low, high], axis=0)[:2].max()
    # Not from the middle itself, where two sheets of a long panel meet.
    origin_m = [*((low + high) / 2 + 0.05 * (high - low))[:2], 0.5 * min(high[2], 0.3)]
    assert sheets.ray.intersects_any(np.tile(origin_m, (4, 1)), towards).sum() == (3 if family == "slab" else 2)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["beam", "slab"])
def test_base_is_below_the_blocks_except_on_the_deck(family: str) -> None:
    low, high = box_of(steel(family).vertices_m)
    (base,) = named(props(family, "formwork"), "formwork-base")
    lower, upper = box_of(base.mesh.vertices_m)
    assert (lower[:2] < low[:2]).all()
    assert (upper[:2] > high[:2]).all()
    assert upper[2] < low[2] - 0.005
    assert not named(props(family, "formwork", environment="deck"), "formwork-base")
    assert not named(props("column", "formwork"), "formwork-base")


@pytest.mark.slow
def test_clutter_has_the_same_size_beside_every_cage() -> None:
    buckets = [named(props(family, "clutter"), "bucket")[0] for family in ("column", "beam", "slab")]
    heights_m = [np.ptp(bucket.mesh.vertices_m[:, 2]) for bucket in buckets]
    np.testing.assert_allclose(heights_m, heights_m[0])
    assert 0.25 < heights_m[0] < 0.35
