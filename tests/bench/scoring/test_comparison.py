"""Tests of paired comparisons: known differences, chance differences and incompatible results."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rebar_depth_bench import InputError, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.reporting.tables import print_comparison
from rebar_depth_bench.scoring.columns import COLUMN_BY_PATH, VIEW_COLUMNS
from rebar_depth_bench.scoring.comparison import Difference, compare
from rebar_depth_bench.scoring.frames import frame_csv
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.score import tabulate
from rebar_depth_bench.scoring.table import ViewScore


def result_of(errors: np.ndarray, method: str = "m", config: str = "lattice", digest: str = "sha256:1") -> Result:
    views, step = [], 12 if len(errors) < 100 else 1  # Few views are those of a sparse subset.
    for n, error in enumerate(errors):
        metrics = None if math.isnan(error) else DepthMetrics(error, 10 * error, 9 * error, 1 - error / 10)
        scale = None if metrics is None else 1.0 + error
        within = dict.fromkeys((3, 5, 10, 20), 0.0 if metrics is None else 1 - error / 2)
        covered = 0.0 if metrics is None else 1.0
        rank_error = 1.0 if metrics is None else error / (1 + error)
        views.append(
            ViewScore(f"{config}/{step * n:04}", 100, covered, rank_error, scale, metrics, metrics, within)
        )
    return Result(
        dataset=DatasetIdentity(digest, "1"),
        submission=SubmissionIdentity(method, "ab" * 32),
        software=SoftwareIdentity("2"),
        tables={config: tabulate(views)},
        views=views,
    )


def difference(first: Result, other: Result, name: str = "native.abs_rel") -> Difference:
    [rows] = compare(first, other).configs.values()
    return next(row for row in rows if row.column.path == name)


@pytest.mark.slow
def test_paired_difference_below_view_spread_is_decided() -> None:
    """Compare submissions 0.002 apart on views that differ by 0.1: only their separate intervals overlap."""
    rng = np.random.default_rng(1)
    view_errors = rng.uniform(0.1, 0.5, 504)
    first, other = result_of(view_errors), result_of(view_errors + 0.002 + rng.normal(0, 0.002, 504))
    a, b = (result.tables["lattice"].intervals["native.abs_rel"] for result in (first, other))
    assert a is not None
    assert b is not None
    assert a[1] > b[0]
    paired = difference(first, other)
    assert paired.interval is not None
    assert paired.interval[0] < 0.002 < paired.interval[1]
    assert paired.interval[1] - paired.interval[0] < 0.001
    assert paired.verdict == "worse"
    assert difference(other, first).verdict == "better"
    assert difference(first, other, "rank_error").verdict == "worse"
    assert difference(first, other, "native.delta1").verdict == "worse"
    assert difference(first, other, "within_mm.5").verdict == "worse"
    assert difference(first, other, "scale_median").verdict == ""


@pytest.mark.slow
def test_equal_quality_is_rarely_decided() -> None:
    rng = np.random.default_rng(2)
    decided_count = 0
    for _ in range(40):
        view_errors = rng.uniform(0.1, 0.5, 252)
        first, other = (result_of(view_errors + rng.normal(0, 0.01, 252)) for _ in range(2))
        decided_count += difference(first, other).verdict != "undecided"
    assert decided_count <= 6


def test_submission_equals_itself() -> None:
    same = result_of(np.linspace(0.1, 0.9, 20))
    for rows in compare(same, same).configs.values():
        assert [row.column for row in rows] == list(VIEW_COLUMNS)
        assert all(row.difference == 0 and row.interval == (0, 0) for row in rows)
        assert {row.verdict for row in rows} == {"equal", ""}


def test_errors_at_low_coverage_are_not_comparable() -> None:
    """Compare with predictions on a fifth of the pixels: only the rank error counts the others."""
    complete, partial = result_of(np.full(20, 0.3)), result_of(np.full(20, 0.1))
    views = [replace(view, coverage=0.2, rank_error=0.8) for view in partial.views]
    partial = replace(partial, tables={"lattice": tabulate(views)}, views=views)
    assert not partial.tables["lattice"].is_comparable
    assert difference(complete, partial, "rank_error").verdict == "worse"
    assert difference(complete, partial).verdict == "no verdict"
    assert difference(partial, complete, "scaled.delta1").verdict == "no verdict"
    assert difference(complete, partial, "coverage").verdict == "worse"


def test_errors_use_common_views_and_shares_use_all_views() -> None:
    errors = np.linspace(0.1, 0.9, 20)
    holes = errors.copy()
    holes[3::4] = np.nan  # every fourth view, the worst included, is omitted: this must not count as better
    first, other = result_of(errors), result_of(holes)
    assert difference(first, other).views == 15
    assert difference(first, other).difference == 0
    assert difference(first, other).verdict == "no verdict"
    assert difference(first, other, "coverage").views == 20
    assert difference(first, other, "rank_error").views == 20
    assert difference(first, other, "rank_error").verdict == "worse"
    assert difference(first, other, "coverage").verdict == "worse"
    assert difference(first, other, "within_mm.20").verdict == "worse"


def test_few_views_have_a_difference_but_no_verdict() -> None:
    row = difference(result_of(np.full(3, 0.1)), result_of(np.full(3, 0.9)))
    assert row.difference == pytest.approx(0.8)
    assert (row.interval, row.verdict) == (None, "undecided")


def test_incompatible_results_raise_input_error() -> None:
    reference = result_of(np.ones(6), "one")
    with pytest.raises(InputError, match=r"two was scored on the dataset sha256:2, expected sha256:1 as one"):
        compare(reference, result_of(np.ones(6), "two", digest="sha256:2"))
    with pytest.raises(InputError, match="one has lattice and two has pier: expected a config that is in both"):
        compare(reference, result_of(np.ones(6), "two", config="pier"))


def test_table_is_80_columns_and_names_every_number() -> None:
    comparison = compare(result_of(np.linspace(0.1, 1, 12), "A [red]"), result_of(np.linspace(0.2, 1, 12), "=B"))
    console = Console(width=80, record=True, file=io.StringIO())
    print_comparison(comparison, console)
    text = console.export_text()
    assert "B: =B, against A: A [red]" in text
    assert all(column.heading in text for column in VIEW_COLUMNS)
    assert max(map(len, text.splitlines())) <= 80
    rows = list(csv.DictReader(io.StringIO(frame_csv(comparison.to_pandas()))))
    assert [row["number"] for row in rows] == list(COLUMN_BY_PATH)
    assert rows[0]["other_method"] == "'=B"
    assert float(rows[1]["low"]) <= float(rows[1]["difference"]) <= float(rows[1]["high"])


def test_compare_command_on_archives(
    tiny_truth: dict[str, np.ndarray],
    tiny_root: Path,
    archive_of: Callable[..., Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    exact = archive_of(tiny_truth, "exact.zip")
    far = archive_of({view: 1.1 * depth for view, depth in tiny_truth.items()}, "far.zip")
    out = tmp_path / "out.json"
    status = main(["compare", str(exact), str(far), str(exact), "--data", str(tiny_root), "--json", str(out)])
    assert status == 0
    to_far, to_exact = json.loads(out.read_text())
    assert to_far["intervals"] == {"method": "expanded-percentile", "draws": 2000, "level": 0.95}
    by_name = {row["name"]: row for row in to_far["configs"]["lattice"]}
    assert by_name["native.abs_rel"]["difference"] == pytest.approx(0.1, abs=1e-6)
    assert by_name["native.abs_rel"]["verdict"] == "worse"
    assert by_name["scaled.abs_rel"]["other"] == pytest.approx(0, abs=1e-6)
    assert {row["difference"] for row in to_exact["configs"]["lattice"]} == {0}
    assert to_far["dataset"]["digest"] == score(exact, tiny_root).dataset.digest
    assert "worse" in capsys.readouterr().out
