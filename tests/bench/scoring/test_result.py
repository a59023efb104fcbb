"""Tests of result tables: means, medians, ranking and JSON content."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.score import tabulate
from rebar_depth_bench.scoring.table import ViewScore
from rebar_depth_bench.submission import Declaration


def view(number: int, value: float | None, coverage: float = 1.0, scale: float = 1.0) -> ViewScore:
    metrics = None if value is None else DepthMetrics(value, value, value, 0.5)
    return ViewScore(
        view_id=f"lattice/{number:04d}",
        scored_px=10,
        coverage=coverage,
        rank_error=1.0 if value is None else coverage * value / (1 + value) + 1 - coverage,
        scale=None if value is None else scale,
        native=metrics,
        scaled=metrics,
        within_mm=dict.fromkeys(WITHIN_MM, 0.25),
    )


def result_of(*views: ViewScore) -> Result:
    return Result(
        dataset=DatasetIdentity("sha256:11", "1"),
        submission=SubmissionIdentity("m", "00"),
        software=SoftwareIdentity("2"),
        tables={"lattice": tabulate(views)},
        views=list(views),
    )


def test_table_has_mean_metrics_and_median_scale() -> None:
    table = tabulate([view(0, 1.0, scale=0.5), view(1, 2.0, scale=0.7), view(2, 6.0, scale=4.0)])
    assert table.native is not None
    assert table.native.abs_rel == 3.0
    assert table.scale_median == 0.7
    assert (table.views, table.views_scored, table.ranked) == (3, 3, True)


def test_even_scale_count_averages_middle_two() -> None:
    assert tabulate([view(0, 1.0, scale=1.0), view(1, 1.0, scale=2.0)]).scale_median == 1.5


@pytest.mark.parametrize(("coverage", "comparable"), [(0.95, True), (math.nextafter(0.95, 0), False)])
def test_errors_are_comparable_from_coverage_threshold(coverage: float, comparable: bool) -> None:
    table = tabulate([view(0, 1.0, coverage), view(1, 1.0, coverage)])
    assert (table.is_comparable, table.ranked) == (comparable, True)


@pytest.mark.parametrize(("uses_ground_truth", "ranked"), [(None, True), (False, True), (True, False)])
def test_declared_use_of_ground_truth_is_not_ranked(uses_ground_truth: bool | None, ranked: bool) -> None:
    assert tabulate([view(0, 1.0)], Declaration("rgb", uses_ground_truth)).ranked is ranked


def test_view_without_prediction_is_not_averaged_but_counts_in_rank_error() -> None:
    views = [view(n, 1.0) for n in range(99)] + [view(99, None, coverage=0.0)]
    table = tabulate(views)
    assert table.native is not None
    assert (table.native.abs_rel, table.views_scored, table.views) == (1.0, 99, 100)
    assert (table.ranked, table.is_comparable) == (True, False)
    assert table.rank_error == pytest.approx((99 * 0.5 + 1) / 100)
    assert table.coverage == pytest.approx(0.99)


def test_infinite_view_makes_mean_null() -> None:
    table = tabulate([view(0, 1.0), replace(view(1, math.inf), rank_error=1.0)])
    assert (table.ranked, table.is_comparable, table.rank_error) == (True, False, 0.75)
    table_json = result_of(view(0, 1.0), replace(view(1, math.inf), rank_error=1.0)).to_dict()["tables"]["lattice"]
    assert table_json["native"]["abs_rel"] is None
    assert table_json["native"]["delta1"] == 0.5


def test_no_views_give_null_and_unranked_table() -> None:
    table = result_of().to_dict()["tables"]["lattice"]
    assert table["views"] == 0
    assert table["ranked"] is False
    assert table["native"]["abs_rel"] is None
    assert table["rank_error"] is None
    assert table["scale_median"] is None


def test_json_keys_and_units_match_contract() -> None:
    content = json.loads(result_of(view(0, 0.25)).to_json())
    assert list(content) == ["protocol", "dataset", "submission", "software", "intervals", "tables", "views"]
    assert content["intervals"] == {"method": "expanded-percentile", "draws": 2000, "level": 0.95}
    assert content["protocol"] == "rebar-2"
    assert content["dataset"] == {"digest": "sha256:11", "version": "1"}
    assert content["submission"] == {
        "method": "m",
        "sha256": "00",
        "inputs": None,
        "uses_ground_truth": None,
    }
    table = content["tables"]["lattice"]
    assert list(table) == [
        "views",
        "views_scored",
        "coverage",
        "ranked",
        "rank_error",
        "native",
        "scaled",
        "scale_median",
        "within_mm",
        "reference",
        "published",
        "ci95",
    ]
    assert table["native"] == {"abs_rel": 0.25, "rmse_cm": 0.25, "mae_cm": 0.25, "delta1": 0.5}
    assert list(table["within_mm"]) == ["3", "5", "10", "20"]
    assert list(content["views"][0]) == [
        "view_id",
        "scored_px",
        "coverage",
        "rank_error",
        "scale",
        "native",
        "scaled",
        "within_mm",
    ]


@pytest.mark.slow
@given(st.lists(st.floats(0, 1e6), min_size=1, max_size=20))
def test_means_are_independent_of_view_order(values: list[float]) -> None:
    views = [view(n, value) for n, value in enumerate(values)]
    assert tabulate(views).native == tabulate(views[::-1]).native
