"""Ribbed bar mesh: closed, outward-oriented, nominal cross-section, ribs according to ASTM A615."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.pile import RIBS as PILE_RIBS
from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.bar_mesh import STANDARD_RIBS, RibPattern, outer_radius_m, ribbed_bar_mesh

LENGTH_M = 0.1


def straight_centreline_m(length_m: float = LENGTH_M) -> Float64[ndarray, "2 3"]:
    return np.array([[0.0, 0.0, 0.0], [length_m, 0.0, 0.0]])


def bent_centreline_m() -> Float64[ndarray, "n 3"]:
    angle = np.linspace(0.0, np.pi / 2, 60)
    arc = 0.03 * np.stack([np.sin(angle), 1 - np.cos(angle), 0 * angle], axis=1)
    return np.concatenate([[[-0.05, 0.0, 0.0]], arc, [[0.03, 0.08, 0.02]]])


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


@pytest.mark.parametrize(
    "centreline_m",
    [straight_centreline_m(), straight_centreline_m(0.0131), bent_centreline_m()],
    ids=["straight", "stub", "bent"],
)
@pytest.mark.parametrize("diameter_m", [0.004, 0.007])
def test_mesh_is_watertight_and_outward(centreline_m: Float64[ndarray, "n 3"], diameter_m: float) -> None:
    bar = solid(ribbed_bar_mesh(centreline_m, diameter_m))
    assert bar.is_watertight
    assert bar.is_winding_consistent
    assert bar.volume > 0
    assert bar.area_faces.min() > 0


@pytest.mark.parametrize("diameter_m", [0.004, 0.007, 0.032])
@pytest.mark.parametrize("centreline_m", [straight_centreline_m(), bent_centreline_m()], ids=["straight", "bent"])
def test_mean_cross_section_is_nominal(centreline_m: Float64[ndarray, "n 3"], diameter_m: float) -> None:
    length_m = np.linalg.norm(np.diff(centreline_m, axis=0), axis=1).sum()
    mean_area = solid(ribbed_bar_mesh(centreline_m, diameter_m)).volume / length_m
    assert mean_area == pytest.approx(np.pi / 4 * diameter_m**2, rel=0.01)


def test_largest_radius_equals_outer_radius() -> None:
    radius_m = np.linalg.norm(ribbed_bar_mesh(straight_centreline_m(), 0.007).vertices_m[:, 1:], axis=1)
    assert radius_m.max() == pytest.approx(outer_radius_m(0.007), rel=1e-9)


def test_length_is_exact_and_ends_are_flat() -> None:
    bar = solid(ribbed_bar_mesh(straight_centreline_m(), 0.007))
    assert bar.vertices[:, 0].min() == pytest.approx(0.0, abs=1e-15)
    assert bar.vertices[:, 0].max() == pytest.approx(LENGTH_M, abs=1e-15)
    caps = np.abs(bar.face_normals[:, 0]) > 0.999
    assert bar.area_faces[caps].sum() / 2 == pytest.approx(np.pi / 4 * 0.007**2, rel=0.1)


def rib_positions_m(mesh: Mesh, ribs: RibPattern, diameter_m: float, side: float) -> Float64[ndarray, " n"]:
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
    mesh = ribbed_bar_mesh(straight_centreline_m(), diameter_m)
    spacing_m = ribs.spacing * diameter_m
    front_m, back_m = (rib_positions_m(mesh, ribs, diameter_m, side) for side in (1.0, -1.0))
    assert spacing_m <= 0.7 * diameter_m
    for row_m in (front_m, back_m):
        assert len(row_m) >= LENGTH_M / spacing_m - 3
        np.testing.assert_allclose(np.diff(row_m), spacing_m, rtol=1e-9)
    assert ((back_m[3] - front_m[3]) / spacing_m) % 1.0 == pytest.approx(0.5, abs=1e-9)


def test_ribs_are_inclined_and_vanish_at_the_seams() -> None:
    diameter_m, ribs = 0.01, RibPattern()
    mesh = ribbed_bar_mesh(straight_centreline_m(), diameter_m)
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


def test_triangle_count_is_8000_to_16000() -> None:
    assert 8_000 <= len(ribbed_bar_mesh(straight_centreline_m(), 0.007).faces) <= 16_000
    assert 8_000 <= len(ribbed_bar_mesh(straight_centreline_m(), 0.004).faces) <= 16_000


def test_bar_mesh_is_deterministic() -> None:
    first, second = ribbed_bar_mesh(bent_centreline_m(), 0.007), ribbed_bar_mesh(bent_centreline_m(), 0.007)
    assert first.vertices_m.tobytes() == second.vertices_m.tobytes()
    assert first.faces.tobytes() == second.faces.tobytes()


@pytest.mark.parametrize(
    ("centreline_m", "diameter_m", "reason"),
    [
        (straight_centreline_m(), 0.0, "positive"),
        (np.zeros((1, 3)), 0.007, "two or more"),
        (np.zeros((3, 3)), 0.007, "repeated"),
        (np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]), 0.007, "turns back"),
    ],
)
def test_invalid_bars_are_rejected(centreline_m: Float64[ndarray, "n 3"], diameter_m: float, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        ribbed_bar_mesh(centreline_m, diameter_m)


@pytest.mark.parametrize("ribs", [STANDARD_RIBS, PILE_RIBS], ids=["standard", "pile"])
def test_rib_patterns_are_within_the_standard(ribs: RibPattern) -> None:
    assert 0 < ribs.spacing <= 0.7
    assert 45 <= ribs.angle_deg <= 90
