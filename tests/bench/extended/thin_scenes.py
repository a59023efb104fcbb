"""Small synthetic views for the tests of measures over pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy import ndarray

from rebar_depth_bench.extended.published import depth_steps
from rebar_depth_bench.extended.steel import SceneBars, SteelTruth
from rebar_depth_bench.geometry.cameras import ideal_K, pixel_rays
from rebar_depth_bench.scoring.protocol import interior, single_bar_pixels
from tests.bench.extended.cage_scenes import NO_COVERS, NO_CROSSINGS

HOLES = (np.nan, np.inf, -np.inf, 0.0, -1.0)
"""Values of an archive that are no prediction."""


def steel_truth(depth_m: ndarray, bars: ndarray) -> SteelTruth:
    """Return the truth of a view from whole images (h x w)."""
    height, width = depth_m.shape
    padded = np.pad(bars > 0, 1)
    near = np.any([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
    index = np.flatnonzero(near & (depth_m > 0)).astype(np.uint32)
    K = ideal_K(width, height)
    inside = interior(bars > 0) & (depth_m > 0)
    single_bar, steps = np.zeros_like(inside), depth_steps(depth_m.astype(np.float32))
    single_bar[inside] = single_bar_pixels(bars, np.flatnonzero(inside).astype(np.uint32))
    return SteelTruth(
        view_id="synthetic/0000",
        height=height,
        width=width,
        K=K,
        cam_from_world=np.eye(4),
        index=index,
        depth_m=depth_m.ravel()[index].astype(np.float32),
        bar_id=bars.ravel()[index].astype(np.uint16),
        interior=inside.ravel()[index],
        single_bar=single_bar.ravel()[index],
        rays=pixel_rays(K, width, height).reshape(-1, 3)[index, :2],
        run=np.full(len(index), -1, np.int16),
        judged=NO_CROSSINGS,
        covers=NO_COVERS,
        parallax_px_m=84.0,
        seen_by_right=inside.ravel()[index] & (index % 3 > 0),
        has_depth=steps["has_depth"],
        near_step=steps["near_step"],
        step_depth_m=steps["step_depth_m"],
    )


def pixel_truth(
    depth_m: Sequence[float] | ndarray,
    bar_id: ndarray | None = None,
    *,
    rays: Sequence[tuple[float, float]] | None = None,
) -> SteelTruth:
    """Return the truth of a view one pixel high, all of it interior. The focal length is 700 px."""
    count = len(depth_m)
    truth = steel_truth(np.array([depth_m]), np.ones((1, count), np.uint16))
    K = np.array([[700.0, 0, (count - 1) / 2], [0, 700.0, 0], [0, 0, 1.0]])
    return replace(
        truth,
        K=K,
        bar_id=truth.bar_id if bar_id is None else bar_id.astype(np.uint16),
        interior=np.ones(count, bool),
        single_bar=np.ones(count, bool),
        rays=np.array(rays or [((u - K[0, 2]) / 700.0, 0.0) for u in range(count)]),
        run=np.zeros(count, np.int16),
        bars=SceneBars.of(()),
    )


def random_images(rng: np.random.Generator, height: int = 24, width: int = 31) -> tuple[ndarray, ndarray]:
    """Return depth (float32, metres) and bar ids (uint16) of bars before a board that may not cover the image."""
    depth_m = np.full((height, width), 0.9) + rng.uniform(0, 0.01, (height, width))
    bars = np.zeros((height, width), np.uint16)
    for bar in range(1, 6):
        z_m, start, thickness = rng.uniform(0.2, 0.8), int(rng.integers(0, 20)), int(rng.integers(3, 7))
        part = (slice(start, start + thickness), slice(None))[:: int(rng.choice([1, -1]))]
        slope = rng.uniform(-0.003, 0.003) * np.add.outer(np.arange(height), np.arange(width))
        nearer = np.zeros_like(bars, bool)
        nearer[part] = (z_m + slope < depth_m)[part]
        depth_m[nearer], bars[nearer] = (z_m + slope)[nearer], bar
    empty = (bars == 0) & (np.arange(width) < rng.integers(0, width))
    depth_m[empty] = 0.0
    return depth_m.astype(np.float32), bars


def random_truth(rng: np.random.Generator) -> SteelTruth:
    """Return the truth of a random view."""
    return steel_truth(*random_images(rng))


def random_prediction(rng: np.random.Generator, truth: SteelTruth, holes: float = 0.1) -> ndarray:
    """Return the true depth times noise of varying size and a random factor, with a share of holes."""
    spread = 10 ** rng.uniform(-4, -0.5, len(truth.index))
    p_m = truth.depth_m * np.exp(rng.normal(0, spread)) * rng.choice([1.0, 1.01, 1.3])
    return with_holes(rng, p_m, holes)


def with_holes(rng: np.random.Generator, p_m: ndarray, share: float) -> ndarray:
    """Return a prediction in which about ``share`` of the pixels has a random value of ``HOLES``."""
    return np.where(rng.random(len(p_m)) < share, rng.choice(HOLES, len(p_m)), p_m)
