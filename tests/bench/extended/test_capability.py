"""Estimates over views, tolerances and process capability, from samples to JSON, CSV and terminal."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from rebar_depth_bench.extended.estimates import (
    ExtendedResult,
    ExtendedTable,
    MeasureEstimate,
    ViewSamples,
    convert_estimate,
    estimate,
    tabulate_extended,
    view_measures,
)
from rebar_depth_bench.extended.families import measures_by_alignment
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import (
    CAPABILITY_MEASURES,
    PROFILES,
    TOLERANCES,
)
from rebar_depth_bench.extended.measures import NATIVE, ONCE, SCALED, STATISTICS, Measure, Samples, Statistic
from rebar_depth_bench.reporting.extended_tables import extended_csv
from rebar_depth_bench.scoring.bootstrap import resample
from tests.bench.reporting.results import result, scored_view

RNG = np.random.default_rng(7)
BY_VIEW = [{"s": RNG.normal(3.0, 1.0, size)} for size in RNG.integers(0, 30, 300)]
INDICES = range(0, 300 * 12, 12)  # so far apart that each view is a block


def measure(statistic: Statistic) -> Measure:
    return Measure("m", "M", "mm", "lower", "for this test", "s", statistic)


@pytest.mark.parametrize(
    ("statistic", "truth"), [("mean", 3.0), ("median", 3.0), ("std", 1.0), ("p95", 3 + 1.6449)]
)
def test_estimate_is_pooled_with_an_interval_as_wide_as_the_spread_over_new_samples(
    statistic: Statistic, truth: float
) -> None:
    pooled = np.concatenate([samples["s"] for samples in BY_VIEW])
    by_hand: dict[str, Callable[[np.ndarray], float]] = {
        "mean": np.mean,
        "median": np.median,
        "std": np.std,
        "p95": lambda x: float(np.percentile(x, 95)),
    }
    found = estimate(measure(statistic), BY_VIEW, resample(INDICES))
    assert found.samples == len(pooled)
    assert found.value == pytest.approx(by_hand[statistic](pooled), rel=2e-3)
    assert found.interval is not None
    assert found.value is not None
    assert found.interval[0] < found.value < found.interval[1]
    rng = np.random.default_rng(1)
    values = [STATISTICS[statistic](rng.normal(3, 1, found.samples)) for _ in range(300)]
    low, high = np.percentile(values, [2.5, 97.5])
    assert found.interval[1] - found.interval[0] == pytest.approx(high - low, rel=0.25)
    assert abs(np.mean(found.interval) - truth) < high - low


def test_views_and_tables_without_samples() -> None:
    no_samples: list[Samples] = [{}] * 8
    assert estimate(measure("p95"), no_samples, resample(range(8))) == estimate(measure("mean"), [], resample([]))
    one_view = [{"s": np.ones(3)}, *no_samples[1:]]
    estimated = estimate(measure("mean"), one_view, resample(range(8)))
    assert (estimated.value, estimated.interval, estimated.samples) == (1.0, None, 3)


def test_infinite_samples_have_no_interval() -> None:
    samples = [{"s": np.array([1.0, math.inf])}] * 10
    assert estimate(measure("p95"), samples, resample(range(10))).value == math.inf
    assert estimate(measure("p95"), samples, resample(range(10))).interval is None


SPACING = PROFILES[0].tolerances[0]
BY_NAME = {measure.name: measure for measures in measures_by_alignment().values() for measure in measures}
VIEWS = 8


def view(filled: Mapping[str, np.ndarray]) -> ViewSamples:
    """Return a view whose only samples are those of ``filled``, the same for every alignment."""
    return dict.fromkeys((ONCE, NATIVE, SCALED), filled)


def table_of(filled: list[dict[str, np.ndarray]]) -> ExtendedTable:
    views = [view(samples) for samples in filled]
    return tabulate_extended(views, resample(range(0, 100 * len(views), 100)), measures_by_alignment())


def spacings(scale: float = 1.0) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(3)
    return [{"spacing_judged_mm": scale * np.abs(rng.normal(0, 4, 40))} for _ in range(VIEWS)]


def test_tolerances_have_capabilities_of_p95_measures_that_count_misses() -> None:
    assert [one for _, one in TOLERANCES] == [one for profile in PROFILES for one in profile.tolerances]
    assert len({tolerance.key for _, tolerance in TOLERANCES}) == len(TOLERANCES)
    names = [tolerance.capability_name for _, tolerance in TOLERANCES]
    assert [measure.name for measure in CAPABILITY_MEASURES] == names
    listed = {alignment: {one.name for one in measures} for alignment, measures in measures_by_alignment().items()}
    assert set(names) < listed[NATIVE] & listed[SCALED]
    assert not set(names) & listed[ONCE]
    for measure, (_, tolerance) in zip(CAPABILITY_MEASURES, TOLERANCES, strict=True):
        p95 = BY_NAME[f"{tolerance.kind}_p95_mm"]
        assert (p95.sample, p95.statistic) == (f"{tolerance.kind}_judged_mm", "p95")
        assert (measure.sample, measure.statistic, measure.better) == (p95.sample, "p95", "higher")


def test_capability_is_tolerance_over_p95_of_all_samples() -> None:
    filled = spacings()
    numbers = table_of(filled).numbers[NATIVE]
    by_hand_mm = float(np.percentile(np.concatenate([samples["spacing_judged_mm"] for samples in filled]), 95))
    p95, found = numbers["spacing_p95_mm"], numbers["capability_gb50204_spacing"]
    assert found.value == pytest.approx(10 / by_hand_mm, rel=0.02)
    assert found.samples == VIEWS * 40
    assert numbers["capability_gb50204_stirrup_spacing"].value == pytest.approx(2 * (found.value or 0))
    assert p95.interval is not None
    assert found.interval == pytest.approx((10 / p95.interval[1], 10 / p95.interval[0]))


def test_capability_without_samples_or_with_misses_is_none() -> None:
    empty = table_of([{} for _ in range(VIEWS)]).numbers[NATIVE]["capability_gb50204_layers"]
    assert empty == MeasureEstimate(None, None, 0)
    missed = np.r_[np.full(30, 1.0), np.full(10, MISS_MM)]
    table = table_of([{"layer_judged_mm": missed} for _ in range(VIEWS)])
    assert table.numbers[NATIVE]["layer_p95_mm"].value == MISS_MM
    assert table.numbers[NATIVE]["capability_gb50204_layers"] == MeasureEstimate(None, None, 40 * VIEWS)


@pytest.mark.parametrize(
    ("p95", "expected"),
    [
        (MeasureEstimate(50.0, (8.0, MISS_MM), 40), MeasureEstimate(0.2, (0.0, 1.25), 40)),
        (MeasureEstimate(0.0, (0.0, 2.0), 40), MeasureEstimate(math.inf, None, 40)),
    ],
    ids=["upper end missed", "no error"],
)
def test_estimates_of_p95_are_converted_for_capabilities_only(
    p95: MeasureEstimate, expected: MeasureEstimate
) -> None:
    assert convert_estimate(CAPABILITY_MEASURES[0], p95) == expected
    assert convert_estimate(BY_NAME["spacing_p95_mm"], p95) == p95


def test_single_view_has_capability() -> None:
    for filled, expected in (
        ({"spacing_judged_mm": np.full(10, 4.0)}, 2.5),
        ({"spacing_judged_mm": np.full(10, MISS_MM)}, None),
        ({}, None),
    ):
        numbers = view_measures(view(filled), measures_by_alignment())[NATIVE]
        assert numbers[SPACING.capability_name] == expected


def extended_of(filled: list[dict[str, np.ndarray]]) -> ExtendedResult:
    measures = measures_by_alignment()
    views = {f"lattice/{100 * index:04d}": view_measures(view(one), measures) for index, one in enumerate(filled)}
    return ExtendedResult(measures, {"lattice": table_of(filled)}, views)


def test_json_and_csv_contain_capability() -> None:
    extended = extended_of(spacings())
    tables = extended.to_dict()["tables"]["lattice"]
    estimate = tables["native"]["capability_gb50204_spacing"]
    assert estimate["value"] == pytest.approx(10 / tables["native"]["spacing_p95_mm"]["value"])
    assert len(estimate["ci95"]) == 2
    view_numbers = extended.to_dict()["views"][0]["scaled"]
    assert view_numbers["capability_gb50204_stirrup_spacing"] == pytest.approx(20 / view_numbers["spacing_p95_mm"])
    whole = dataclasses.replace(result(scored_view("lattice/0000")), extended=extended)
    rows = {(row["alignment"], row["measure"]): row for row in csv.DictReader(io.StringIO(extended_csv(whole)))}
    row = rows["native", "capability_gb50204_spacing"]
    assert float(row["value"]) == estimate["value"]
    assert [float(row["low"]), float(row["high"])] == estimate["ci95"]
    assert rows["native", "capability_gb50204_layers"]["value"] == ""
