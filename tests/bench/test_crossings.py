"""Crossings of bars: their definition in scenes solved by hand, invariances, and the table of a folder."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

import rebar_depth_bench as rdb
from rebar_depth_bench.bar_crossings.crossings_file import (
    CROSSINGS_SCHEMA,
    CrossingsSource,
    folder_crossings,
    read_crossings,
    write_crossings,
)
from rebar_depth_bench.bar_crossings.definition import MAX_GAP_M, Crossings, crossing_parameters, scene_crossings
from rebar_depth_bench.base.errors import DatasetError
from rebar_depth_bench.data.bars import Bar, read_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.data.manifest import open_folder

D = 0.02


def bar(bar_id: int, *points_m: Sequence[float], diameter_m: float = D) -> Bar:
    return Bar(bar_id, "bar", diameter_m, tuple((float(x), float(y), float(z)) for x, y, z in points_m))


def along_x(bar_id: int, y: float = 0.0, z: float = 0.0, diameter_m: float = D) -> Bar:
    return bar(bar_id, (-0.5, y, z), (0.5, y, z), diameter_m=diameter_m)


def along_y(bar_id: int, x: float = 0.0, z: float = 0.0, diameter_m: float = D) -> Bar:
    return bar(bar_id, (x, -0.5, z), (x, 0.5, z), diameter_m=diameter_m)


def helix(bar_id: int, turns: float, radius_m: float, pitch_m: float, steps: int = 36) -> Bar:
    angle = np.linspace(0, 2 * np.pi * turns, round(steps * turns) + 1)
    points_m = np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), pitch_m * angle / (2 * np.pi)])
    return bar(bar_id, *points_m)


def pairs(crossings: Crossings) -> list[tuple[int, int]]:
    return list(zip(crossings.bar_a.tolist(), crossings.bar_b.tolist(), strict=True))


def test_two_bars_by_hand() -> None:
    """Cross a 20 mm bar and a 10 mm bar 18 mm above it: surfaces at z = 10 and 13 mm, 3 mm apart."""
    found = scene_crossings([along_x(4), along_y(2, x=0.1, z=0.018, diameter_m=0.01)])
    assert (pairs(found), found.node_id.tolist(), found.crossing_id.tolist()) == ([(2, 4)], [1], [1])
    np.testing.assert_allclose(found.point_a_m, [[0.1, 0, 0.018]], atol=1e-12)
    np.testing.assert_allclose(found.point_b_m, [[0.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.tie_point_m, [[0.1, 0, (0.010 + 0.013) / 2]], atol=1e-12)
    np.testing.assert_allclose(found.normal, [[0, 0, -1]], atol=1e-12)
    assert found.gap_m[0] == pytest.approx(0.003)
    assert found.angle_deg[0] == pytest.approx(90)


def test_three_bars_of_one_node_by_hand() -> None:
    """Stack three bars 1.5 mm apart: along x, along y and along x."""
    found = scene_crossings([along_x(1), along_y(2, z=0.021, diameter_m=0.019), along_x(3, z=0.042)])
    # Surfaces: 1 at 10 mm, 2 from 11.5 to 30.5 mm, 3 from 32 mm. The ties are 20.5 mm apart: two nodes.
    assert pairs(found) == [(1, 2), (2, 3)]
    np.testing.assert_allclose(1e3 * found.tie_point_m[:, 2], [10.75, 31.25], atol=1e-9)
    np.testing.assert_allclose(1e3 * found.gap_m, [1.5, 1.5], atol=1e-9)
    assert found.node_id.tolist() == [1, 2]
    # With a 16 mm bar in the middle the ties are 17 mm apart, below the largest diameter involved.
    found = scene_crossings([along_x(1), along_y(2, z=0.0185, diameter_m=0.016), along_x(3, z=0.037)])
    np.testing.assert_allclose(1e3 * found.tie_point_m[:, 2], [10.25, 26.75], atol=1e-9)
    assert found.node_id.tolist() == [1, 1]
    assert found.nodes == 1


def test_four_bars_of_a_mat_by_hand() -> None:
    found = scene_crossings([along_x(1), along_x(2, y=0.2), along_y(3, z=0.02), along_y(4, x=0.3, z=0.022)])
    assert pairs(found) == [(1, 3), (1, 4), (2, 3), (2, 4)]
    np.testing.assert_allclose(1e3 * found.gap_m, [0, 2, 0, 2], atol=1e-9)
    corners_m = [[0.0, 0.0], [0.3, 0.0], [0.0, 0.2], [0.3, 0.2]]
    np.testing.assert_allclose(found.tie_point_m[:, :2], corners_m, atol=1e-12)
    assert found.node_id.tolist() == [1, 2, 3, 4]


def test_no_bars_no_axis_and_no_crossing_give_no_rows() -> None:
    for bars in ([], [along_x(1)], [Bar.without_axis(1, "steel"), along_x(2)], [along_x(1), along_x(2, y=0.021)]):
        assert len(scene_crossings(bars)) == 0
    assert pairs(scene_crossings([along_x(1), Bar.without_axis(2, "steel"), along_y(3, z=D)])) == [(1, 3)]


@pytest.mark.parametrize(("gap_mm", "crosses"), [(4.999, True), (5.001, False), (-3.0, True), (-20.0, True)])
def test_gap_limit_is_signed(gap_mm: float, crosses: bool) -> None:
    """Cylinders may intersect, also so far that their axes do."""
    found = scene_crossings([along_x(1), along_y(2, z=D + gap_mm / 1000)])
    assert len(found) == crosses
    if crosses:
        assert 1e3 * found.gap_m[0] == pytest.approx(gap_mm, abs=1e-6)
        assert found.tie_point_m[0, 2] == pytest.approx((D + gap_mm / 1000) / 2)


@pytest.mark.parametrize(("angle_deg", "crosses"), [(20.01, True), (19.99, False), (0.0, False)])
def test_laps_and_bundles_are_no_crossings(angle_deg: float, crosses: bool) -> None:
    turned = math.radians(angle_deg)
    x, y = 0.5 * math.cos(turned), 0.5 * math.sin(turned)
    found = scene_crossings([along_x(1), bar(2, (-x, -y, 0.021), (x, y, 0.021))])
    assert len(found) == crosses
    if crosses:
        assert found.angle_deg[0] == pytest.approx(angle_deg)


def test_ends_do_not_cross() -> None:
    """A bar that ends on another, or whose end is its closest point, has its minimum at an end."""
    assert len(scene_crossings([along_x(1), bar(2, (0, 0, D), (0, 0.5, D))])) == 0
    assert len(scene_crossings([along_x(1), bar(2, (0, 0, D), (0, 0.1, 0.1))])) == 0
    assert len(scene_crossings([along_x(1), bar(2, (0, -1e-6, D), (0, 0.5, D))])) == 1


def test_vertices_of_a_straight_axis_change_nothing() -> None:
    """Put a vertex of both axes exactly at the crossing, where four pairs of segments have the minimum."""
    plain = scene_crossings([along_x(1), along_y(2, z=D)])
    points = [-0.5, -0.2, 0.0, 0.0, 0.3, 0.5]
    split = [bar(1, *((x, 0, 0) for x in points)), bar(2, *((0, y, D) for y in points))]
    found = scene_crossings(split)
    assert pairs(found) == [(1, 2)]
    for name in ("tie_point_m", "gap_m", "angle_deg", "normal"):
        np.testing.assert_allclose(np.abs(getattr(found, name)), np.abs(getattr(plain, name)), atol=1e-12)


def test_bar_that_crosses_itself() -> None:
    """A loop whose leg passes 22 mm above its start; ``a`` is the earlier part of the bar."""
    loop = bar(7, (-0.5, 0, 0), (0.3, 0, 0), (0.3, 0.3, 0.011), (0, 0.3, 0.022), (0, -0.3, 0.022))
    found = scene_crossings([loop])
    assert pairs(found) == [(7, 7)]
    np.testing.assert_allclose(found.point_a_m, [[0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.point_b_m, [[0, 0, 0.022]], atol=1e-12)
    assert found.gap_m[0] == pytest.approx(0.002)
    np.testing.assert_allclose(found.normal, [[0, 0, 1]], atol=1e-12)


def test_bar_crosses_itself_only_six_diameters_along() -> None:
    """A loop of a triangle with sides of 5 s, 6 s and 5 s, whose middle side climbs by 20.5 mm."""
    for s_m, crosses in ((0.0071, False), (0.0073, True)):  # Around the loop: 118 and 121 mm; 6 d are 120 mm.
        loop = [(-30, -40, 0), (3, 4, 0), (-3, 4, 0), (30, -40, 0)]
        heights_m = (0, 0, 0.0205, 0.0205)
        axis_m = [(x * s_m, y * s_m, z) for (x, y, _), z in zip(loop, heights_m, strict=True)]
        assert len(scene_crossings([bar(1, *axis_m)])) == crosses, s_m


def test_closed_hoop_crosses_where_it_starts() -> None:
    """A closed axis has no ends: a bar that crosses at the first point of the hoop crosses it."""
    angle = np.linspace(0, 2 * np.pi, 61)
    ring_m = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    ring_m[-1] = ring_m[0]
    upright = bar(2, (1 + D, 0, -0.5), (1 + D, 0, 0.5))
    assert pairs(scene_crossings([bar(1, *ring_m), upright])) == [(1, 2)]
    assert len(scene_crossings([bar(1, *ring_m[:-1]), upright])) == 0


def test_linked_minima_are_one_crossing_at_the_middle_one() -> None:
    """Cross a bar five times by a zigzag above it, every 12 mm and at 45 degrees."""
    zigzag = [(0.012 * i, 0.006 * (-1) ** i, 0.021) for i in range(6)]
    wave, lying = bar(1, *zigzag), along_x(2)
    found = scene_crossings([wave, lying])
    assert pairs(found) == [(1, 2)]
    third_m = [[0.030, 0, 0.021]]  # Of 6, 18, 30, 42, 54 mm.
    np.testing.assert_allclose(found.point_a_m, third_m, atol=1e-12)
    second_m = [[0.018, 0, 0.021]]  # The first of the two in the middle.
    np.testing.assert_allclose(scene_crossings([bar(1, *zigzag[:-1]), lying]).point_a_m, second_m, atol=1e-12)
    thin = [Bar(b.bar_id, b.role, 0.011, tuple((x, y, z * 0.6) for x, y, z in b.axis_m)) for b in (wave, lying)]
    assert len(scene_crossings(thin)) == 5


def test_spiral_crosses_each_upright_once_a_turn() -> None:
    uprights = [
        bar(i + 2, *((0.178 * math.cos(a), 0.178 * math.sin(a), z) for z in (-0.1, 0.7)))
        for i, a in enumerate(np.deg2rad([10, 100, 190, 280]))
    ]
    found = scene_crossings([helix(1, 5, 0.2, 0.1, steps=72), *uprights])
    assert pairs(found) == sorted([(1, i + 2) for i in range(4)] * 5)
    # The polyline is up to 0.2 mm inside the helix.
    assert found.gap_m == pytest.approx(np.full(20, 0.002), abs=3e-4)


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_rigid_motion_and_order_of_bars_change_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bars = random_bars(rng, 12)
    found = scene_crossings(bars)
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift_m = rng.uniform(-2, 2, 3)
    moved = [bar(b.bar_id, *(np.array(b.axis_m) @ rotation.T + shift_m), diameter_m=b.diameter_m) for b in bars]
    again = scene_crossings([moved[i] for i in rng.permutation(len(moved))])
    assert pairs(again) == pairs(found)
    assert again.node_id.tolist() == found.node_id.tolist()
    np.testing.assert_allclose(again.gap_m, found.gap_m, atol=1e-9)
    np.testing.assert_allclose(again.angle_deg, found.angle_deg, atol=1e-6)
    np.testing.assert_allclose(again.tie_point_m, found.tie_point_m @ rotation.T + shift_m, atol=1e-8)
    np.testing.assert_allclose(again.normal, found.normal @ rotation.T, atol=1e-8)


def random_bars(rng: np.random.Generator, count: int) -> list[Bar]:
    """Return straight and bent bars in a cube of 0.3 m."""
    return [
        bar(
            i + 1,
            *rng.uniform(-0.15, 0.15, (int(rng.integers(2, 5)), 3)),
            diameter_m=float(rng.uniform(0.01, 0.03)),
        )
        for i in range(count)
    ]


def sampled_minima(first: Bar, second: Bar, step_m: float) -> list[ndarray]:
    """Return the middles of local minima of the distance of two axes, by brute force on a grid of both."""

    def samples(steel: Bar) -> ndarray:
        pieces = [
            np.linspace(a, b, max(2, round(math.dist(a, b) / step_m)), endpoint=False)
            for a, b in pairwise(np.array(steel.axis_m))
        ]
        return np.concatenate([*pieces, [steel.axis_m[-1]]])

    a_m, b_m = samples(first), samples(second)
    apart_m = np.linalg.norm(a_m[:, None] - b_m, axis=2)
    padded = np.pad(apart_m, 1, constant_values=np.inf)
    rows, columns = apart_m.shape
    neighbours = [padded[i : i + rows, j : j + columns] for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    lowest = (apart_m <= np.min(neighbours, axis=0)) & (
        apart_m - (first.diameter_m + second.diameter_m) / 2 < 0.0045
    )
    found = np.argwhere(lowest)
    inside = (found > 2).all(axis=1) & (found < np.array([rows, columns]) - 3).all(axis=1)
    return [(a_m[i] + b_m[j]) / 2 for i, j in found[inside]]


@settings(max_examples=8)
@given(st.integers(0, 2**32 - 1))
def test_every_sharp_minimum_of_a_brute_force_search_is_a_crossing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bars = [bar(i + 1, *rng.uniform(-0.15, 0.15, (2, 3)), diameter_m=0.03) for i in range(8)]
    found = scene_crossings(bars)
    for i, first in enumerate(bars):
        for second in bars[i + 1 :]:
            u, v = (np.subtract(b.axis_m[1], b.axis_m[0]) for b in (first, second))
            angle = math.degrees(math.acos(min(1, abs(u @ v) / np.linalg.norm(u) / np.linalg.norm(v))))
            middles = sampled_minima(first, second, 0.002)
            chosen = (found.bar_a == first.bar_id) & (found.bar_b == second.bar_id)
            if middles and angle > 21:
                assert np.count_nonzero(chosen) == 1
                assert np.linalg.norm((found.point_a_m + found.point_b_m)[chosen][0] / 2 - middles[0]) < 0.01


def test_lattice_has_375_contacts(tiny_root: Path) -> None:
    """Its 75 rods touch in 375 places; a limit of 10 mm would add 300 pairs of the next layer."""
    bars = read_bars(tiny_root / "bars.parquet")["lattice"]
    found = scene_crossings(bars)
    assert (len(found), found.nodes) == (375, 375)
    assert found.angle_deg == pytest.approx(np.full(375, 90.0))
    assert len(scene_crossings(bars, 0.010)) == 675
    assert found.gap_m.max() < MAX_GAP_M


X = Bar(3, "x", 0.02, ((-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)))
Y = Bar(9, "y", 0.01, ((0.0, -0.1, 0.018), (0.0, 0.1, 0.018)))
ROW = {
    "scene": "mat", "crossing_id": 1, "node_id": 1, "bar_a": 3, "bar_b": 9, "point_a": [0.0, 0.0, 0.0],
    "point_b": [0.0, 0.0, 0.018], "tie_point": [0.0, 0.0, 0.0115], "gap_m": 0.003, "angle_deg": 90.0,
    "normal": [0.0, 0.0, 1.0],
}  # fmt: skip


def assert_equal(found: Crossings, expected: Crossings) -> None:
    for field in fields(Crossings):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name))


@pytest.fixture
def older(tiny_root: Path, tmp_path: Path) -> Path:
    """Return a folder as versions without crossings wrote it."""
    root = tmp_path / "older"
    shutil.copytree(tiny_root, root)
    manifest = json.loads((root / "manifest.json").read_text())
    del manifest["crossings"], manifest["files"]["crossings.parquet"]
    (root / "manifest.json").write_text(json.dumps(manifest))
    (root / "crossings.parquet").unlink()
    return root


def test_table_holds_what_was_computed(tmp_path: Path) -> None:
    write_crossings(tmp_path / "crossings.parquet", {"mat": (X, Y), "empty": (X,)})
    (row,) = pq.read_table(tmp_path / "crossings.parquet").to_pylist()
    assert row == {**ROW, "gap_m": pytest.approx(0.003), "tie_point": pytest.approx([0.0, 0.0, 0.0115])}
    found = read_crossings(tmp_path / "crossings.parquet")
    assert set(found) == {"mat"}
    assert_equal(found["mat"], scene_crossings((X, Y)))
    write_crossings(tmp_path / "none.parquet", {"empty": (X,)})
    assert read_crossings(tmp_path / "none.parquet") == {}


def test_built_folder_has_table_parameters_and_digest(tiny_root: Path) -> None:
    manifest = json.loads((tiny_root / "manifest.json").read_text())
    sha256 = file_sha256(tiny_root / "crossings.parquet")
    assert manifest["files"]["crossings.parquet"] == sha256
    file = {"file": "crossings.parquet", "digest": f"sha256:{sha256}"}
    assert manifest["crossings"] == {**crossing_parameters(), **file}
    by_scene, source = folder_crossings(open_folder(tiny_root))
    assert source == CrossingsSource("crossings.parquet", sha256)
    assert_equal(by_scene["lattice"], scene_crossings(read_bars(tiny_root / "bars.parquet")["lattice"]))


def test_crossings_are_a_frame_and_those_of_an_older_folder_follow_from_its_bars(
    tiny_root: Path, older: Path
) -> None:
    by_scene, source = folder_crossings(open_folder(older))
    assert source == CrossingsSource("bars.parquet", file_sha256(older / "bars.parquet"))
    assert_equal(by_scene["lattice"], read_crossings(tiny_root / "crossings.parquet")["lattice"])
    for root in (tiny_root, older):
        frame = rdb.crossings(root)
        assert list(frame.columns) == CROSSINGS_SCHEMA.names
        assert (len(frame), frame["tie_point"][0].shape) == (375, (3,))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"crossing_id": 2}, "crossing_id to count from 1"),
        ({"node_id": 0}, "node_id of 1 or more"),
        ({"bar_a": 0}, "1 <= bar_a <= bar_b"),
        ({"bar_b": 2}, "1 <= bar_a <= bar_b"),
        ({"gap_m": float("nan")}, "finite numbers"),
        ({"tie_point": [0.0, 0.0, float("inf")]}, "finite numbers"),
        ({"normal": [0.0, 0.0, 2.0]}, "normals of length 1"),
        ({"gap_m": None}, "has no value in a column"),
        ({"point_a": [0.0, None, 0.0]}, "has no value in a column"),
    ],
)
def test_invalid_crossing_is_named_in_error(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = tmp_path / "crossings.parquet"
    pq.write_table(pa.Table.from_pylist([{**ROW, **change}], schema=CROSSINGS_SCHEMA), path)
    with pytest.raises(DatasetError, match=said) as raised:
        read_crossings(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("content", [None, b"PAR1 no more than that"], ids=["missing", "garbage"])
def test_unreadable_table_is_named_in_error(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "crossings.parquet"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=str(path)):
        read_crossings(path)


def test_crossing_of_unknown_bar_and_changed_file_are_refused(tiny_root: Path, tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(tiny_root, root)
    path = root / "crossings.parquet"
    pq.write_table(
        pa.Table.from_pylist([{**ROW, "scene": "lattice", "bar_b": 900}], schema=CROSSINGS_SCHEMA), path
    )
    with pytest.raises(DatasetError, match="the SHA-256 is"):
        folder_crossings(open_folder(root))
    manifest = json.loads((root / "manifest.json").read_text())
    manifest["files"]["crossings.parquet"] = file_sha256(path)
    (root / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(DatasetError, match="'lattice' has a crossing of bar 900, expected bars with an axis"):
        folder_crossings(open_folder(root))
