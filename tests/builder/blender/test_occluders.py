"""Geometry of the props of the appearance variants: closed meshes, none of them steel, none intersecting a bar.

All props stay out of the bounding box of the steel, except tie wire and spacers. These lie within a millimetre of
the envelope of a bar (the circle round its ribs) and never inside one.
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

from dataset_builder.cameras.rigs import rig_cameras
from dataset_builder.cameras.trajectories import aim_point_m, poses
from dataset_builder.catalog.named_configs import LATTICE_DOME, LATTICE_RING, PIER_DOME, PILE_DOME
from dataset_builder.scene.assemblies.lattice import lattice_assembly
from dataset_builder.scene.assemblies.pier import pier_assembly
from dataset_builder.scene.assemblies.pile import pile_assembly
from dataset_builder.scene.environments.deck import deck
from dataset_builder.scene.environments.hall import hall
from dataset_builder.scene.environments.laboratory import laboratory
from dataset_builder.scene.environments.outdoors import CLEAR_M, SLAB_HALF_M, outdoors
from dataset_builder.scene.model import NOT_STEEL, Assembly, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.variants.props import PROP_BUILDERS, make_props
from dataset_builder.specs.config_specs import (
    AppearanceSpec,
    AssemblySpec,
    LatticeSpec,
    PierSpec,
    PileSpec,
    RigSpec,
    SceneSpec,
)
from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import camera_centre
from tests.builder.blender.cages import cage

FREE_STANDING = ("formwork", "clutter", "shadows")
TOUCHING = ("tie-wire", "spacers")


ASSEMBLIES: dict[str, tuple[Assembly, AssemblySpec, BoardSpec | None]] = {
    "lattice": (lattice_assembly(LatticeSpec()), LatticeSpec(), BoardSpec()),
    "lattice-12": (lattice_assembly(LatticeSpec(pitch_m=0.05)), LatticeSpec(), BoardSpec(markers=12)),
    "cage": (cage(), LatticeSpec(), None),
    "pile": (pile_assembly(PileSpec()), PileSpec(), BoardSpec(markers=12)),
    "pier": (pier_assembly(PierSpec()), PierSpec(), None),
}


def scene_spec(kind: str, *variants: str, seed: int = 0) -> SceneSpec:
    _, spec, board = ASSEMBLIES[kind]
    return SceneSpec(kind, spec, board, appearance=AppearanceSpec(variants), seed=seed)


@cache
def cached_props(kind: str, *variants: str, seed: int = 0) -> tuple[Part, ...]:
    return make_props(ASSEMBLIES[kind][0], scene_spec(kind, *variants, seed=seed))


def surface_points_m(part: Part, samples: int = 600) -> Float64[ndarray, "n 3"]:
    """Return the vertices of a part and ``samples`` points sampled on its surface, in metres."""
    body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
    sampled, _ = trimesh.sample.sample_surface(body, samples, seed=1)
    return np.concatenate([part.mesh.vertices_m, sampled])


def steel_box_m(assembly: Assembly) -> Float64[ndarray, "2 3"]:
    points_m = np.concatenate([part.mesh.vertices_m for part in assembly.parts])
    return np.array([points_m.min(axis=0), points_m.max(axis=0)])


def distance_to_box_m(points_m: Float64[ndarray, "n 3"], box_m: Float64[ndarray, "2 3"]) -> Float64[ndarray, " n"]:
    return np.asarray(np.linalg.norm(points_m - np.clip(points_m, box_m[0], box_m[1]), axis=1))


def distance_to_steel_m(points_m: Float64[ndarray, "n 3"], assembly: Assembly) -> float:
    """Return the smallest distance from the points to the envelope of any bar (its axis segments)."""
    low, high = points_m.min(axis=0) - 0.05, points_m.max(axis=0) + 0.05
    nearest_m = np.inf
    for bar in assembly.bars:
        axis_m = np.array(bar.axis_m)
        if (axis_m.max(axis=0) < low).any() or (axis_m.min(axis=0) > high).any():
            continue
        for a, b in pairwise(axis_m):
            if (np.maximum(a, b) < low).any() or (np.minimum(a, b) > high).any():
                continue
            length_m = np.linalg.norm(b - a)
            along_m = np.clip((points_m - a) @ (b - a) / length_m, 0.0, length_m)
            distances_m = np.linalg.norm(points_m - (a + along_m[:, None] * (b - a) / length_m), axis=1)
            nearest_m = min(nearest_m, float(distances_m.min()) - outer_radius_m(bar.diameter_m))
    return nearest_m


def split_bodies(part: Part) -> list[Part]:
    """Return the connected components of a part, each as a part."""
    whole = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
    return [
        Part(part.name, Mesh(np.asarray(body.vertices), np.asarray(body.faces)), part.bar_id, "")
        for body in whole.split(only_watertight=False)
    ]


@pytest.mark.parametrize("names", [(), ("dusk", "wet"), ("backlight",), ("mill-scale",)])
def test_light_and_steel_variants_add_no_props(names: tuple[str, ...]) -> None:
    assert cached_props("lattice", *names) == ()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", PROP_BUILDERS)
def test_props_are_closed_non_steel_and_deterministic(kind: str, name: str) -> None:
    props, repeated = cached_props(kind, name), cached_props.__wrapped__(kind, name)
    assert props
    assert len({part.name for part in props}) == len(props)
    for part, other in zip(props, repeated, strict=True):
        assert part.bar_id == NOT_STEEL
        assert part.mesh.vertices_m.tobytes() == other.mesh.vertices_m.tobytes()
        body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert body.is_watertight
        assert body.volume > 0
        assert part.mesh.vertices_m[:, 2].min() > 1e-4, "it would lie in the board or the slab"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["clutter", "formwork", "spacers", "tie-wire"])
def test_seed_changes_prop_placement(name: str) -> None:
    layouts = [
        np.concatenate([part.mesh.vertices_m for part in cached_props("lattice-12", name, seed=seed)]).tobytes()
        for seed in range(4)
    ]
    assert len(set(layouts)) > 1


@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", FREE_STANDING)
def test_free_standing_props_stay_out_of_steel_box(kind: str, name: str) -> None:
    box_m = steel_box_m(ASSEMBLIES[kind][0])
    span_m = float(np.ptp(box_m, axis=0)[:2].max())
    for part in cached_props(kind, name):
        assert distance_to_box_m(surface_points_m(part), box_m).min() > 0.02 * span_m


@pytest.mark.slow
@pytest.mark.parametrize("kind", ASSEMBLIES)
@pytest.mark.parametrize("name", TOUCHING)
def test_ties_and_spacers_touch_bars_without_intersection(kind: str, name: str) -> None:
    assembly = ASSEMBLIES[kind][0]
    # A spacer wheel consists of several bodies; each tie is a single body.
    parts = (
        [body for part in cached_props(kind, name) for body in split_bodies(part)]
        if name == "tie-wire"
        else cached_props(kind, name)
    )
    assert len(parts) >= (2 if kind == "pile" else 4)
    for part in parts[:40]:
        assert 0 < distance_to_steel_m(surface_points_m(part, 300), assembly) < 1e-3


def test_each_tie_is_at_two_bars() -> None:
    assembly = ASSEMBLIES["lattice"][0]
    (wire,) = cached_props("lattice", "tie-wire")
    ties = split_bodies(wire)
    assert len(ties) > 40
    for tie in ties:
        middle_m = (tie.mesh.vertices_m.min(axis=0) + tie.mesh.vertices_m.max(axis=0)) / 2
        ends = np.array([np.array(bar.axis_m) for bar in assembly.bars])
        direction = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None]
        distance_m = np.linalg.norm(np.cross(middle_m - ends[:, 0], direction), axis=1)
        assert (distance_m < 0.010).sum() >= 2


@pytest.mark.parametrize("kind", ASSEMBLIES)
def test_clutter_intersects_neither_formwork_nor_clutter(kind: str) -> None:
    props = cached_props(kind, "clutter", "formwork")
    panels = [part for part in props if part.name.startswith("formwork")]
    clutter = [part for part in props if part.name.startswith("clutter")]
    assert len({part.name.split("-")[1] for part in clutter}) >= 6
    for part in clutter:
        points_m = surface_points_m(part)
        for panel in panels:
            corners = panel.mesh.vertices_m
            assert distance_to_box_m(points_m, np.array([corners.min(axis=0), corners.max(axis=0)])).min() > 0
        number = part.name.split("-")[1]
        others = [other for other in clutter if other.name.split("-")[1] != number]
        planes = ConvexHull(part.mesh.vertices_m).equations
        others_m = np.concatenate([surface_points_m(other, 100) for other in others])
        assert (others_m @ planes[:, :3].T + planes[:, 3] > 0).any(axis=1).all()


@pytest.mark.parametrize("kind", ["lattice", "lattice-12"])
def test_clutter_covers_no_marker(kind: str) -> None:
    board = ASSEMBLIES[kind][2]
    assert board is not None
    for seed in range(5):
        points_m = np.concatenate(
            [surface_points_m(part, 200) for part in cached_props(kind, "clutter", seed=seed)]
        )
        for corners in marker_corners_m(board).values():
            low, high = corners.min(axis=0), corners.max(axis=0)
            assert not ((points_m[:, :2] > low[:2]) & (points_m[:, :2] < high[:2])).all(axis=1).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "protocol"),
    [("lattice", LATTICE_DOME), ("lattice", LATTICE_RING), ("pile", PILE_DOME), ("pier", PIER_DOME)],
)
def test_no_camera_is_inside_a_prop(kind: str, protocol: Any) -> None:
    rig, aim_m = RigSpec(), aim_point_m(ASSEMBLIES[kind][0])
    centres_m = np.array(
        [
            camera_centre(camera.cam_from_world)
            for pose in poses(protocol, aim_m, rig, ASSEMBLIES[kind][0].bars)
            for camera in rig_cameras(rig, pose).values()
        ]
    )
    farthest_m = np.linalg.norm(centres_m - aim_m, axis=1).max()
    for seed in range(4):
        for part in cached_props(kind, *FREE_STANDING, seed=seed):
            if part.name.startswith("screen"):
                assert np.linalg.norm(surface_points_m(part) - aim_m, axis=1).min() > farthest_m + 0.02
            else:
                corners = part.mesh.vertices_m
                box_m = np.array([corners.min(axis=0), corners.max(axis=0)])
                assert distance_to_box_m(centres_m, box_m).min() > 0.02


@pytest.mark.slow
def test_clutter_stays_on_slab() -> None:
    for seed in range(3):
        for part in cached_props("pier", "clutter", "formwork", seed=seed):
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
    assembly = cage(side_m, flatness * side_m, slenderness * side_m)
    spec = SceneSpec("any", LatticeSpec(), None, appearance=AppearanceSpec(tuple(PROP_BUILDERS)), seed=seed)
    box_m = steel_box_m(assembly)
    props = make_props(assembly, spec)
    assert {part.bar_id for part in props} == {NOT_STEEL}
    for part in props:
        assert np.isfinite(part.mesh.vertices_m).all()
        assert part.mesh.vertices_m[:, 2].min() > 1e-4
        if part.name.startswith(("tie", "spacer")):
            assert distance_to_steel_m(part.mesh.vertices_m, assembly) > 0
        else:
            assert distance_to_box_m(part.mesh.vertices_m, box_m).min() > 0


@pytest.mark.parametrize("place", [laboratory, outdoors, hall, deck])
def test_environments_are_closed_non_steel_surfaces(place: Any) -> None:
    for part in place():
        body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        assert part.bar_id == NOT_STEEL
        assert body.is_watertight, part.name
        assert body.is_winding_consistent, part.name
        assert body.volume > 0, part.name


def test_outdoor_scene_keeps_camera_area_clear() -> None:
    parts = {part.name: part for part in outdoors()}
    assert parts["slab"].mesh.vertices_m[:, 2].max() == 0.0
    assert parts["ground"].mesh.vertices_m[:, 2].max() < -0.05
    for name, part in parts.items():
        if name not in {"slab", "blinding", "ground"}:
            assert np.linalg.norm(surface_points_m(part, 3000)[:, :2], axis=1).min() > CLEAR_M, name
