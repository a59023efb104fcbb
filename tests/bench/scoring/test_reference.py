"""Reference errors: against independent formulas, and in results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy import ndarray

from rebar_depth_bench import score
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.reference import (
    NO_REFERENCE,
    Reference,
    mean_reference,
    reference_of_numbers,
    view_reference,
)


def independent_reference(depth_m: ndarray, is_scored: ndarray) -> list[float]:
    """Return the four errors of a view from whole images in float64."""
    image = depth_m.astype(np.float64)
    z = image[is_scored]
    errors = [np.abs(np.median(z) - z)]
    values = [float(np.mean(errors[0] / z)), float(100 * np.sqrt(np.mean(errors[0] ** 2)))]
    shifted = []
    for axis, step in ((1, 1), (1, -1), (0, 1), (0, -1)):
        neighbour = np.roll(image, step, axis)[is_scored]
        known = neighbour > 0
        if known.any():
            error = np.abs(neighbour[known] - z[known])
            shifted.append([np.mean(error / z[known]), 100 * np.sqrt(np.mean(error**2))])
    return [*values, *np.mean(shifted, axis=0).tolist()]


def test_tables_have_the_reference_errors_of_the_dataset(
    tiny_truth: dict[str, ndarray],
    tiny_masks: dict[str, ndarray],
    tiny_root: Path,
    archive_of: Callable[..., Path],
) -> None:
    result = score(archive_of(tiny_truth), tiny_root)
    expected = []
    for view_id, depth_m in tiny_truth.items():
        is_scored = np.zeros(depth_m.size, bool)
        is_scored[scored_pixels(tiny_masks[view_id], depth_m)] = True
        expected.append(independent_reference(depth_m, is_scored.reshape(depth_m.shape)))
    found = result.to_dict()["tables"]["lattice"]["reference"]
    assert list(found) == ["constant", "one_pixel"]
    numbers = [value for errors in found.values() for value in errors.values()]
    assert numbers == pytest.approx(np.mean(expected, axis=0).tolist(), rel=1e-11)
    again = score(archive_of(tiny_truth), tiny_root)  # From the cache.
    assert again.to_json() == result.to_json()


def test_neighbours_without_depth_are_skipped() -> None:
    depth_m = np.full((3, 3), 2.0, np.float32)
    depth_m[1, 0], depth_m[1, 2], depth_m[0, 1] = 1.0, 0.0, 0.0
    reference = view_reference(depth_m, np.array([4], np.uint32), 2.0)
    assert reference == Reference(0.0, 0.0, 0.25, 50.0)
    alone = np.zeros((3, 3), np.float32)
    alone[1, 1] = 2.0
    undefined = view_reference(alone, np.array([4], np.uint32), 2.0)
    assert undefined == Reference(0.0, 0.0, None, None)
    assert mean_reference([reference, undefined]) == reference
    assert reference_of_numbers(undefined.to_numbers()) == undefined


def test_no_views_have_no_reference() -> None:
    assert mean_reference([]) == NO_REFERENCE
    assert NO_REFERENCE.to_dict()["constant"] == {"abs_rel": None, "rmse_cm": None}
