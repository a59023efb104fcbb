"""Cages that no file holds, distances between axes of bars, and clauses of the codes. World frame, metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.cages.design import DesignBar
from dataset_builder.scene.cages.generate import GeneratedCage, generate_cage
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.user_files.cage_file import cage_assembly, cage_problems, check_values
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.segments import closest_points_m

Line = Float64[ndarray, "n 3"]
Segments = Float64[ndarray, "n 2 3"]
EPSILON_M, CHORD_M = 1e-6, 5e-4
"""Tolerances: of lengths, and of the polygons that are the axes of rings and spirals."""
Points = Float64[ndarray, "n 2"]


def assembly_of(bars: Sequence[CageBar], where: str = "a.ifc") -> Assembly:
    """Return the assembly of bars in the world frame. Raises ``MeshError`` as ``load_cage`` for invalid bars."""
    check_values(bars, where)
    return cage_assembly(Cage(tuple(bars), problems=tuple(cage_problems(bars))), where)


def square_cage(side_m: float = 0.30, height_m: float = 0.16, diameter_m: float = 0.012) -> Assembly:
    """Return a square cage of plain straight bars: vertical bars outside, horizontal hoops of four bars inside."""
    half, gap = side_m / 2, 1.02 * diameter_m
    positions_m = np.linspace(-half, half, 4)
    lines = [[(x, y, 0.001), (x, y, height_m)] for x in positions_m for y in (-half, half)]
    for z in np.linspace(0.2, 0.8, 3) * height_m:
        lines += [[(-half, y, z), (half, y, z)] for y in (-half + gap, half - gap)]
        z_next_m = z + 1.1 * gap
        lines += [[(x, -half, z_next_m), (x, half, z_next_m)] for x in (-half + gap, half - gap)]
    bars = tuple(
        Bar(n, "imported", diameter_m, tuple((float(x), float(y), float(z)) for x, y, z in line))
        for n, line in enumerate(lines, start=1)
    )
    parts = tuple(
        Part(f"bar-{bar.bar_id}", plain_bar_mesh(np.array(bar.axis_m), bar.diameter_m), bar.bar_id, "steel")
        for bar in bars
    )
    return Assembly(bars, parts)


@cache
def generated(family: str, number: int = 0) -> GeneratedCage:
    """Return a generated cage."""
    return generate_cage("train", number, 3, family)


def line_length_m(line_m: Line) -> float:
    return float(np.linalg.norm(np.diff(line_m, axis=0), axis=1).sum())


def segments_m(line_m: Line) -> Segments:
    """Return the segments of a polyline."""
    return np.stack([line_m[:-1], line_m[1:]], axis=1)


def segment_distances_m(a_m: Segments, b_m: Segments) -> Float64[ndarray, "n m"]:
    """Return the distances of all pairs of segments, of which those of no length are points."""
    i, j = np.indices((len(a_m), len(b_m))).reshape(2, -1)
    on_a, on_b = closest_points_m(a_m[i, 0], a_m[i, 1], b_m[j, 0], b_m[j, 1])
    return np.asarray(np.linalg.norm(on_a - on_b, axis=1).reshape(len(a_m), len(b_m)))


def point_distances_m(points_m: Float64[ndarray, "n 3"], pieces_m: Segments) -> Float64[ndarray, " n"]:
    """Return the distances of points from the nearest of the segments; infinity without one."""
    start_m, along_m = pieces_m[:, 0], pieces_m[:, 1] - pieces_m[:, 0]
    share = np.einsum("nks,ks->nk", points_m[:, None] - start_m, along_m) / (along_m**2).sum(axis=1)
    nearest_m = start_m + np.clip(share, 0, 1)[..., None] * along_m
    return np.asarray(np.linalg.norm(points_m[:, None] - nearest_m, axis=2).min(axis=1, initial=np.inf))


def gaps_m(lines_m: Sequence[Line], radii_m: Sequence[float], within_m: float = 0.005) -> Float64[ndarray, "n n"]:
    """Return the clear distances of all pairs of bars; infinity for those whose boxes are farther apart."""
    low = np.array([line_m.min(axis=0) - radius_m for line_m, radius_m in zip(lines_m, radii_m, strict=True)])
    high = np.array([line_m.max(axis=0) + radius_m for line_m, radius_m in zip(lines_m, radii_m, strict=True)])
    gaps = np.full((len(lines_m), len(lines_m)), np.inf)
    is_near = (low[:, None] <= high[None] + within_m).all(axis=2)
    for i, j in np.argwhere(np.triu(is_near & is_near.T, k=1)):
        apart_m = segment_distances_m(segments_m(lines_m[i]), segments_m(lines_m[j])).min()
        gaps[i, j] = gaps[j, i] = apart_m - radii_m[i] - radii_m[j]
    return gaps


def least_gap_m(assembly: Assembly, outer_radius_m: Callable[[float], float]) -> float:
    """Return the least clear distance of two bars of an assembly, with the radius of its meshes."""
    bars = assembly.bars
    return float(
        gaps_m([np.array(bar.axis_m) for bar in bars], [outer_radius_m(bar.diameter_m) for bar in bars]).min()
    )


# Clauses of the codes as in ``test_cage_codes``: bars of a design, and what is read from their geometry.


def of(bars: Sequence[DesignBar], *roles: str) -> list[DesignBar]:
    return [bar for bar in bars if bar.role in roles]


def area_m2(bars: Sequence[DesignBar]) -> float:
    return float(sum(np.pi / 4 * bar.diameter_m**2 for bar in bars))


def turned(bars: Sequence[DesignBar], order: tuple[int, int, int]) -> list[DesignBar]:
    """Return bars whose coordinates are in another order."""
    return [DesignBar(bar.role, bar.diameter_m, bar.line_m[:, order]) for bar in bars]


def crossing(bars: Sequence[DesignBar], z: float) -> list[DesignBar]:
    """Return the bars that pass the height z."""
    return [bar for bar in bars if bar.line_m[:, 2].min() <= z <= bar.line_m[:, 2].max()]


def places(bars: Sequence[DesignBar], z: float) -> Points:
    """Return the places (x, y) of straight upright bars, or of their upright parts, at a height."""
    return np.array(
        [
            [np.interp(z, *(bar.line_m[np.argsort(bar.line_m[:, 2])][:, [2, axis]].T)) for axis in (0, 1)]
            for bar in bars
        ]
    )


def apart_m(bars: Sequence[DesignBar], z: float) -> Float64[ndarray, "n n"]:
    """Return the clear distances of upright bars at a height, infinity for a bar and itself."""
    at, diameters = places(bars, z), np.array([bar.diameter_m for bar in bars])
    found = np.linalg.norm(at[:, None] - at[None], axis=2) - (diameters[:, None] + diameters[None]) / 2
    return np.asarray(found + np.diag(np.full(len(bars), np.inf)))


def check_clear(bars: Sequence[DesignBar], z: float) -> None:
    """Check clear distances (8.2 (2)), with bundles of two (8.9.1) and laps (8.7.2 (3)) as what they are."""
    found, lapped = apart_m(bars, z), bool(of(bars, "starter") and of(bars, "main", "upright"))
    is_joined = found < 0.3 * bars[0].diameter_m
    assert is_joined.sum(axis=1).max() <= 1
    for bar, row, joined in zip(bars, found, is_joined, strict=True):
        size_m = bar.diameter_m * (2 if lapped else 2**0.5 if joined.any() else 1)
        assert row[~joined].min() > max(size_m, 0.025) - EPSILON_M


def check_bends(bars: Sequence[DesignBar]) -> None:
    """Check mandrels (8.3): 4 d up to 16 mm, 7 d above."""
    for bar in {(bar.role, bar.diameter_m): bar for bar in bars}.values():
        legs = np.diff(bar.line_m, axis=0)
        lengths_m = np.linalg.norm(legs, axis=1)
        cosine = (legs[:-1] * legs[1:]).sum(axis=1) / (lengths_m[:-1] * lengths_m[1:])
        turn = np.arccos(np.clip(cosine, -1, 1))
        is_bent = turn > 1e-4
        axis_m = np.maximum(lengths_m[:-1], lengths_m[1:])[is_bent] / (2 * np.sin(turn[is_bent] / 2))
        least_m = bar.diameter_m * (2.5 if bar.diameter_m <= 0.016 else 4)
        assert axis_m.min(initial=np.inf) > least_m * 0.999, bar.role


def turn_deg(bar: DesignBar) -> float:
    legs = np.diff(bar.line_m, axis=0)
    legs /= np.linalg.norm(legs, axis=1)[:, None]
    return float(np.degrees(np.arccos(np.clip((legs[:-1] * legs[1:]).sum(axis=1), -1, 1)).sum()))


def check_hooks(bars: Sequence[DesignBar], corners_deg: float) -> None:
    """Check hooks of 135 degrees with ends of 5 d, 50 mm (8.5 (1))."""
    for bar in bars:
        ends_m = np.linalg.norm(np.diff(bar.line_m, axis=0), axis=1)[[0, -1]]
        assert ends_m.min() > max(5 * bar.diameter_m, 0.050) - EPSILON_M
        assert turn_deg(bar) > corners_deg + 2 * 135 - 3


def check_cover(
    bars: Sequence[DesignBar],
    depth_m: Callable[[Float64[ndarray, "n 3"]], Float64[ndarray, " n"]],
    least_m: float = 0.020,
) -> None:
    """Check nominal covers (4.4.1.2 (3), 4.4.1.3 (1)): the bar's diameter and 10 mm, with 10 mm for deviations.

    A bundle counts as a bar of its area. ``depth_m`` is the distance of points from the surface of the concrete.
    """
    for bar in bars:
        size_m = bar.diameter_m * (2**0.5 if "bundle" in bar.role else 1)
        found_m = depth_m(bar.line_m).min() - bar.diameter_m / 2
        assert found_m > max(size_m, 0.010, least_m - 0.010) + 0.010 - CHORD_M, (
            bar.role,
            bar.diameter_m,
            found_m,
        )


def levels_m(bars: Sequence[DesignBar]) -> Float64[ndarray, " n"]:
    return np.sort([(bar.line_m[:, 2].min() + bar.line_m[:, 2].max()) / 2 for bar in bars])


def check_spacing(
    levels: Float64[ndarray, " n"], most_m: float, low_m: float = -np.inf, high_m: float = np.inf
) -> None:
    """Check the spacing of levels between two heights, also of those that are partly between them."""
    is_there = (levels[1:] > low_m + EPSILON_M) & (levels[:-1] < high_m - EPSILON_M)
    assert np.diff(levels)[is_there].max(initial=0) < most_m + EPSILON_M


def check_held(bars: Sequence[DesignBar], ties: Sequence[DesignBar], z: float) -> None:
    """Check that no compressed bar is over 150 mm from one in a corner or held by a tie (9.5.3 (6))."""
    at = places(bars, z)
    held = [at[np.argmax(at @ np.array(corner))] for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    for tie in ties:
        along = int(np.ptp(tie.line_m[:, 0]) < np.ptp(tie.line_m[:, 1]))
        middle = (tie.line_m.max(axis=0) + tie.line_m.min(axis=0)) / 2
        across = at[np.abs(at[:, 1 - along] - middle[1 - along]) < 0.03]
        held += [across[np.argmin(across[:, along])], across[np.argmax(across[:, along])]]
    distance_m = np.linalg.norm(at[:, None] - np.array(held)[None], axis=2).min(axis=1)
    assert distance_m.max() < 0.150 + EPSILON_M


def check_lap(starter: DesignBar, bar: DesignBar, across: Sequence[DesignBar], links: bool) -> None:
    """Check a lap of 40 d, 200 mm (8.7.3) and the bars across it (8.7.4)."""
    size_m = bar.diameter_m
    length_m = max(40 * size_m, 0.200)
    first, last = bar.line_m[:, 2].min(), starter.line_m[:, 2].max()
    levels, tied = levels_m(across), np.array([])
    ends = levels - length_m
    starts = np.array([first, *levels, *ends, *(ends - 4 * size_m + 2 * EPSILON_M)])
    for start in starts[starts >= first]:
        end = start + length_m
        below = (levels <= start + EPSILON_M) & (levels > start - 4 * size_m)
        above = (levels >= end - EPSILON_M) & (levels < end + 4 * size_m)
        if end <= last + EPSILON_M and below.any() and above.any():
            tied = np.array([start, end])
    assert len(tied), "no bar across the lap beyond both of its ends"
    thirds = [
        ((levels >= low - EPSILON_M) & (levels <= high + EPSILON_M)).sum()
        for low, high in ((tied[0], tied[0] + length_m / 3), (tied[1] - length_m / 3, tied[1]))
    ]
    if size_m >= 0.020:
        assert links
        assert min(thirds) * across[0].diameter_m ** 2 >= size_m**2 / 2 - 1e-12
        check_spacing(levels, 0.150, *tied)
    assert ((levels >= first) & (levels <= last)).sum() >= 3
