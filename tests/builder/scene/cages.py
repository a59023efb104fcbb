"""Cages that no file holds, and distances between the axes of bars. World frame, metres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.cages.generate import GeneratedCage, generate_cage
from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from dataset_builder.user_files.cage_file import cage_assembly, cage_problems, check_values
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.geometry.segments import closest_points_m

Line = Float64[ndarray, "n 3"]
Segments = Float64[ndarray, "n 2 3"]


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
