"""Stored reference results: completeness, dataset, expected values and agreement with the benchmark card."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from benchmarks.reference import RUNS, SUBSET
from cards.benchmark import REFERENCE_RESULTS, reference_context
from rebar_depth_bench.methods import own_methods

STORED: dict[str, Any] = json.loads(REFERENCE_RESULTS.read_text())


def test_every_cpu_method_has_a_stored_run() -> None:
    assert set(STORED["results"]) == set(RUNS)
    assert STORED["subset"] == asdict(SUBSET)
    untested = {name for name, method in own_methods().items() if method.info.untested_note}
    assert set(own_methods()) - untested - set(RUNS) == {"lidar-survey"}


@pytest.mark.parametrize("method", RUNS)
def test_run_has_its_configs_and_views(method: str) -> None:
    result = STORED["results"][method]
    assert tuple(result["tables"]) == RUNS[method]
    assert result["submission"]["method"] == method
    assert all(table["views"] <= SUBSET.views for table in result["tables"].values())
    assert result["dataset"] == STORED["results"]["truth"]["dataset"]


def test_truth_has_zero_error_and_noise_has_specified_error() -> None:
    for config, table in STORED["results"]["truth"]["tables"].items():
        assert table["native"]["abs_rel"] == table["rank_error"] == 0, config
        assert not table["ranked"]
    for table in STORED["results"]["noisy-truth"]["tables"].values():
        assert table["native"]["abs_rel"] == pytest.approx(0.25, abs=0.003)
        assert table["scale_median"] == pytest.approx(1 / 1.25, abs=0.003)


def test_reference_errors_do_not_depend_on_the_method() -> None:
    for config, rows in reference_context()["reference_errors"].items():
        tables = [STORED["results"][method]["tables"][config] for method, names in RUNS.items() if config in names]
        assert all(table["reference"] == tables[0]["reference"] for table in tables)
        assert rows["constant"][0] == f"{tables[0]['reference']['constant']['abs_rel']:.4f}"


def test_card_rows_match_stored_results() -> None:
    rows = {
        (config, row["method"]): row
        for config, config_rows in reference_context()["reference"].items()
        for row in config_rows
    }
    assert set(rows) == {(config, method) for method, configs in RUNS.items() for config in configs}
    table = STORED["results"]["sgbm-filled"]["tables"]["lattice"]
    row = rows["lattice", "sgbm-filled"]
    low, high = table["ci95"]["native"]["abs_rel"]
    assert row["abs_rel"] == f"{table['native']['abs_rel']:.4f} ({low:.3f}-{high:.3f})"
    assert row["rmse"] == f"{table['native']['rmse_cm']:.2f} cm"
    assert row["coverage"] == f"{100 * table['coverage']:.1f} %"
    assert row["rank_error"] == f"{table['rank_error']:.4f}"
    assert row["within"] == f"{100 * table['within_mm']['5']:.1f} %"
