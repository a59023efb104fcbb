"""Life-size cages as scene files for tests of survey cameras, and distances computed from their bars."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Assembly
from dataset_builder.scene.raycast import RayCaster
from dataset_builder.scene.shapes.solids import world_mesh
from rebar_depth_bench.data.bars import Bar
from tests.builder.scene.cages import point_distances_m, segments_m

Corners = Sequence[tuple[float, float, float]]


def bar_table(diameter_mm: float, corners_mm: Corners) -> str:
    """Return the table of a plain bar."""
    points = [list(corner) for corner in corners_mm]
    return f"[[bar]]\ndiameter = {diameter_mm}\nribs = false\npoints = {points}\n"


def scene(bars: Iterable[str], cameras: str = "") -> str:
    """Return a scene file in millimetres; ``cameras`` are the keys of a survey, or empty for the default."""
    table = f'[cameras]\nkind = "survey"\n{cameras}\n' if cameras else ""
    return f'unit = "mm"\n{table}{"".join(bars)}'


def column() -> list[str]:
    """Return the bars of a column of 0.4 x 0.4 x 2.4 m: four verticals and stirrups."""
    verticals = [bar_table(20, [(x, y, 20), (x, y, 2400)]) for x in (-180, 180) for y in (-180, 180)]
    stirrups = [
        bar_table(10, [(-160, -196, z), (196, -196, z), (196, 196, z), (-196, 196, z), (-196, -160, z)])
        for z in range(100, 2400, 300)
    ]
    return verticals + stirrups


def wall() -> list[str]:
    """Return the bars of a wall mesh of 3 x 2 m."""
    upright = [bar_table(12, [(x, 0, 20), (x, 0, 2000)]) for x in range(-1500, 1501, 250)]
    return upright + [bar_table(10, [(-1500, 12, z), (1500, 12, z)]) for z in range(100, 2000, 250)]


def two_walls() -> list[str]:
    """Return the bars of two wall meshes of 3 x 2 m, 2.5 m apart."""
    meshes = []
    for y in (-1250, 1250):
        meshes += [bar_table(16, [(x, y, 20), (x, y, 2000)]) for x in range(-1500, 1501, 150)]
        meshes += [bar_table(16, [(-1500, y + 16, z), (1500, y + 16, z)]) for z in range(100, 2000, 150)]
    return meshes


def girder(length_mm: int) -> list[str]:
    """Return the bars of a girder along x, 0.5 m wide and 0.8 m high: four main bars and uprights."""
    half = length_mm / 2
    main = [bar_table(25, [(-half, y, z), (half, y, z)]) for y in (-250, 250) for z in (60, 860)]
    return main + [
        bar_table(12, [(x, y, 60), (x, y, 860)])
        for x in np.arange(-half + 200, half, 500).tolist()
        for y in (-270, 270)
    ]


def surface_distance_m(points_m: Float64[ndarray, "n 3"], bars: Sequence[Bar]) -> Float64[ndarray, " n"]:
    """Return the signed distance of points from the nearest bar with rounded ends, negative inside."""
    distances_m = [
        point_distances_m(points_m, segments_m(np.array(bar.axis_m))) - bar.diameter_m / 2 for bar in bars
    ]
    return np.asarray(np.min(distances_m, axis=0))


def steel_caster(assembly: Assembly) -> RayCaster:
    """Return a ray caster of the steel of an assembly as one bar."""
    return RayCaster(world_mesh([part.mesh for part in assembly.parts], [1] * len(assembly.parts)))
