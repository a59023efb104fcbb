"""Shapes: ribbed bar meshes (closed, nominal cross-section, ribs as in ASTM A615) and points of surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from dataset_builder.scene.assemblies.pile import RIBS as PILE_RIBS
from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.bar_mesh import STANDARD_RIBS, RibPattern, outer_radius_m, ribbed_bar_mesh
from dataset_builder.scene.shapes.point_sets import SurfaceSampler, covering_points
from tests.builder.scene.cages import Line, line_length_m

_BEND_RAD = np.linspace(0.0, np.pi / 2, 60)
_ARC = 0.03 * np.stack([np.sin(_BEND_RAD), 1 - np.cos(_BEND_RAD), 0 * _BEND_RAD], axis=1)
LINES: dict[str, Line] = {
    "straight": np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
    "stub": np.array([[0.0, 0.0, 0.0], [0.0131, 0.0, 0.0]]),
    "bent": np.concatenate([[[-0.05, 0.0, 0.0]], _ARC, [[0.03, 0.08, 0.02]]]),
}
STRAIGHT = LINES["straight"]
SEEDS = st.integers(0, 2**32 - 1)


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize("diameter_m", [0.004, 0.007, 0.032])
def test_mesh_is_closed_with_the_nominal_cross_section(line: str, diameter_m: float) -> None:
    bar = solid(ribbed_bar_mesh(LINES[line], diameter_m))
    assert bar.is_watertight
    assert bar.is_winding_consistent
    assert bar.area_faces.min() > 0
    nominal_m3 = np.pi / 4 * diameter_m**2 * line_length_m(LINES[line])
    assert bar.volume == pytest.approx(nominal_m3, rel=0.1 if line == "stub" else 0.01)


def test_largest_radius_equals_outer_radius() -> None:
    radius_m = np.linalg.norm(ribbed_bar_mesh(STRAIGHT, 0.007).vertices_m[:, 1:], axis=1)
    assert radius_m.max() == pytest.approx(outer_radius_m(0.007), rel=1e-9)


def test_length_is_exact_and_ends_are_flat() -> None:
    bar = solid(ribbed_bar_mesh(STRAIGHT, 0.007))
    assert bar.vertices[:, 0].min() == pytest.approx(0.0, abs=1e-15)
    assert bar.vertices[:, 0].max() == pytest.approx(0.1, abs=1e-15)
    caps = np.abs(bar.face_normals[:, 0]) > 0.999
    assert bar.area_faces[caps].sum() / 2 == pytest.approx(np.pi / 4 * 0.007**2, rel=0.1)


def rib_positions_m(mesh: Mesh, ribs: RibPattern, diameter_m: float, side: float) -> np.ndarray:
    """Return the x positions of the ribs of the row that faces ``side`` * z, at the centre of the row."""
    angle = np.arctan2(mesh.vertices_m[:, 1], mesh.vertices_m[:, 2] * side)
    radius_m = np.linalg.norm(mesh.vertices_m[:, 1:], axis=1)
    crest = (np.abs(angle) < 0.01) & (radius_m > 0.9999 * radius_m.max())
    first_edges = np.sort(mesh.vertices_m[crest, 0])
    top_m = ribs.top_width * diameter_m
    is_rib_top = np.isclose(np.diff(first_edges), top_m, rtol=1e-6)
    return np.asarray(first_edges[:-1][is_rib_top] + top_m / 2)


def test_rib_rows_are_offset_by_half_a_spacing() -> None:
    diameter_m, ribs = 0.01, RibPattern()
    mesh = ribbed_bar_mesh(STRAIGHT, diameter_m)
    spacing_m = ribs.spacing * diameter_m
    front_m, back_m = (rib_positions_m(mesh, ribs, diameter_m, side) for side in (1.0, -1.0))
    assert spacing_m <= 0.7 * diameter_m
    for row_m in (front_m, back_m):
        assert len(row_m) >= 0.1 / spacing_m - 3
        np.testing.assert_allclose(np.diff(row_m), spacing_m, rtol=1e-9)
    assert ((back_m[3] - front_m[3]) / spacing_m) % 1.0 == pytest.approx(0.5, abs=1e-9)


def test_ribs_are_inclined_and_vanish_at_the_seams() -> None:
    diameter_m, ribs = 0.01, RibPattern()
    mesh = ribbed_bar_mesh(STRAIGHT, diameter_m)
    inside = (mesh.vertices_m[:, 0] > 0.02) & (mesh.vertices_m[:, 0] < 0.08)
    radius_m = np.linalg.norm(mesh.vertices_m[:, 1:], axis=1)
    from_seam_deg = np.rad2deg(np.arctan2(np.abs(mesh.vertices_m[:, 2]), np.abs(mesh.vertices_m[:, 1])))
    seam = inside & (from_seam_deg < 0.5 * ribs.seam_half_deg)
    assert np.ptp(radius_m[seam]) < 1e-12
    assert np.ptp(radius_m[inside & (from_seam_deg > 80)]) == pytest.approx(ribs.height * diameter_m, rel=1e-9)
    # For one ring in the middle of the bar, the step along x per arc length gives the angle to the axis.
    segments = 2 * (ribs.segments_per_row + 3)
    step = np.diff(mesh.vertices_m[segments * 60 : segments * 61], axis=0)
    angle_deg = np.rad2deg(np.arctan2(np.linalg.norm(step[:, 1:], axis=1), np.abs(step[:, 0])))
    assert 55.0 < angle_deg.min() < 65.0


def test_bar_mesh_is_deterministic_and_has_8000_to_16000_triangles() -> None:
    first, second = ribbed_bar_mesh(LINES["bent"], 0.007), ribbed_bar_mesh(LINES["bent"], 0.007)
    assert first.vertices_m.tobytes() == second.vertices_m.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()
    for diameter_m in (0.004, 0.007):
        assert 8_000 <= len(ribbed_bar_mesh(STRAIGHT, diameter_m).faces) <= 16_000


@pytest.mark.parametrize(
    ("centreline_m", "diameter_m", "reason"),
    [
        (STRAIGHT, 0.0, "positive"),
        (np.zeros((1, 3)), 0.007, "two or more"),
        (np.zeros((3, 3)), 0.007, "repeated"),
        (np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]), 0.007, "turns back"),
    ],
)
def test_invalid_bars_are_rejected(centreline_m: Line, diameter_m: float, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ribbed_bar_mesh(centreline_m, diameter_m)


@pytest.mark.parametrize("ribs", [STANDARD_RIBS, PILE_RIBS], ids=["standard", "pile"])
def test_rib_patterns_are_within_the_standard(ribs: RibPattern) -> None:
    assert 0 < ribs.spacing <= 0.7
    assert 45 <= ribs.angle_deg <= 90


def random_mesh(rng: np.random.Generator, triangles: int) -> Mesh:
    """Return triangles of any shape, from specks to slivers of metres."""
    sizes_m = 10.0 ** rng.uniform(-3, 0.7, (triangles, 3, 1))
    corners_m = rng.uniform(-3, 3, (triangles, 1, 3)) + sizes_m * rng.uniform(-1, 1, (triangles, 3, 3))
    return Mesh(corners_m.reshape(-1, 3), np.arange(3 * triangles, dtype=np.int32).reshape(-1, 3))


def test_samples_are_proportional_to_area_with_outward_normals() -> None:
    vertices_m = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5], [0, 3, 5], [0, 0, 7.0]])
    mesh = Mesh(vertices_m, np.array([[0, 1, 2], [3, 4, 5]], np.int32))
    samples = SurfaceSampler(mesh).sample(20_000, np.random.default_rng(0))
    lower = samples.points_m[:, 2] == 0
    assert lower.mean() == pytest.approx(0.5 / (0.5 + 3.0), abs=0.01)
    np.testing.assert_allclose(samples.normals[lower], [[0, 0, 1]] * lower.sum(), atol=1e-12)
    np.testing.assert_allclose(samples.normals[~lower], [[1, 0, 0]] * (~lower).sum(), atol=1e-12)
    assert samples.points_m[lower, :2].sum(axis=1).max() <= 1
    np.testing.assert_allclose(samples.points_m[lower].mean(axis=0), [1 / 3, 1 / 3, 0], atol=0.01)


def test_mesh_without_area_is_refused() -> None:
    for faces in (np.zeros((0, 3), np.int32), np.array([[0, 1, 0]], np.int32)):
        with pytest.raises(ValueError, match="no area"):
            SurfaceSampler(Mesh(np.eye(3), faces))


@settings(max_examples=40)
@given(seed=SEEDS, triangles=st.integers(1, 20), spacing_m=st.floats(0.02, 1.0))
def test_every_point_of_the_surface_is_near_a_covering_point(seed: int, triangles: int, spacing_m: float) -> None:
    rng = np.random.default_rng(seed)
    mesh = random_mesh(rng, triangles)
    corners_m = mesh.vertices_m.reshape(-1, 3, 3)
    weights = rng.dirichlet([0.5, 0.5, 0.5], (len(corners_m), 200))
    surface_m = np.concatenate([np.einsum("tni,tij->tnj", weights, corners_m).reshape(-1, 3), mesh.vertices_m])
    distance_m, _ = cKDTree(covering_points(mesh, spacing_m)).query(surface_m)
    assert distance_m.max() <= spacing_m


def test_fine_detail_gives_few_covering_points() -> None:
    rng = np.random.default_rng(0)
    corners_m = rng.uniform(0, 1, (20_000, 1, 3)) + rng.uniform(0, 1e-3, (20_000, 3, 3))
    mesh = Mesh(corners_m.reshape(-1, 3), np.arange(60_000, dtype=np.int32).reshape(-1, 3))
    assert len(covering_points(mesh, 0.5)) < 200
