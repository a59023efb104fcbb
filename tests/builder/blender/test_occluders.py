"""The things of the appearance variants, as geometry: what they are, and what they keep clear of.

The rule: none is steel, none meets a bar. All stay out of the steel's bounding box but tie wire and spacers,
which lie within a millimetre of a bar's envelope (the circle round its ribs) and never inside one.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial import ConvexHull

from dataset_builder.blender.laboratory import laboratory
from dataset_builder.blender.outdoors import CLEAR_M, SLAB_HALF_M, outdoors
from dataset_builder.config.catalog import LATTICE_DOME, LATTICE_RING, PIER_DOME, PILE_DOME
from dataset_builder.config.rigs import rig_cameras
from dataset_builder.config.specs import (
    AppearanceSpec,
    AssemblySpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
    RigSpec,
    SceneSpec,
)
from dataset_builder.config.trajectories import poses
from dataset_builder.scene.assemblies import aim_point_m
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.assemblies.pile import pile_assembly
from dataset_builder.scene.model import NOT_STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m, plain_bar_mesh
from dataset_builder.scene.variants.props import MAKERS, occluders
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import camera_centre

FREE_STANDING = ("formwork", "clutter", "shadows")
TOUCHING = ("tie-wire", "spacers")


def cage(side_m: float = 0.30, height_m: float = 0.16, diameter_m: float = 0.012) -> Assembly:
    """A square cage of plain straight bars, as a user's file might hold: uprights outside, hoops of four bars."""
    half, gap = side_m / 2, 1.02 * diameter_m
    at = np.linspace(-half, half, 4)
    lines = [[(x, y, 0.001), (x, y, height_m)] for x in at for y in (-half, half)]
    for z in np.linspace(0.2, 0.8, 3) * height_m:
        lines += [[(-half, y, z), (half, y, z)] for y in (-half + gap, half - gap)]
        z_next = z + 1.1 * gap
        lines += [[(x, -half, z_next), (x, half, z_next)] for x in (-half + gap, half - gap)]
    bars = tuple(
        Bar(n, "imported", diameter_m, tuple((float(x), float(y), float(z)) for x, y, z in line))
        for n, line in enumerate(lines, start=1)
    )
    parts = tuple(
        Part(f"bar-{bar.bar_id}", plain_bar_mesh(np.array(bar.axis_m), bar.diameter_m), bar.bar_id, "steel")
        for bar in bars
    )
    return Assembly(bars, parts)


ASSEMBLIES: dict[str, tuple[Assembly, AssemblySpec, BoardSpec | None]] = {
    "lattice": (lattice_assembly(LatticeSpec()), LatticeSpec(), BoardSpec()),
    "lattice-12": (lattice_assembly(LatticeSpec(pitch_m=0.05)), LatticeSpec(), BoardSpec(markers=12)),
    "cage": (cage(), LatticeSpec(), None),
    "pile": (pile_assembly(PileSpec()), PileSpec(), BoardSpec(markers=12)),
    "pier": (pier_assembly(PierSpec()), PierSpec(), None),
}


def scene(kind: str, *variants: str, seed: int = 0) -> SceneSpec:
    _, spec, board = ASSEMBLIES[kind]
    return SceneSpec(kind, spec, board, appearance=AppearanceSpec(variants), seed=seed)


@cache
def things(kind: str, *variants: str, seed: int = 0) -> tuple[Part, ...]:
    return occluders(ASSEMBLIES[kind][0], scene(kind, *variants, seed=seed))


def surface_points_m(part: Part, per_part: int = 600) -> Float64[ndarray, "n 3"]:
    """Return a part's vertices and points spread over its surface."""
    body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
    spread, _ = trimesh.sample.sample_surface(body, per_part, seed=1)
    return np.concatenate([part.mesh.vertices_m, spread])


def steel_box_m(assembly: Assembly) -> Float64[ndarray, "2 3"]:
    points = np.concatenate([part.mesh.vertices_m for part in assembly.parts])
    return np.array([points.min(axis=0), points.max(axis=0)])


def off_box_m(points_m: Float64[ndarray, "n 3"], box_m: Float64[ndarray, "2 3"]) -> Float64[ndarray, " n"]:
    return np.asarray(np.linalg.norm(points_m - np.clip(points_m, box_m[0], box_m[1]), axis=1))


def off_steel_m(points_m: Float64[ndarray, "n 3"], assembly: Assembly) -> float:
    """Return the least distance from the points to any bar's envelope: by projection on every piece of axis."""
    low, high = points_m.min(axis=0) - 0.05, points_m.max(axis=0) + 0.05
    nearest = np.inf
    for bar in assembly.bars:
        line = np.array(bar.axis_m)
        if (line.max(axis=0) < low).any() or (line.min(axis=0) > high).any():
            continue
        for a, b in pairwise(line):
            if (np.maximum(a, b) < low).any() or (np.minimum(a, b) > high).any():
                continue
            length = np.linalg.norm(b - a)
            along = np.clip((points_m - a) @ (b - a) / length, 0.0, length)
            apart = np.linalg.norm(points_m - (a + along[:, None] * (b - a) / length), axis=1)
            nearest = min(nearest, float(apart.min()) - outer_radius_m(bar.diameter_m))
    return nearest


def bodies(part: Part) -> list[Part]:
    """Return the connected bodies of a part, each as a part."""
    whole = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
    return [
        Part(part.name, Mesh(np.asarray(body.vertices), np.asarray(body.faces)), part.bar_id, "")
        for body in whole.split(only_watertight=False)
    ]


@pytest.mark.parametrize("names", [(), ("dusk", "wet"), ("backlight",), ("mill-scale",)])
def test_nothing_is_added_by_light_and_steel(names: tuple[str, ...]) -> None:
    assert things("lattice", *names) == ()


@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", MAKERS)
def test_things_are_closed_outward_not_steel_and_repeat(kind: str, name: str) -> None:
    made, again = things(kind, name), things.__wrapped__(kind, name)
    assert made
    assert len({part.name for part in made}) == len(made)
    for part, other in zip(made, again, strict=True):
        assert part.bar_id == NOT_STEEL
        assert part.mesh.vertices_m.tobytes() == other.mesh.vertices_m.tobytes()
        body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert body.is_watertight
        assert body.volume > 0
        assert part.mesh.vertices_m[:, 2].min() > 1e-4, "it would lie in the board or the slab"


@pytest.mark.parametrize("name", ["clutter", "formwork", "spacers", "tie-wire"])
def test_the_seed_moves_things(name: str) -> None:
    layouts = [
        np.concatenate([part.mesh.vertices_m for part in things("lattice-12", name, seed=seed)]).tobytes()
        for seed in range(4)
    ]
    assert len(set(layouts)) > 1


@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", FREE_STANDING)
def test_free_standing_things_keep_out_of_the_steels_box(kind: str, name: str) -> None:
    box_m = steel_box_m(ASSEMBLIES[kind][0])
    span_m = float(np.ptp(box_m, axis=0)[:2].max())
    for part in things(kind, name):
        assert off_box_m(surface_points_m(part), box_m).min() > 0.02 * span_m


@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", TOUCHING)
def test_ties_and_spacers_lie_close_to_bars_and_in_none(kind: str, name: str) -> None:
    assembly = ASSEMBLIES[kind][0]
    # A wheel is of several bodies; each tie is one.
    made = (
        [body for part in things(kind, name) for body in bodies(part)]
        if name == "tie-wire"
        else things(kind, name)
    )
    assert len(made) >= (2 if kind == "pile" else 4)
    for part in made[:40]:
        assert 0 < off_steel_m(surface_points_m(part, 300), assembly) < 1e-3


def test_ties_hold_two_bars_each() -> None:
    assembly = ASSEMBLIES["lattice"][0]
    (wire,) = things("lattice", "tie-wire")
    ties = bodies(wire)
    assert len(ties) > 40
    for tie in ties:
        middle_m = (tie.mesh.vertices_m.min(axis=0) + tie.mesh.vertices_m.max(axis=0)) / 2
        ends = np.array([np.array(bar.axis_m) for bar in assembly.bars])
        direction = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None]
        off_m = np.linalg.norm(np.cross(middle_m - ends[:, 0], direction), axis=1)
        assert (off_m < 0.010).sum() >= 2


@pytest.mark.parametrize("kind", ASSEMBLIES)
def test_clutter_keeps_off_formwork_and_off_itself(kind: str) -> None:
    made = things(kind, "clutter", "formwork")
    panels = [part for part in made if part.name.startswith("formwork")]
    lying = [part for part in made if part.name.startswith("clutter")]
    assert len({part.name.split("-")[1] for part in lying}) >= 6
    for part in lying:
        points_m = surface_points_m(part)
        for panel in panels:
            corners = panel.mesh.vertices_m
            assert off_box_m(points_m, np.array([corners.min(axis=0), corners.max(axis=0)])).min() > 0
        number = part.name.split("-")[1]
        others = [other for other in lying if other.name.split("-")[1] != number]
        planes = ConvexHull(part.mesh.vertices_m).equations
        others_m = np.concatenate([surface_points_m(other, 100) for other in others])
        assert (others_m @ planes[:, :3].T + planes[:, 3] > 0).any(axis=1).all()


@pytest.mark.parametrize("kind", ["lattice", "lattice-12"])
def test_clutter_lies_on_no_marker(kind: str) -> None:
    board = ASSEMBLIES[kind][2]
    assert board is not None
    for seed in range(5):
        points_m = np.concatenate([surface_points_m(part, 200) for part in things(kind, "clutter", seed=seed)])
        for corners in marker_corners_m(board).values():
            low, high = corners.min(axis=0), corners.max(axis=0)
            assert not ((points_m[:, :2] > low[:2]) & (points_m[:, :2] < high[:2])).all(axis=1).any()


@pytest.mark.parametrize(
    ("kind", "protocol"),
    [("lattice", LATTICE_DOME), ("lattice", LATTICE_RING), ("pile", PILE_DOME), ("pier", PIER_DOME)],
)
def test_no_camera_stands_in_a_thing(kind: str, protocol: Any) -> None:
    rig, aim_m = RigSpec(), aim_point_m(ASSEMBLIES[kind][0])
    centres_m = np.array(
        [
            camera_centre(camera.cam_from_world)
            for pose in poses(protocol, aim_m, rig)
            for camera in rig_cameras(rig, pose).values()
        ]
    )
    farthest_m = np.linalg.norm(centres_m - aim_m, axis=1).max()
    for seed in range(4):
        for part in things(kind, *FREE_STANDING, seed=seed):
            if part.name.startswith("screen"):
                assert np.linalg.norm(surface_points_m(part) - aim_m, axis=1).min() > farthest_m + 0.02
            else:
                corners = part.mesh.vertices_m
                box_m = np.array([corners.min(axis=0), corners.max(axis=0)])
                assert off_box_m(centres_m, box_m).min() > 0.02


def test_clutter_stays_on_the_slab() -> None:
    for seed in range(3):
        for part in things("pier", "clutter", "formwork", seed=seed):
            assert np.abs(part.mesh.vertices_m[:, :2]).max() < SLAB_HALF_M


@settings(max_examples=12)
@given(
    side_m=st.floats(0.08, 6.0),
    flatness=st.floats(0.15, 2.0),
    slenderness=st.floats(0.006, 0.03),
    seed=st.integers(0, 2**31 - 1),
)
def test_things_fit_cages_of_any_size(side_m: float, flatness: float, slenderness: float, seed: int) -> None:
    assembly = cage(side_m, flatness * side_m, slenderness * side_m)
    spec = SceneSpec("any", LatticeSpec(), None, appearance=AppearanceSpec(tuple(MAKERS)), seed=seed)
    box_m = steel_box_m(assembly)
    made = occluders(assembly, spec)
    assert {part.bar_id for part in made} == {NOT_STEEL}
    for part in made:
        assert np.isfinite(part.mesh.vertices_m).all()
        assert part.mesh.vertices_m[:, 2].min() > 1e-4
        if part.name.startswith(("tie", "spacer")):
            assert off_steel_m(part.mesh.vertices_m, assembly) > 0
        else:
            assert off_box_m(part.mesh.vertices_m, box_m).min() > 0


@pytest.mark.parametrize("place", [laboratory, outdoors])
def test_places_are_closed_outward_surfaces_that_are_not_steel(place: Any) -> None:
    for part in place():
        body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert part.bar_id == NOT_STEEL
        assert body.is_watertight, part.name
        assert body.is_winding_consistent, part.name
        assert body.volume > 0, part.name


def test_the_site_leaves_the_cameras_room() -> None:
    parts = {part.name: part for part in outdoors()}
    assert parts["slab"].mesh.vertices_m[:, 2].max() == 0.0
    assert parts["ground"].mesh.vertices_m[:, 2].max() < -0.05
    for name, part in parts.items():
        if name not in {"slab", "blinding", "ground"}:
            assert np.linalg.norm(surface_points_m(part, 3000)[:, :2], axis=1).min() > CLEAR_M, name
