"""The reference results: what they were run on, that methods and runs fit, and that the card's rows are theirs."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import pytest

from benchmarks.reference import RUNS, SUBSET
from cards.benchmark import RESULTS, reference_context
from rebar_depth_bench.methods import own_methods

STORED: dict[str, Any] = json.loads(RESULTS.read_text())


def test_every_run_is_stored_and_every_method_that_runs_on_a_cpu_is_run() -> None:
    assert set(STORED["results"]) == set(RUNS)
    assert STORED["subset"] == asdict(SUBSET)
    elsewhere = {name for name, method in own_methods().items() if method.info.unexercised}
    assert set(own_methods()) - elsewhere - set(RUNS) == {"lidar-survey"}


@pytest.mark.parametrize("method", RUNS)
def test_a_run_has_the_configs_and_views_it_states(method: str) -> None:
    result = STORED["results"][method]
    assert tuple(result["tables"]) == RUNS[method]
    assert result["submission"]["method"] == method
    assert all(table["views"] <= SUBSET.views for table in result["tables"].values())
    assert result["dataset"] == STORED["results"]["truth"]["dataset"]


def test_the_truth_is_perfect_and_its_noise_is_what_it_is_told_to_be() -> None:
    for config, table in STORED["results"]["truth"]["tables"].items():
        assert table["native"]["abs_rel"] == 0, config
        assert table["ranked"]
    for table in STORED["results"]["noisy-truth"]["tables"].values():
        assert table["native"]["abs_rel"] == pytest.approx(0.25, abs=0.003)
        assert table["scale_median"] == pytest.approx(1 / 1.25, abs=0.003)


def test_the_cards_rows_are_the_stored_numbers() -> None:
    rows = {
        (config, row["method"]): row for config, found in reference_context()["reference"].items() for row in found
    }
    assert set(rows) == {(config, method) for method, configs in RUNS.items() for config in configs}
    table = STORED["results"]["sgbm-filled"]["tables"]["lattice"]
    row = rows["lattice", "sgbm-filled"]
    low, high = table["ci95"]["native"]["abs_rel"]
    assert row["abs_rel"] == f"{table['native']['abs_rel']:.4f} ({low:.3f}-{high:.3f})"
    assert row["rmse"] == f"{table['native']['rmse_cm']:.2f} cm"
    assert row["coverage"] == f"{100 * table['coverage']:.1f} %"
    assert row["within"] == f"{100 * table['within_mm']['5']:.1f} %"
