"""Stored reference results: completeness, dataset, expected values and agreement with the benchmark card."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks.reference import RUNS, SETS
from cards.reference import CAGES, FULL_SETS, SUBSET, reference_context, results_file
from rebar_depth_bench.methods import own_methods

PUBLISHED = (SUBSET, *FULL_SETS, CAGES)
STORED: dict[str, dict[str, Any]] = {name: json.loads(results_file(name).read_text()) for name in PUBLISHED}


def test_every_cpu_method_has_a_stored_run() -> None:
    assert set(SETS[SUBSET].runs) == set(RUNS)
    untested = {name for name, method in own_methods().items() if method.info.untested_note}
    assert set(own_methods()) - untested - set(RUNS) == {"lidar-survey"}


@pytest.mark.parametrize("name", PUBLISHED)
def test_set_has_its_methods_configs_and_views(name: str) -> None:
    renders, runs, results = SETS[name].renders, SETS[name].runs, STORED[name]["results"]
    assert STORED[name]["renders"] == renders.to_dict()
    assert set(results) == set(runs)
    for method, result in results.items():
        assert tuple(result["tables"]) == runs[method]
        assert result["submission"]["method"] == method
        assert all(table["views"] <= renders.views for table in result["tables"].values())
        assert result["dataset"] == results["truth"]["dataset"]


@pytest.mark.parametrize("name", PUBLISHED)
def test_truth_has_zero_error_and_noise_has_specified_error(name: str) -> None:
    results = STORED[name]["results"]
    for config, table in results["truth"]["tables"].items():
        assert table["native"]["abs_rel"] == table["rank_error"] == 0, config
        assert not table["ranked"]
    for table in results["noisy-truth"]["tables"].values():
        assert table["native"]["abs_rel"] == pytest.approx(0.25, abs=0.003)
        assert table["scale_median"] == pytest.approx(1 / 1.25, abs=0.003)


@pytest.mark.parametrize("name", PUBLISHED)
def test_reference_errors_do_not_depend_on_the_method(name: str) -> None:
    results = STORED[name]["results"]
    for config, errors in reference_context(name)["errors"].items():
        tables = [result["tables"][config] for result in results.values() if config in result["tables"]]
        assert all(table["reference"] == tables[0]["reference"] for table in tables)
        assert errors["constant"][0] == f"{tables[0]['reference']['constant']['abs_rel']:.4f}"


@pytest.mark.parametrize("name", PUBLISHED)
def test_card_rows_match_stored_results(name: str) -> None:
    config = SETS[name].configs[0]
    rows = {row["method"]: row for row in reference_context(name)["rows"][config]}
    assert set(rows) == {method for method, configs in SETS[name].runs.items() if config in configs}
    table = STORED[name]["results"]["sgbm-filled"]["tables"][config]
    row = rows["sgbm-filled"]
    low, high = table["ci95"]["native"]["abs_rel"]
    assert row["abs_rel"] == f"{table['native']['abs_rel']:.4f} ({low:.3f}-{high:.3f})"
    assert row["rmse"] == f"{table['native']['rmse_cm']:.2f} cm"
    assert row["coverage"] == f"{100 * table['coverage']:.1f} %"
    assert row["rank_error"] == f"{table['rank_error']:.4f}"
    assert row["within"] == f"{100 * table['within_mm']['5']:.1f} %"
