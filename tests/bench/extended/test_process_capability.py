"""Capabilities: tolerance over p95, from samples to the table, JSON, CSV and the terminal."""

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

from rebar_depth_bench.extended.evaluate import NATIVE, ONCE, SCALED, measures_by_alignment
from rebar_depth_bench.extended.inspection.measures import MEASURES, MISS_MM, capability_name, told_capability
from rebar_depth_bench.extended.inspection.tolerances import CAPABILITIES, GB_50204
from rebar_depth_bench.extended.measures import Measure
from rebar_depth_bench.extended.result import (
    Estimate,
    ExtendedResult,
    ExtendedTable,
    ExtendedView,
    converted,
    tabulate_extended,
    view_numbers,
    view_value,
)
from rebar_depth_bench.reporting.extended_tables import extended_csv, print_extended
from tests.bench.reporting.results import result, scored

SPACING, STIRRUPS = GB_50204.tolerances[:2]
BY_NAME = {measure.name: measure for measures in measures_by_alignment().values() for measure in measures}
VIEWS = 8


def view(index: int, filled: Mapping[str, np.ndarray]) -> ExtendedView:
    """Return a view with no samples but those of ``filled``, native and scaled alike."""
    samples = {
        alignment: {one.sample: np.asarray(filled.get(one.sample, np.empty(0)), np.float64) for one in measures}
        for alignment, measures in measures_by_alignment().items()
    }
    return ExtendedView(f"lattice/{index:04d}", samples)


def table_of(filled: list[dict[str, np.ndarray]]) -> ExtendedTable:
    views = [view(100 * index, one) for index, one in enumerate(filled)]
    return tabulate_extended(views, [100 * index for index in range(len(views))], measures_by_alignment())


def spacings(scale: float = 1.0) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(3)
    return [{"spacing_judged_mm": scale * np.abs(rng.normal(0, 4, 40))} for _ in range(VIEWS)]


def measure_of(tolerance_index: int = 0) -> Measure:
    return MEASURES[tolerance_index]


def test_there_is_one_capability_for_each_tolerance_and_each_alignment() -> None:
    names = [capability_name(tolerance) for tolerance, _ in CAPABILITIES]
    assert [measure.name for measure in MEASURES] == names
    listed = measures_by_alignment()
    for alignment in (NATIVE, SCALED):
        assert set(names) < {measure.name for measure in listed[alignment]}
    assert not set(names) & {measure.name for measure in listed[ONCE]}
    for measure, (tolerance, p95) in zip(MEASURES, CAPABILITIES, strict=True):
        assert (measure.sample, measure.statistic) == (BY_NAME[p95].sample, BY_NAME[p95].statistic)
        assert f"{tolerance.limit_mm:g} mm / p95" in measure.title
        assert measure.better == "higher"


def test_the_table_divides_the_tolerance_by_the_p95_of_all_that_was_judged() -> None:
    filled = spacings()
    numbers = table_of(filled).numbers[NATIVE]
    by_hand_mm = float(np.percentile(np.concatenate([one["spacing_judged_mm"] for one in filled]), 95))
    found = numbers["capability_gb50204_spacing"]
    assert found.value == pytest.approx(10 / by_hand_mm, rel=0.02)
    assert found.samples == VIEWS * 40
    assert numbers["capability_gb50204_stirrup_spacing"].value == pytest.approx(2 * (found.value or 0))


def test_the_interval_is_that_of_the_p95_turned_round() -> None:
    numbers = table_of(spacings()).numbers[NATIVE]
    p95, found = numbers["spacing_p95_mm"], numbers["capability_gb50204_spacing"]
    assert p95.interval is not None
    assert p95.value is not None
    assert found.interval == pytest.approx((10 / p95.interval[1], 10 / p95.interval[0]))
    assert found.interval is not None
    assert found.value is not None
    assert found.interval[0] < found.value < found.interval[1]


def test_nothing_judged_and_nothing_told() -> None:
    empty = table_of([{} for _ in range(VIEWS)]).numbers[NATIVE]["capability_gb50204_layers"]
    assert empty == Estimate(None, None, 0)
    missed = np.r_[np.full(30, 1.0), np.full(10, MISS_MM)]
    table = table_of([{"layer_judged_mm": missed} for _ in range(VIEWS)])
    assert table.numbers[NATIVE]["layer_p95_mm"].value == MISS_MM
    assert table.numbers[NATIVE]["capability_gb50204_layers"] == Estimate(None, None, 40 * VIEWS)


def test_an_end_that_is_a_miss_is_no_capability_at_all() -> None:
    p95 = Estimate(50.0, (8.0, MISS_MM), 40)
    assert converted(measure_of(), p95) == Estimate(0.2, (0.0, 1.25), 40)


def test_errors_of_zero_are_an_endless_capability_without_an_interval() -> None:
    assert converted(measure_of(), Estimate(0.0, (0.0, 2.0), 40)) == Estimate(math.inf, None, 40)


def test_the_p95_is_left_as_it_is() -> None:
    p95 = Estimate(50.0, (8.0, MISS_MM), 40)
    assert converted(BY_NAME["spacing_p95_mm"], p95) == p95


@given(st.floats(1e-3, 99.0), st.floats(1e-3, 99.0), st.floats(0.1, 1000.0))
def test_a_larger_error_is_never_more_capable(one_mm: float, other_mm: float, limit_mm: float) -> None:
    small, large = sorted((one_mm, other_mm))
    better, worse = told_capability(limit_mm, small), told_capability(limit_mm, large)
    assert better is not None
    assert worse is not None
    assert better >= worse > 0
    assert worse * large == pytest.approx(limit_mm)


def test_taking_bars_away_never_raises_a_capability() -> None:
    filled = spacings()
    whole = table_of(filled).numbers[NATIVE]["capability_gb50204_spacing"].value
    rng = np.random.default_rng(5)
    values = []
    for share in (0.01, 0.03, 0.2):
        holes = [
            {name: np.where(rng.random(len(mm)) < share, MISS_MM, mm) for name, mm in one.items()}
            for one in filled
        ]
        values.append(table_of(holes).numbers[NATIVE]["capability_gb50204_spacing"].value)
    assert whole is not None
    assert all(value is None or value <= whole for value in values)
    assert values[-1] is None


def test_a_view_by_itself_has_its_own() -> None:
    one = view(0, {"spacing_judged_mm": np.full(10, 4.0)})
    assert view_value(one, NATIVE, BY_NAME[capability_name(SPACING)]) == 2.5
    missed = view(0, {"spacing_judged_mm": np.full(10, MISS_MM)})
    assert view_value(missed, NATIVE, BY_NAME[capability_name(SPACING)]) is None
    assert view_value(view(0, {}), NATIVE, BY_NAME[capability_name(SPACING)]) is None


def extended_of(filled: list[dict[str, np.ndarray]]) -> ExtendedResult:
    views = [view(100 * index, one) for index, one in enumerate(filled)]
    table = tabulate_extended(views, [100 * index for index in range(len(views))], measures_by_alignment())
    return ExtendedResult(
        measures_by_alignment(), {"lattice": table}, [view_numbers(one, measures_by_alignment()) for one in views]
    )


def test_json_and_csv_have_it() -> None:
    extended = extended_of(spacings())
    tables = extended.to_dict()["tables"]["lattice"]
    shown = tables["native"]["capability_gb50204_spacing"]
    assert shown["value"] == pytest.approx(10 / tables["native"]["spacing_p95_mm"]["value"])
    assert len(shown["ci95"]) == 2
    view_numbers = extended.to_dict()["views"][0]["scaled"]
    assert view_numbers["capability_gb50204_stirrup_spacing"] == pytest.approx(20 / view_numbers["spacing_p95_mm"])
    whole = dataclasses.replace(result(scored("lattice/0000")), extended=extended)
    rows = {(row["alignment"], row["measure"]): row for row in csv.DictReader(io.StringIO(extended_csv(whole)))}
    row = rows["native", "capability_gb50204_spacing"]
    assert float(row["value"]) == shown["value"]
    assert [float(row["low"]), float(row["high"])] == shown["ci95"]
    assert rows["native", "capability_gb50204_layers"]["value"] == ""


def printed(extended: ExtendedResult, width: int = 100) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    print_extended(extended, console)
    return console.export_text()


def test_the_terminal_prints_each_and_says_where_it_tells_none() -> None:
    text = printed(extended_of(spacings()))
    numbers = table_of(spacings()).numbers[NATIVE]
    line = next(line for line in text.splitlines() if "bar spacing: 10 mm / p95" in line)
    value = numbers["capability_gb50204_spacing"].value
    assert f"{value:.4g}" in line
    assert "not told" not in text
    missed = printed(extended_of([{"spacing_judged_mm": np.full(9, MISS_MM)} for _ in range(VIEWS)]))
    line = next(line for line in missed.splitlines() if "bar spacing: 10 mm / p95" in line)
    assert line.count("not told") == 2
    assert "not told: 5 % or more were not found." in missed


@pytest.mark.parametrize("width", [80, 100])
def test_names_give_way_and_numbers_stay_whole(width: int) -> None:
    rng = np.random.default_rng(8)
    samples = sorted({measure.sample for measure in BY_NAME.values()})
    filled = [
        dict(zip(samples, rng.normal(-0.123456, 0.01, (len(samples), 3)), strict=True)) for _ in range(VIEWS)
    ]
    for one in filled:
        one |= {name: np.abs(values) for name, values in one.items() if "judged" in name}
    text = printed(extended_of(filled), width)
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in text
    assert f"{STIRRUPS.limit_mm:g} mm / p95" in text
