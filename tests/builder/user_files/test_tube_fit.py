"""Centrelines and diameters fitted to surfaces: bent bars, invariances, and surfaces that are no bar."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.bar_mesh import ribbed_bar_mesh
from dataset_builder.scene.shapes.solids import ring_faces
from dataset_builder.user_files.tubes.tube_fit import MAX_TRIANGLES, Tube, fit_tube
from tests.builder.scene.cages import line_length_m
from tests.builder.user_files.tube_shapes import (
    CENTRELINES_M,
    DIAMETER_M,
    divided,
    line_distance_m,
    remeshed,
    swept,
)


def fit(mesh: Mesh) -> Tube:
    tube = fit_tube(mesh.vertices_m, mesh.faces)
    assert tube is not None
    return tube


@pytest.mark.parametrize(("shape", "facets"), [*product(CENTRELINES_M, (8, 12, 24))])
def test_swept_bars_are_recovered(shape: str, facets: int) -> None:
    line_m = CENTRELINES_M[shape]
    tube = fit(swept(line_m, facets))
    assert tube.diameter_m == pytest.approx(DIAMETER_M, rel=1e-3)
    assert line_length_m(tube.axis_m) == pytest.approx(line_length_m(line_m), rel=1e-3)
    assert line_distance_m(tube.axis_m, line_m) < 0.01 * DIAMETER_M
    assert (tube.axis_m[0] == tube.axis_m[-1]).all() == (shape == "closed hoop")


TESSELLATIONS = {
    "24, divided": lambda line_m: divided(swept(line_m, 24)),
    "12, remeshed": lambda line_m: remeshed(line_m, 12),
    "24, remeshed": lambda line_m: remeshed(line_m, 24),
    "ribbed": lambda line_m: ribbed_bar_mesh(line_m, DIAMETER_M),
}
HOOP_AND_SPIRAL = ("closed hoop", "spiral")
"""Shapes without a ribbed mesh: ribbed bars have two ends, and the ribbed spiral takes seconds."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "tessellation"),
    [
        *product(CENTRELINES_M, ("24, divided", "12, remeshed")),
        ("stirrup with hooks", "24, remeshed"),
        *product(sorted(CENTRELINES_M.keys() - HOOP_AND_SPIRAL), ("ribbed",)),
    ],
)
def test_surfaces_without_rings_and_ribbed_bars(shape: str, tessellation: str) -> None:
    line_m = CENTRELINES_M[shape]
    tube = fit(TESSELLATIONS[tessellation](line_m))
    assert tube.diameter_m == pytest.approx(DIAMETER_M, rel=0.01)
    assert line_length_m(tube.axis_m) == pytest.approx(line_length_m(line_m), rel=0.005)
    assert line_distance_m(tube.axis_m, line_m) < 0.06 * DIAMETER_M


@pytest.mark.slow
@pytest.mark.parametrize(("facets", "relative_error"), [(8, 0.055), (12, 0.025)])
def test_diameter_of_divided_polygons(facets: int, relative_error: float) -> None:
    """The vertices of a divided polygon are on its sides, within the circle: the diameter is too small."""
    line_m = CENTRELINES_M["U-bar"]
    tube = fit(divided(swept(line_m, facets)))
    assert (1 - relative_error) * DIAMETER_M < tube.diameter_m < DIAMETER_M
    assert line_length_m(tube.axis_m) == pytest.approx(line_length_m(line_m), rel=0.005)


@pytest.mark.slow
@settings(max_examples=50)
@given(
    seed=st.integers(0, 2**32 - 1),
    scale=st.sampled_from([1e-3, 1.0, 39.4, 1e3]),
    shape=st.sampled_from(["U-bar", "closed hoop", "cranked"]),
    unshared=st.booleans(),
    inside_out=st.booleans(),
)
def test_fit_does_not_depend_on_order_position_scale_or_sharing(
    seed: int, scale: float, shape: str, unshared: bool, inside_out: bool
) -> None:
    rng = np.random.default_rng(seed)
    line_m, mesh = CENTRELINES_M[shape], swept(CENTRELINES_M[shape], 8)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    place = rng.uniform(-50, 50, 3)
    new_index = rng.permutation(len(mesh.vertices_m))
    vertices_m = np.empty_like(mesh.vertices_m)
    vertices_m[new_index] = scale * (mesh.vertices_m @ rotation.T + place)
    faces = rng.permutation(new_index[mesh.faces])
    faces = faces[:, ::-1] if inside_out else faces
    if unshared:
        vertices_m, faces = vertices_m[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    tube = fit(Mesh(vertices_m, faces))
    expected_m = scale * (line_m @ rotation.T + place)
    assert tube.diameter_m == pytest.approx(scale * DIAMETER_M, rel=1e-3)
    assert line_distance_m(tube.axis_m, expected_m) < 0.01 * scale * DIAMETER_M


def test_open_ends_float32_and_duplicate_triangles() -> None:
    line_m = CENTRELINES_M["U-bar"]
    mesh = swept(line_m, 24)
    open_ends = mesh.faces[: -2 * 22]
    for vertices_m, faces in (
        (mesh.vertices_m, open_ends),
        (mesh.vertices_m, np.concatenate([open_ends, mesh.faces])),
        (mesh.vertices_m.astype(np.float32).astype(np.float64), mesh.faces),
    ):
        tube = fit(Mesh(vertices_m, faces))
        assert tube.diameter_m == pytest.approx(DIAMETER_M, rel=1e-3)
        assert line_distance_m(tube.axis_m, line_m) < 1e-5


def test_sharp_corners_are_kept() -> None:
    corners_m = np.array([[0, 0.4, 0], [0, 0, 0], [0.2, 0, 0], [0.2, 0.4, 0.1]])
    np.testing.assert_allclose(fit(swept(corners_m, 12)).axis_m[[0, 1]], corners_m[[0, 1]], atol=1e-9)


def _bar(sections: int) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(0.005, 0.3, sections=sections)


def _open_pipe(low: float) -> trimesh.Trimesh:
    """Return a pipe without caps and without the part of its side where x < ``low`` radii."""
    body = _bar(64)
    x, y, _ = body.triangles_center.T
    body.update_faces((x > low * 0.005) & (np.hypot(x, y) > 0.004))
    return body


def _double_wall() -> trimesh.Trimesh:
    """Return a bar of 24 sides with a second side, of 12, through the same vertices."""
    bar = swept(np.array([[0.0, 0, 0], [0.3, 0, 0]]), 24)
    inner = ring_faces(2, 12)
    return trimesh.Trimesh(bar.vertices_m, np.concatenate([bar.faces, 2 * inner]), process=False)


OTHER_BODIES = {
    "square": trimesh.creation.box((0.3, 0.01, 0.01)),
    "plate": trimesh.creation.box((0.3, 0.3, 0.01)),
    "triangle": _bar(3),
    "half pipe": _open_pipe(0.0),
    "slit pipe": _open_pipe(-0.93),
    "double wall": _double_wall(),
    "pipe": trimesh.creation.annulus(0.004, 0.005, 0.3),
    "cone": trimesh.creation.cone(0.005, 0.3),
    "sphere": trimesh.creation.icosphere(3, 0.1),
    "disc": trimesh.creation.cylinder(0.01, 0.005),
    "two bars": trimesh.util.concatenate([_bar(24), _bar(24).apply_translation([0.1, 0, 0])]),
    "blob": trimesh.creation.icosphere(1, 0.1),
}


@pytest.mark.parametrize("name", OTHER_BODIES)
def test_other_bodies_are_refused(name: str) -> None:
    body = OTHER_BODIES[name]
    assert fit_tube(np.array(body.vertices), np.array(body.faces)) is None


def test_branching_bars_are_refused() -> None:
    """Two bars that share vertices are one surface, but not one bar."""
    mesh = swept(CENTRELINES_M["U-bar"], 12)
    bodies = [trimesh.Trimesh(mesh.vertices_m * signs, mesh.faces) for signs in ([1, 1, 1], [1, -1, -1])]
    crossing = trimesh.util.concatenate(bodies)
    assert fit_tube(np.array(crossing.vertices), np.array(crossing.faces)) is None


def test_random_degenerate_and_huge_surfaces_are_refused() -> None:
    rng = np.random.default_rng(0)
    line, some = np.outer(np.arange(8.0), [1, 2, 3]), rng.integers(0, 8, (20, 3))
    for vertices_m, faces in (
        (rng.normal(size=(200, 3)), rng.integers(0, 200, (600, 3))),
        (rng.normal(size=(200, 3)), rng.integers(0, 200, (600, 3))),
        (np.zeros((8, 3)), some),
        (line, some),
        (np.full((8, 3), np.inf), some),
        (line, np.zeros((MAX_TRIANGLES + 1, 3), dtype=np.int32)),
    ):
        with np.errstate(invalid="ignore"):
            assert fit_tube(vertices_m, faces) is None
