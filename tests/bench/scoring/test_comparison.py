"""Comparisons of results, and results and bars as data frames."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from rich.console import Console

import rebar_depth_bench as rdb
from rebar_depth_bench import InputError, score
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.bars import Bar, read_bars, write_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.extended.estimates import ExtendedResult
from rebar_depth_bench.reporting.extended_tables import extended_csv
from rebar_depth_bench.reporting.tables import print_comparison
from rebar_depth_bench.scoring.columns import METRIC_COLUMNS, METRICS, WITHIN
from rebar_depth_bench.scoring.comparison import Difference, Verdict, compare
from rebar_depth_bench.scoring.result import DatasetIdentity, Result
from rebar_depth_bench.scoring.spreadsheet import Sheet, differences_sheet, tables_sheet
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, changed, result, scored_view, unpredicted_view
from tests.damage import change_manifest, copy_dataset


def result_of(errors: np.ndarray, method: str = "m", config: str = "lattice", digest: str = "sha256:1") -> Result:
    views, step = [], 12 if len(errors) < 100 else 1  # Few views are those of a sparse subset.
    for n, error in enumerate(errors):
        view_id = f"{config}/{step * n:04}"
        if math.isnan(error):
            views.append(unpredicted_view(view_id))
            continue
        metrics = dict(zip(METRICS, (error, 10 * error, 9 * error, 1 - error / 10), strict=True))
        numbers = {f"{start}.{name}": metrics[name] for start in ("native", "scaled") for name in METRICS}
        numbers |= {column.place: 1 - error / 2 for column in WITHIN}
        views.append(changed(scored_view(view_id, error, scale=1.0 + error), numbers))
    return replace(result(*views, method=method), dataset=DatasetIdentity(digest, "1"))


def difference(first: Result, other: Result, name: str = "native.abs_rel") -> Difference:
    [rows] = compare(first, other).configs.values()
    return next(row for row in rows if row.column.place == name)


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
    names = ("rank_error", "native.delta1", "within_mm.5", "scale_median")
    assert [difference(first, other, name).verdict for name in names] == ["worse", "worse", "worse", ""]


def test_submission_equals_itself() -> None:
    same = result_of(np.linspace(0.1, 0.9, 20))
    for rows in compare(same, same).configs.values():
        assert [row.column for row in rows] == list(METRIC_COLUMNS)
        assert all(row.difference == 0 and row.interval == (0, 0) for row in rows)
        assert {row.verdict for row in rows} == {"equal", ""}


def test_errors_at_low_coverage_are_not_comparable() -> None:
    """Compare with predictions on a fifth of the pixels: only the rank error counts the others."""
    complete, partial = result_of(np.full(20, 0.3)), result_of(np.full(20, 0.1))
    views = [changed(view, {"coverage": 0.2, "rank_error": 0.8}) for view in partial.views]
    partial = replace(result(*views), dataset=complete.dataset)
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
    errors_row = difference(first, other)
    assert (errors_row.views, errors_row.difference, errors_row.verdict) == (15, 0, "no verdict")
    for name in ("coverage", "rank_error", "within_mm.20"):
        row = difference(first, other, name)
        assert (row.views, row.verdict) == (20, "worse"), name


def test_only_shared_views_are_compared() -> None:
    """The other result lacks the worst views, and then has all in another order."""
    errors = np.linspace(0.1, 0.9, 20)
    first, all_views = result_of(errors), result_of(errors + 0.01)
    frame = all_views.frames["lattice"]
    other = replace(all_views, frames={"lattice": frame.take(range(10))})
    expected = compare(result_of(errors[:10]), result_of(errors[:10] + 0.01)).configs
    assert compare(first, other).configs == expected
    turned = replace(all_views, frames={"lattice": frame.take(range(20)[::-1])})
    assert difference(first, turned).interval == pytest.approx((0.01, 0.01))


def test_chance_differences_are_undecided_and_few_views_are_named() -> None:
    errors = np.linspace(0.3, 0.5, 20)
    row = difference(result_of(errors), result_of(errors + 0.01 * (-1.0) ** np.arange(20)))
    assert row.interval is not None
    assert row.interval[0] < 0 < row.interval[1]
    assert row.verdict == "undecided"
    row = difference(result_of(np.full(3, 0.1)), result_of(np.full(3, 0.9)))
    assert row.difference == pytest.approx(0.8)
    assert (row.interval, row.verdict) == (None, "too few views")


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
    assert all(column.heading in text for column in METRIC_COLUMNS)
    assert max(map(len, text.splitlines())) <= 80
    rows = list(csv.DictReader(io.StringIO(differences_sheet([comparison.to_dict()]).to_csv())))
    assert [row["number"] for row in rows] == [column.place for column in METRIC_COLUMNS]
    assert rows[0]["other_method"] == "'=B"
    assert {row["verdict"] for row in rows} <= {*get_args(Verdict)}
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
    assert to_far["intervals"] == {"method": "expanded-percentile-2", "draws": 2000, "level": 0.95}
    by_name = {row["name"]: row for row in to_far["configs"]["lattice"]}
    assert by_name["native.abs_rel"]["difference"] == pytest.approx(0.1, abs=1e-6)
    assert by_name["native.abs_rel"]["verdict"] == "worse"
    assert by_name["scaled.abs_rel"]["other"] == pytest.approx(0, abs=1e-6)
    assert {row["difference"] for row in to_exact["configs"]["lattice"]} == {0}
    assert to_far["dataset"]["digest"] == score(exact, tiny_root).dataset.digest
    assert "worse" in capsys.readouterr().out


@pytest.fixture
def two_configs() -> Result:
    return result(
        *(scored_view(f"lattice/{12 * index:04d}") for index in range(12)),
        scored_view("pier/0000"),
        unpredicted_view("pier/0001"),
    )


def test_tables_have_numbers_and_intervals_of_json(two_configs: Result) -> None:
    frame = two_configs.to_pandas().set_index("config")
    document = two_configs.to_dict()
    assert list(frame.index) == list(document["tables"])
    assert frame.dtypes[["views", "ranked", "native_abs_rel"]].tolist() == [np.int64, np.bool_, np.float64]
    for config, table in document["tables"].items():
        assert frame.loc[config, "native_abs_rel"] == table["native"]["abs_rel"]
        assert frame.loc[config, "within_10mm"] == table["within_mm"]["10"]
    low, high = document["tables"]["lattice"]["ci95"]["native"]["abs_rel"]
    assert frame.loc["lattice", ["native_abs_rel_low", "native_abs_rel_high"]].tolist() == [low, high]
    assert math.isnan(frame.loc["pier", "native_abs_rel_low"]), "two views have no interval"
    assert sum(name.endswith("_low") for name in frame) == len(METRIC_COLUMNS)


def test_views_have_one_row_each_and_other_rows_are_refused(two_configs: Result) -> None:
    frame = two_configs.to_pandas("views")
    assert frame["view_id"].tolist() == [view.view_id for view in two_configs.views]
    assert frame.groupby("config")["native_abs_rel"].count().to_dict() == {"lattice": 12, "pier": 1}
    assert frame["scored_px"].dtype == np.int64
    with pytest.raises(ValueError, match="rows is 'poles', expected 'tables', 'groups', 'views'"):
        two_configs.to_pandas("poles")  # type: ignore[arg-type]


def test_integers_with_missing_values_stay_integers() -> None:
    sheet = Sheet(("count", "text"), [(3, "a"), (None, None)])
    assert isinstance(sheet.to_pandas()["count"].dtype, pd.Int64Dtype)
    assert sheet.to_csv() == "count,text\n3,a\n,\n"


def test_csv_without_rows_has_the_header(two_configs: Result) -> None:
    extended = ExtendedResult(measures={}, tables={}, views={})
    empty = replace(two_configs, tables={}, frames={}, extended=extended)
    assert tables_sheet([empty]).to_csv() == tables_sheet([two_configs]).to_csv().splitlines(keepends=True)[0]
    compared = differences_sheet([compare(two_configs, two_configs).to_dict()]).to_csv()
    assert differences_sheet([]).to_csv() == compared.splitlines(keepends=True)[0]
    assert extended_csv(empty) == (
        "method,config,alignment,measure,unit,statistic,value,low,high,samples,"
        "protocol,dataset_digest,submission_sha256,software_version\n"
    )


def test_bars_of_a_dataset_folder(tiny_root: Path, tmp_path: Path) -> None:
    root = copy_dataset(tiny_root, tmp_path / "dataset")
    path = root / "bars.parquet"
    bars = list(read_bars(path)["lattice"])
    bars[0] = replace(bars[0], nominal_axis_m=((0.0, 0.0, 0.5), (1.0, 0.0, 0.5)))
    bars[1] = Bar.without_axis(bars[1].bar_id, bars[1].role)
    write_bars(path, {"lattice": tuple(bars)})
    change_manifest(root, lambda manifest, _: manifest["files"].update({path.name: file_sha256(path)}))
    frame = rdb.bars(root)
    assert (len(frame), set(frame["scene"])) == (len(bars), {"lattice"})
    assert frame["bar_id"].tolist() == [bar.bar_id for bar in bars]
    assert set(frame) == {*pq.read_schema(path).names, "length_m"}
    first = frame.iloc[0]
    assert np.array_equal(first["axis"], np.array(bars[0].axis_m))
    assert np.array_equal(first["nominal_axis"], np.array(bars[0].nominal_axis_m))
    assert set(frame["nominal_axis"][1:]) == {None}
    assert frame.iloc[1]["axis"] is None
    assert frame.iloc[1][["diameter_m", "length_m"]].isna().all()
    assert first["length_m"] == pytest.approx(float(np.linalg.norm(np.diff(first["axis"], axis=0), axis=1).sum()))


def test_repr_fits_a_screen() -> None:
    shown = repr(result(*(scored_view(f"config-{config}/0000") for config in range(30)), method="a\nb"))
    assert len(shown.splitlines()) <= 12
    assert max(map(len, shown.splitlines())) <= 100
    assert "30 configs, 30 views" in shown
    assert "a\N{REPLACEMENT CHARACTER}b" in shown
    assert "... and 20 more" in shown


def test_notebook_shows_escaped_table(two_configs: Result) -> None:
    html = result(*two_configs.views, method=HOSTILE)._repr_html_()
    page = Page(html)
    assert page.count("tr") == 3
    assert {tag for tag, _ in page.tags} <= {"p", "b", "table", "thead", "tbody", "tr", "th", "td"}
