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
    UNDEFINED,
    Errors,
    Reference,
    mean_reference,
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
    assert list(found) == ["constant", "one_pixel", "scaled_constant"]
    assert found["scaled_constant"] == found["constant"], "of complete predictions"
    numbers = [value for errors in (found["constant"], found["one_pixel"]) for value in errors.values()]
    assert numbers == pytest.approx(np.mean(expected, axis=0).tolist(), rel=1e-11)
    again = score(archive_of(tiny_truth), tiny_root)  # From the cache.
    assert again.to_json() == result.to_json()


def test_scaled_constant_is_on_the_predicted_pixels(
    tiny_truth: dict[str, ndarray],
    tiny_masks: dict[str, ndarray],
    tiny_root: Path,
    archive_of: Callable[..., Path],
) -> None:
    """Predict the nearer half of each view, and nothing in the first view."""
    predictions: dict[str, ndarray] = {}
    expected = []
    for view_id, depth_m in tiny_truth.items():
        pixels = scored_pixels(tiny_masks[view_id], depth_m)
        near = depth_m <= np.median(depth_m.ravel()[pixels])
        predictions[view_id] = np.where(near & bool(predictions), 1.7 * depth_m, np.nan)
        z = depth_m.ravel()[pixels][near.ravel()[pixels]].astype(np.float64)
        error = np.abs(np.median(z) - z)
        expected.append((np.mean(error / z), 100 * np.sqrt(np.mean(error**2))))
    table = score(archive_of(predictions), tiny_root).to_dict()["tables"]["lattice"]
    found = table["reference"]["scaled_constant"]
    assert list(found.values()) == pytest.approx(np.mean(expected[1:], axis=0).tolist(), rel=1e-11)
    assert found["abs_rel"] < 0.8 * table["reference"]["constant"]["abs_rel"]


def test_nothing_predicted_has_no_scaled_constant(
    tiny_truth: dict[str, ndarray], tiny_root: Path, archive_of: Callable[..., Path]
) -> None:
    nothing = {view_id: np.zeros_like(depth_m) for view_id, depth_m in tiny_truth.items()}
    reference = score(archive_of(nothing), tiny_root).to_dict()["tables"]["lattice"]["reference"]
    assert reference["scaled_constant"] == {"abs_rel": None, "rmse_cm": None}
    assert reference["constant"]["abs_rel"] > 0


def test_neighbours_without_depth_are_skipped() -> None:
    depth_m = np.full((3, 3), 2.0, np.float32)
    depth_m[1, 0], depth_m[1, 2], depth_m[0, 1] = 1.0, 0.0, 0.0
    reference = view_reference(depth_m, np.array([4], np.uint32), 2.0)
    assert reference == (0.0, 0.0, 0.25, 50.0)
    alone = np.zeros((3, 3), np.float32)
    alone[1, 1] = 2.0
    undefined = view_reference(alone, np.array([4], np.uint32), 2.0)
    assert undefined == (0.0, 0.0, UNDEFINED, UNDEFINED)
    assert mean_reference([undefined]) == Reference(Errors(0.0, 0.0), Errors())
    assert mean_reference([reference, undefined]) == Reference(Errors(0.0, 0.0), Errors(0.25, 50.0))


def test_no_views_have_no_reference() -> None:
    assert mean_reference([]) == NO_REFERENCE
    assert NO_REFERENCE.to_dict()["constant"] == {"abs_rel": None, "rmse_cm": None}
