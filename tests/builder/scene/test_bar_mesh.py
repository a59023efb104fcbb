"""The ribbed bar: closed, oriented, of nominal cross-section, ribbed as ASTM A615 asks."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh
from dataset_builder.scene.shapes.bar_mesh import RibPattern, outer_radius_m, ribbed_bar_mesh

LENGTH_M = 0.1


def straight(length_m: float = LENGTH_M) -> Float64[ndarray, "2 3"]:
    return np.array([[0.0, 0.0, 0.0], [length_m, 0.0, 0.0]])


def bent() -> Float64[ndarray, "n 3"]:
    turn = np.linspace(0.0, np.pi / 2, 60)
    arc = 0.03 * np.stack([np.sin(turn), 1 - np.cos(turn), 0 * turn], axis=1)
    return np.concatenate([[[-0.05, 0.0, 0.0]], arc, [[0.03, 0.08, 0.02]]])


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)


@pytest.mark.parametrize("centreline_m", [straight(), straight(0.0131), bent()], ids=["straight", "stub", "bent"])
@pytest.mark.parametrize("diameter_m", [0.004, 0.007])
def test_watertight_and_outward(centreline_m: Float64[ndarray, "n 3"], diameter_m: float) -> None:
    bar = solid(ribbed_bar_mesh(centreline_m, diameter_m))
    assert bar.is_watertight
    assert bar.is_winding_consistent
    assert bar.volume > 0
    assert bar.area_faces.min() > 0


@pytest.mark.parametrize("diameter_m", [0.004, 0.007, 0.032])
@pytest.mark.parametrize("centreline_m", [straight(), bent()], ids=["straight", "bent"])
def test_mean_cross_section_is_nominal(centreline_m: Float64[ndarray, "n 3"], diameter_m: float) -> None:
    length_m = np.linalg.norm(np.diff(centreline_m, axis=0), axis=1).sum()
    mean_area = solid(ribbed_bar_mesh(centreline_m, diameter_m)).volume / length_m
    assert mean_area == pytest.approx(np.pi / 4 * diameter_m**2, rel=0.01)


def test_outer_radius_is_reached_and_not_exceeded() -> None:
    radius_m = np.linalg.norm(ribbed_bar_mesh(straight(), 0.007).vertices_m[:, 1:], axis=1)
    assert radius_m.max() == pytest.approx(outer_radius_m(0.007), rel=1e-9)


def test_length_is_exact_and_ends_are_flat() -> None:
    bar = solid(ribbed_bar_mesh(straight(), 0.007))
    assert bar.vertices[:, 0].min() == pytest.approx(0.0, abs=1e-15)
    assert bar.vertices[:, 0].max() == pytest.approx(LENGTH_M, abs=1e-15)
    caps = np.abs(bar.face_normals[:, 0]) > 0.999
    assert bar.area_faces[caps].sum() / 2 == pytest.approx(np.pi / 4 * 0.007**2, rel=0.1)


def ribs_at_m(mesh: Mesh, ribs: RibPattern, diameter_m: float, side: float) -> Float64[ndarray, " n"]:
    """Return where along x the ribs of the row that faces ``side`` * z stand, in the row's middle."""
    around = np.arctan2(mesh.vertices_m[:, 1], mesh.vertices_m[:, 2] * side)
    radius_m = np.linalg.norm(mesh.vertices_m[:, 1:], axis=1)
    crest = (np.abs(around) < 0.01) & (radius_m > 0.9999 * radius_m.max())
    first_edges = np.sort(mesh.vertices_m[crest, 0])
    top_m = ribs.top_width * diameter_m
    pairs = np.isclose(np.diff(first_edges), top_m, rtol=1e-6)
    return np.asarray(first_edges[:-1][pairs] + top_m / 2)


def test_two_rows_of_ribs_half_a_spacing_apart() -> None:
    diameter_m, ribs = 0.01, RibPattern()
    mesh = ribbed_bar_mesh(straight(), diameter_m)
    spacing_m = ribs.spacing * diameter_m
    one, other = (ribs_at_m(mesh, ribs, diameter_m, side) for side in (1.0, -1.0))
    assert spacing_m <= 0.7 * diameter_m
    for row in (one, other):
        assert len(row) >= LENGTH_M / spacing_m - 3
        np.testing.assert_allclose(np.diff(row), spacing_m, rtol=1e-9)
    assert ((other[3] - one[3]) / spacing_m) % 1.0 == pytest.approx(0.5, abs=1e-9)


def test_ribs_are_inclined_and_vanish_at_the_seams() -> None:
    diameter_m, ribs = 0.01, RibPattern()
    mesh = ribbed_bar_mesh(straight(), diameter_m)
    inside = (mesh.vertices_m[:, 0] > 0.02) & (mesh.vertices_m[:, 0] < 0.08)
    radius_m = np.linalg.norm(mesh.vertices_m[:, 1:], axis=1)
    from_seam_deg = np.rad2deg(np.arctan2(np.abs(mesh.vertices_m[:, 2]), np.abs(mesh.vertices_m[:, 1])))
    seam = inside & (from_seam_deg < 0.5 * ribs.seam_half_deg)
    assert np.ptp(radius_m[seam]) < 1e-12
    assert np.ptp(radius_m[inside & (from_seam_deg > 80)]) == pytest.approx(ribs.height * diameter_m, rel=1e-9)
    # One ring in the middle of the bar: its step along x per arc round the bar gives the angle to the axis.
    segments = 2 * (ribs.segments_per_row + 3)
    step = np.diff(mesh.vertices_m[segments * 60 : segments * 61], axis=0)
    angle_deg = np.rad2deg(np.arctan2(np.linalg.norm(step[:, 1:], axis=1), np.abs(step[:, 0])))
    assert 55.0 < angle_deg.min() < 65.0


def test_triangle_count_stays_moderate() -> None:
    assert 8_000 <= len(ribbed_bar_mesh(straight(), 0.007).faces) <= 16_000
    assert 8_000 <= len(ribbed_bar_mesh(straight(), 0.004).faces) <= 16_000


def test_the_same_bar_twice_is_the_same_bytes() -> None:
    one, other = ribbed_bar_mesh(bent(), 0.007), ribbed_bar_mesh(bent(), 0.007)
    assert one.vertices_m.tobytes() == other.vertices_m.tobytes()
    assert one.faces.tobytes() == other.faces.tobytes()


@pytest.mark.parametrize(
    ("centreline_m", "diameter_m", "reason"),
    [
        (straight(), 0.0, "positive"),
        (np.zeros((1, 3)), 0.007, "two or more"),
        (np.zeros((3, 3)), 0.007, "repeated"),
        (np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.0, 0.0]]), 0.007, "turns back"),
    ],
)
def test_impossible_bars_are_refused(
    centreline_m: Float64[ndarray, "n 3"], diameter_m: float, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        ribbed_bar_mesh(centreline_m, diameter_m)


def test_patterns_outside_the_standard_are_refused() -> None:
    with pytest.raises(ValueError, match="spacing"):
        RibPattern(spacing=0.8)
    with pytest.raises(ValueError, match="angle"):
        RibPattern(angle_deg=40.0)
