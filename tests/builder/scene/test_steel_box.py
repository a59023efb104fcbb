"""Boxes around steel: smallest box with a margin, cut off at the image."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy import ndarray

from dataset_builder.scene.raycast import steel_box


@given(arrays(bool, array_shapes(min_dims=2, max_dims=2, max_side=12)), st.integers(0, 4))
def test_box_is_the_smallest_with_the_margin(mask: ndarray, margin_px: int) -> None:
    box = steel_box(mask, margin_px)
    near = np.array(
        [
            [
                mask.any() and abs(y - a).min() <= margin_px and abs(x - b).min() <= margin_px
                for x in range(mask.shape[1])
            ]
            for a, b in [np.nonzero(mask)]
            for y in range(mask.shape[0])
        ]
    ).reshape(mask.shape)
    if box is None:
        assert not mask.any()
        return
    inside = np.zeros_like(mask)
    inside[box.slices] = True
    assert inside[near].all()
    assert inside[mask].all()
    # Each side of the box has a pixel within the margin of steel.
    rows, columns = np.nonzero(inside)
    assert (box.top, box.bottom, box.left, box.right) == (
        rows.min(),
        rows.max() + 1,
        columns.min(),
        columns.max() + 1,
    )
    steel_rows, steel_columns = np.nonzero(mask)
    assert box.top == max(steel_rows.min() - margin_px, 0)
    assert box.right == min(steel_columns.max() + 1 + margin_px, mask.shape[1])
