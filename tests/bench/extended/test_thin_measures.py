"""Tests common to the boundary, point-cloud, depth-layer and full-mask measures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import ndarray

from rebar_depth_bench import load
from rebar_depth_bench.extended import boundary, depth_layers, point_cloud, regions
from rebar_depth_bench.extended.measures import STATISTICS, Measure, Samples
from rebar_depth_bench.extended.steel import SteelTruth
from tests.bench.extended.thin_scenes import random_prediction, random_truth, steel_truth, with_holes

SamplerAndMeasures = tuple[Callable[[ndarray, SteelTruth], Samples], Sequence[Measure]]

MEASURE_FAMILIES: dict[str, SamplerAndMeasures] = {
    "boundary": (boundary.boundary_samples, boundary.MEASURES),
    "clouds": (point_cloud.cloud_samples, point_cloud.MEASURES),
    "layers": (depth_layers.layer_samples, depth_layers.MEASURES),
    "full_mask": (regions.region_samples, regions.FULL_MASK_MEASURES),
}
every_family = pytest.mark.parametrize(("sampled", "measures"), MEASURE_FAMILIES.values(), ids=MEASURE_FAMILIES)


@every_family
def test_every_sample_has_its_measure(sampled: Callable[..., Samples], measures: Sequence[Measure]) -> None:
    truth = random_truth(np.random.default_rng(0))
    samples = sampled(truth.depth_m.astype(np.float64), truth)
    names = {measure.sample for measure in measures}
    assert names <= set(samples)
    for values in map(samples.get, names):
        assert values is not None
        assert values.dtype == np.float64
        assert values.shape == (1,)


def test_names_are_unique_and_definitions_present() -> None:
    measures = [measure for _, family in MEASURE_FAMILIES.values() for measure in family]
    assert max(Counter(measure.name for measure in measures).values()) == 1
    assert max(Counter(measure.title for measure in measures).values()) == 1
    assert not {"abs_rel", "rmse_cm", "mae_cm", "delta1", "coverage"} & {measure.name for measure in measures}
    assert all(measure.definition and not measure.definition.endswith(".") for measure in measures)


@every_family
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.001, 1.0))
def test_holes_never_improve_a_measure(
    sampled: Callable[..., Samples], measures: Sequence[Measure], seed: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    before, after = sampled(p_m, truth), sampled(with_holes(rng, p_m, share), truth)
    for measure in measures:
        if measure.better and measure.sample in before:  # a random truth may have no contour
            value_before, value_after = (
                STATISTICS[measure.statistic](samples[measure.sample]) for samples in (before, after)
            )
            assert value_after <= value_before if measure.better == "higher" else value_after >= value_before, (
                measure.name
            )


@every_family
def test_no_steel_gives_no_sample(sampled: Callable[..., Samples], measures: Sequence[Measure]) -> None:
    truth = steel_truth(np.ones((3, 3)), np.zeros((3, 3), np.uint16))
    assert not any(len(values) for values in sampled(np.empty(0), truth).values())


@every_family
def test_inputs_are_not_modified(sampled: Callable[..., Samples], measures: Sequence[Measure]) -> None:
    del measures
    rng = np.random.default_rng(6)
    truth = random_truth(rng)
    p_m = random_prediction(rng, truth)
    for array in (p_m, truth.index, truth.depth_m, truth.bar_id, truth.interior, truth.rays, truth.front_m):
        array.flags.writeable = False  # writing raises
    assert sampled(p_m, truth)


def test_rendered_truth_is_perfect(tiny_root: Path) -> None:
    row = next(iter(load(tiny_root, "lattice", streaming=True)))
    bars, depth_m = row["left_bars"], row["left_depth"]
    index = np.flatnonzero(bars).astype(np.uint32)
    layers_m = np.full((2, bars.size), np.nan, np.float32)
    layers_m[:, index] = depth_layers.other_layers(depth_m, bars, index, np.full(len(index), 0.007, np.float32))
    front_m, behind_m = layers_m.reshape(2, *bars.shape)
    assert np.isfinite(front_m).any()
    assert np.isfinite(behind_m).any()
    truth = steel_truth(depth_m, bars, front_m, behind_m)
    for sampled, measures in MEASURE_FAMILIES.values():
        samples = sampled(truth.depth_m.astype(np.float64), truth)
        for measure in measures:
            if measure.better:
                assert samples[measure.sample].tolist() == [1.0 if measure.better == "higher" else 0.0], (
                    measure.name
                )
