"""Terminal table and CSV of one result."""

from __future__ import annotations

import csv
import io
import json

import pytest
from rich.console import Console

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.tables import print_table
from rebar_depth_bench.scoring.columns import DASH, coverage_percent, number
from rebar_depth_bench.scoring.frames import frame_csv
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.score import tabulate
from tests.bench.reporting.results import HOSTILE, overflowed_view, result, scored_view, unpredicted_view


def _print_to_text(shown: Result, width: int, *, terminal: bool = False) -> str:
    out = io.StringIO()
    print_table(shown, Console(file=out, width=width, force_terminal=terminal))
    return out.getvalue()


def _row_cells(printed: str, config: str) -> list[str]:
    rows = [line.split() for line in printed.splitlines() if line.split()[:1] == [config]]
    return [cell for row in rows for cell in row[1:]]


@pytest.fixture
def two_configs() -> Result:
    return result(
        scored_view("lattice/0000"),
        scored_view("lattice/0001"),
        scored_view("lattice-zed-raw/0000", coverage=0.94996),
        unpredicted_view("lattice-zed-raw/0001"),
    )


ROW_CELLS = {
    "0.7500",
    "20.09",
    "18.71",
    "0.123",
    "0.0613",
    "1.52",
    "1.17",
    "0.988",
    "0.625",
    "1.2",
    "4.6",
    "7.9",
    "13.6",
    "100.0",
    "2/2",
    "0.4286",
}


@pytest.mark.parametrize("width", [40, 80, 100, 140, 200])
def test_numbers_are_not_truncated_at_any_width(two_configs: Result, width: int) -> None:
    assert set(_row_cells(_print_to_text(two_configs, width), "lattice")) == ROW_CELLS


@pytest.mark.parametrize(("width", "tables"), [(80, 3), (100, 2), (160, 1)])
def test_table_splits_on_narrow_console(two_configs: Result, width: int, tables: int) -> None:
    printed = _print_to_text(two_configs, width)
    assert max(map(len, printed.splitlines())) <= width
    assert sum(line.startswith("config") for line in printed.splitlines()) == tables


@pytest.mark.parametrize("width", [80, 160])
def test_alignment_protocol_method_and_dataset_are_stated(two_configs: Result, width: int) -> None:
    printed = _print_to_text(two_configs, width)
    for stated in (
        "native (no alignment)",
        "scaled (oracle median scale per view, s = median(z)/median(p))",
        "my model, protocol rebar-2",
        "1.2.3 (sha256:fedcba987654)",
        "cm",
    ):
        assert stated in printed


def test_incomparable_row_states_reason(two_configs: Result) -> None:
    printed = _print_to_text(two_configs, 160)
    reasons = "1 of 2 views without any prediction; coverage 47.4 % is below 95 %."
    assert f"not compared with those of others: {reasons}" in " ".join(printed.split())
    assert "lattice: Errors" not in printed
    assert {"0.7286", "1/2"} <= set(_row_cells(printed, "lattice-zed-raw"))


def test_overflow_prints_dash_and_footnote_and_unranks() -> None:
    printed = _print_to_text(result(overflowed_view("pier/0000")), 160)
    assert (
        "pier: Errors of valid predictions are not compared with those of others: a number overflowed." in printed
    )
    assert _row_cells(printed, "pier")[3:6] == ["1.0e+200", "–", "1.0e+202"]
    assert formatting.DASH_NOTE in printed


def test_config_without_prediction_is_all_dashes() -> None:
    printed = _print_to_text(result(unpredicted_view("pier/0000")), 160)
    assert _row_cells(printed, "pier") == ["0/1", "0.0", "1.0000", *["–"] * 9, *["0.0"] * 4]


def test_no_footnote_without_dash() -> None:
    assert DASH not in _print_to_text(result(scored_view("lattice/0000")), 160)


def test_output_has_no_control_characters() -> None:
    shown = result(scored_view("lattice/0000"), method=HOSTILE)
    piped = _print_to_text(shown, 100)
    assert "\x1b" not in piped
    assert "\u202e" not in piped
    assert "[red]\N{REPLACEMENT CHARACTER}[31m" in piped, "markup is text"
    assert "\x1b[31m" not in _print_to_text(shown, 100, terminal=True)


def test_coverage_percent_is_rounded_down() -> None:
    assert coverage_percent(0.94999) == "94.9"
    assert coverage_percent(0.99999) == "99.9"
    assert coverage_percent(0.283) == "28.3"
    assert coverage_percent(1.0) == "100.0"


def test_extreme_numbers_use_scientific_notation() -> None:
    assert number(0.00004, 4) == "4.0e-05"
    assert number(0.00005, 4) == "0.0001"
    assert number(0.0, 4) == "0.0000"
    assert number(2e6, 2) == "2.0e+06"
    assert number(float("nan"), 2) == DASH


def test_no_views_is_an_unranked_reason() -> None:
    assert "Not ranked: no views." in formatting.table_notes(tabulate([]))


def test_csv_matches_json(two_configs: Result) -> None:
    rows = list(csv.DictReader(io.StringIO(frame_csv(two_configs.to_pandas()))))
    written = json.loads(two_configs.to_json())
    assert [row["config"] for row in rows] == ["lattice", "lattice-zed-raw"]
    for row in rows:
        table = written["tables"][row["config"]]
        assert (int(row["views"]), int(row["views_scored"])) == (table["views"], table["views_scored"])
        assert float(row["coverage"]) == table["coverage"]
        assert row["ranked"] == str(table["ranked"]).lower()
        assert float(row["scale_median"]) == table["scale_median"]
        for alignment in ("native", "scaled"):
            for name, value in table[alignment].items():
                assert float(row[f"{alignment}_{name}"]) == value
        for tolerance, share in table["within_mm"].items():
            assert float(row[f"within_{tolerance}mm"]) == share
        assert row["dataset_digest"] == written["dataset"]["digest"]
        assert row["dataset_version"] == "1.2.3"
        assert row["submission_sha256"] == written["submission"]["sha256"]
        assert row["software_version"] == "0.1.0"
        assert (row["protocol"], row["method"]) == ("rebar-2", "my model")


def test_csv_nulls_are_empty_and_newlines_are_unix() -> None:
    content = frame_csv(result(unpredicted_view("pier/0000"), method="a\rb\nc").to_pandas())
    assert "\r\n" not in content
    assert content.endswith("\n")
    row = next(csv.DictReader(io.StringIO(content, newline="")))
    assert row["native_abs_rel"] == row["scaled_delta1"] == row["scale_median"] == ""
    assert row["method"] == "a\N{REPLACEMENT CHARACTER}b\N{REPLACEMENT CHARACTER}c"


@pytest.mark.parametrize("method", [HOSTILE, "+1", "-1", "@x"])
def test_csv_quotes_spreadsheet_formulas(method: str) -> None:
    frame = result(scored_view("lattice/0000"), method=method).to_pandas()
    row = next(csv.DictReader(io.StringIO(frame_csv(frame))))
    assert row["method"] == "'" + printable(method)
