"""Tests of process capability (tolerance over p95), from samples to table, JSON, CSV and terminal."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.inspection import (
    CAPABILITY_MEASURES,
    PROFILES,
    TOLERANCES,
    capability,
)
from rebar_depth_bench.extended.measures import NATIVE, ONCE, SCALED, Measure
from rebar_depth_bench.extended.registry import measures_by_alignment
from rebar_depth_bench.extended.result import (
    ExtendedResult,
    ExtendedTable,
    MeasureEstimate,
    ViewSamples,
    convert_estimate,
    tabulate_extended,
    view_numbers,
)
from rebar_depth_bench.reporting.extended_tables import extended_csv, print_extended
from rebar_depth_bench.scoring.bootstrap import resample
from tests.bench.reporting.results import result, scored_view

SPACING, STIRRUPS = PROFILES[0].tolerances[:2]
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


def measure_of(tolerance_index: int = 0) -> Measure:
    return CAPABILITY_MEASURES[tolerance_index]


def test_each_tolerance_has_one_capability_per_alignment() -> None:
    names = [tolerance.capability_name for _, tolerance in TOLERANCES]
    assert [measure.name for measure in CAPABILITY_MEASURES] == names
    listed = measures_by_alignment()
    for alignment in (NATIVE, SCALED):
        assert set(names) < {measure.name for measure in listed[alignment]}
    assert not set(names) & {measure.name for measure in listed[ONCE]}
    for measure, (_, tolerance) in zip(CAPABILITY_MEASURES, TOLERANCES, strict=True):
        p95 = BY_NAME[f"{tolerance.kind}_p95_mm"]
        assert (measure.sample, measure.statistic) == (p95.sample, p95.statistic)
        assert f"{tolerance.limit_mm:g} mm / p95" in measure.title
        assert measure.better == "higher"


def test_capability_is_tolerance_over_p95_of_all_samples() -> None:
    filled = spacings()
    numbers = table_of(filled).numbers[NATIVE]
    by_hand_mm = float(np.percentile(np.concatenate([samples["spacing_judged_mm"] for samples in filled]), 95))
    capability = numbers["capability_gb50204_spacing"]
    assert capability.value == pytest.approx(10 / by_hand_mm, rel=0.02)
    assert capability.samples == VIEWS * 40
    assert numbers["capability_gb50204_stirrup_spacing"].value == pytest.approx(2 * (capability.value or 0))


def test_capability_interval_inverts_p95_interval() -> None:
    numbers = table_of(spacings()).numbers[NATIVE]
    p95, capability = numbers["spacing_p95_mm"], numbers["capability_gb50204_spacing"]
    assert p95.interval is not None
    assert p95.value is not None
    assert capability.interval == pytest.approx((10 / p95.interval[1], 10 / p95.interval[0]))
    assert capability.interval is not None
    assert capability.value is not None
    assert capability.interval[0] < capability.value < capability.interval[1]


def test_capability_without_samples_or_with_misses_is_none() -> None:
    empty = table_of([{} for _ in range(VIEWS)]).numbers[NATIVE]["capability_gb50204_layers"]
    assert empty == MeasureEstimate(None, None, 0)
    missed = np.r_[np.full(30, 1.0), np.full(10, MISS_MM)]
    table = table_of([{"layer_judged_mm": missed} for _ in range(VIEWS)])
    assert table.numbers[NATIVE]["layer_p95_mm"].value == MISS_MM
    assert table.numbers[NATIVE]["capability_gb50204_layers"] == MeasureEstimate(None, None, 40 * VIEWS)


def test_missed_upper_p95_bound_gives_zero_lower_bound() -> None:
    p95 = MeasureEstimate(50.0, (8.0, MISS_MM), 40)
    assert convert_estimate(measure_of(), p95) == MeasureEstimate(0.2, (0.0, 1.25), 40)


def test_zero_p95_gives_infinite_capability() -> None:
    assert convert_estimate(measure_of(), MeasureEstimate(0.0, (0.0, 2.0), 40)) == MeasureEstimate(
        math.inf, None, 40
    )


def test_p95_measure_is_not_converted() -> None:
    p95 = MeasureEstimate(50.0, (8.0, MISS_MM), 40)
    assert convert_estimate(BY_NAME["spacing_p95_mm"], p95) == p95


@given(st.floats(1e-3, 99.0), st.floats(1e-3, 99.0), st.floats(0.1, 1000.0))
def test_capability_decreases_with_error(one_mm: float, other_mm: float, limit_mm: float) -> None:
    small, large = sorted((one_mm, other_mm))
    better, worse = capability(limit_mm, small), capability(limit_mm, large)
    assert better is not None
    assert worse is not None
    assert better >= worse > 0
    assert worse * large == pytest.approx(limit_mm)


def test_missing_bars_never_raise_capability() -> None:
    filled = spacings()
    whole = table_of(filled).numbers[NATIVE]["capability_gb50204_spacing"].value
    rng = np.random.default_rng(5)
    values = []
    for share in (0.01, 0.03, 0.2):
        holes = [
            {name: np.where(rng.random(len(mm)) < share, MISS_MM, mm) for name, mm in samples.items()}
            for samples in filled
        ]
        values.append(table_of(holes).numbers[NATIVE]["capability_gb50204_spacing"].value)
    assert whole is not None
    assert all(value is None or value <= whole for value in values)
    assert values[-1] is None


def capability_of(one: ViewSamples) -> float | None:
    return view_numbers(one, measures_by_alignment())[NATIVE][SPACING.capability_name]


def test_single_view_has_capability() -> None:
    measured = view({"spacing_judged_mm": np.full(10, 4.0)})
    assert capability_of(measured) == 2.5
    missed = view({"spacing_judged_mm": np.full(10, MISS_MM)})
    assert capability_of(missed) is None
    assert capability_of(view({})) is None


def extended_of(filled: list[dict[str, np.ndarray]]) -> ExtendedResult:
    measures = measures_by_alignment()
    views = {f"lattice/{100 * index:04d}": view_numbers(view(one), measures) for index, one in enumerate(filled)}
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


def terminal_text(extended: ExtendedResult, width: int = 100) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    print_extended(extended, console)
    return console.export_text()


def test_terminal_prints_defined_and_uncapability() -> None:
    text = terminal_text(extended_of(spacings()))
    numbers = table_of(spacings()).numbers[NATIVE]
    line = next(line for line in text.splitlines() if "bar spacing: 10 mm / p95" in line)
    value = numbers["capability_gb50204_spacing"].value
    assert f"{value:.4g}" in line
    assert "n/a" not in text
    missed = terminal_text(extended_of([{"spacing_judged_mm": np.full(9, MISS_MM)} for _ in range(VIEWS)]))
    line = next(line for line in missed.splitlines() if "bar spacing: 10 mm / p95" in line)
    assert line.count("n/a") == 2
    assert "n/a: 5 % or more were not found, so the capability is undefined." in missed


@pytest.mark.parametrize("width", [80, 100])
def test_terminal_truncates_names_not_numbers(width: int) -> None:
    rng = np.random.default_rng(8)
    samples = sorted({measure.sample for measure in BY_NAME.values()})
    filled = [
        dict(zip(samples, rng.normal(-0.123456, 0.01, (len(samples), 3)), strict=True)) for _ in range(VIEWS)
    ]
    for view_samples in filled:
        view_samples |= {name: np.abs(values) for name, values in view_samples.items() if "judged" in name}
    text = terminal_text(extended_of(filled), width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert f"{STIRRUPS.limit_mm:g} mm / p95" in text
