"""Tests of the selection of scored pixels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rebar_depth_bench.scoring.protocol import interior, scored_pixels

MASKS = hnp.arrays(bool, st.tuples(st.integers(1, 12), st.integers(1, 12)))


def eroded_by_definition(mask: np.ndarray) -> np.ndarray:
    height, width = mask.shape
    eroded = np.zeros_like(mask)
    for v in range(height):
        for u in range(width):
            neighbourhood = [
                0 <= v + dv < height and 0 <= u + du < width and mask[v + dv, u + du]
                for dv in (-1, 0, 1)
                for du in (-1, 0, 1)
            ]
            eroded[v, u] = all(neighbourhood)
    return eroded


@given(MASKS)
def test_interior_is_erosion_by_3_x_3(mask: np.ndarray) -> None:
    assert np.array_equal(interior(mask), eroded_by_definition(mask))


def test_image_border_is_never_scored() -> None:
    eroded = interior(np.ones((5, 7), bool))
    assert eroded.sum() == 3 * 5
    assert not eroded[0].any()
    assert not eroded[:, -1].any()


@pytest.mark.slow
@given(MASKS)
def test_scored_pixels_require_depth(mask: np.ndarray) -> None:
    depth_m = np.where(np.arange(mask.size).reshape(mask.shape) % 3, 1.0, 0.0).astype(np.float32)
    expected = np.flatnonzero(eroded_by_definition(mask) & (depth_m > 0))
    pixels = scored_pixels(mask, depth_m)
    assert pixels.dtype == np.uint32
    assert np.array_equal(pixels, expected)
