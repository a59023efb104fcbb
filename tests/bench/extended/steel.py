"""Hand-made ground truth: steel pixels with a depth each, all of them interior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rebar_depth_bench.extended.steel import SceneBars, SteelTruth


def steel_truth(
    depth_m: np.ndarray, bar_id: np.ndarray | None = None, fx: float = 700.0, diameter_m: np.ndarray | None = None
) -> SteelTruth:
    """Return the truth of a view one pixel high; ``depth_m`` and ``bar_id`` have one value per pixel.

    ``diameter_m`` are the diameters of bars by id, metres.
    """
    bars = SceneBars.of(())
    count = len(depth_m)
    K = np.array([[fx, 0, (count - 1) / 2], [0, fx, 0], [0, 0, 1.0]])
    return SteelTruth(
        view_id="lattice/0000",
        height=1,
        width=count,
        K=K,
        cam_from_world=np.eye(4),
        index=np.arange(count, dtype=np.uint32),
        depth_m=np.asarray(depth_m, dtype=np.float32),
        bar_id=np.ones(count, dtype=np.uint16) if bar_id is None else bar_id.astype(np.uint16),
        interior=np.ones(count, dtype=bool),
        single_bar=np.ones(count, dtype=bool),
        rays=np.column_stack([(np.arange(count) - K[0, 2]) / fx, np.zeros(count)]),
        run=np.zeros(count, dtype=np.int16),
        front_m=np.full(count, np.nan, dtype=np.float32),
        behind_m=np.full(count, np.nan, dtype=np.float32),
        bars=bars if diameter_m is None else replace(bars, diameter_m=diameter_m),
    )
