"""Square cage of plain bars."""

from __future__ import annotations

import numpy as np

from dataset_builder.scene.model import Assembly, Part
from dataset_builder.scene.shapes.bar_mesh import plain_bar_mesh
from rebar_depth_bench.data.bars import Bar


def cage(side_m: float = 0.30, height_m: float = 0.16, diameter_m: float = 0.012) -> Assembly:
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
