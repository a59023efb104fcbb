"""Results and bars as pandas data frames, and how a notebook shows a result."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

import rebar_depth_bench as rdb
from rebar_depth_bench.data.bars import read_bars, write_bars
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.extended.result import ExtendedResult
from rebar_depth_bench.reporting.extended_tables import extended_csv
from rebar_depth_bench.scoring.columns import TABLE_COLUMNS, VIEW_COLUMNS
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.frames import differences_frame, frame_csv, frame_of_values
from rebar_depth_bench.scoring.result import Result, read_result
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, result, scored_view, unpredicted_view


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
    assert sum(name.endswith("_low") for name in frame) == len(VIEW_COLUMNS)


def test_numbers_of_tables_of_earlier_versions_stay_in_their_columns(two_configs: Result) -> None:
    table = two_configs.to_dict()["tables"]["lattice"]
    earlier = {**table, "reference": {"constant": table["reference"]["constant"]}}
    numbers = {column.name: column.value(earlier) for column in TABLE_COLUMNS}
    assert (numbers["constant_abs_rel"], numbers["scaled_constant_abs_rel"]) == (0.0571, None)
    assert {column.name: column.value(table) for column in TABLE_COLUMNS}["scaled_constant_abs_rel"] == 0.0571


def test_views_have_one_row_each(two_configs: Result) -> None:
    frame = two_configs.to_pandas("views")
    assert frame["view_id"].tolist() == [view.view_id for view in two_configs.views]
    assert frame.groupby("config")["native_abs_rel"].count().to_dict() == {"lattice": 12, "pier": 1}
    assert frame["scored_px"].dtype == np.int64


def test_unknown_or_missing_rows_raise_value_error(two_configs: Result) -> None:
    for rows in ("bars", "extended"):
        with pytest.raises(ValueError, match="expected 'tables', 'groups', 'views'"):
            two_configs.to_pandas(rows)  # type: ignore[arg-type]


def test_comparison_has_one_row_per_metric(two_configs: Result) -> None:
    comparison = compare(two_configs, two_configs)
    frame = comparison.to_pandas()
    assert frame["number"].tolist() == 2 * [column.path for column in VIEW_COLUMNS]
    assert set(frame["verdict"]) <= {"equal", "no verdict", "undecided", ""}


def test_integers_with_missing_values_stay_integers() -> None:
    frame = frame_of_values(("count", "text"), [(3, "a"), (None, None)])
    assert isinstance(frame["count"].dtype, pd.Int64Dtype)
    assert frame_csv(frame) == "count,text\n3,a\n,\n"
    assert frame_csv(frame_of_values((), [])) == ""


def test_csv_without_rows_has_the_header(two_configs: Result) -> None:
    extended = ExtendedResult(measures={}, tables={}, views={})
    empty = dataclasses.replace(two_configs, tables={}, views=[], extended=extended)
    assert frame_csv(empty.to_pandas()) == frame_csv(two_configs.to_pandas()).splitlines(keepends=True)[0]
    compared = frame_csv(compare(two_configs, two_configs).to_pandas())
    assert frame_csv(differences_frame([])) == compared.splitlines(keepends=True)[0]
    assert extended_csv(empty) == (
        "method,config,alignment,measure,unit,statistic,value,low,high,samples,"
        "protocol,dataset_digest,submission_sha256,software_version\n"
    )


def test_bars_of_a_dataset_folder(tiny_root: Path, tmp_path: Path) -> None:
    root = shutil.copytree(tiny_root, tmp_path / "dataset")
    path, manifest = root / "bars.parquet", root / "manifest.json"
    before, bars = file_sha256(path), list(read_bars(path)["lattice"])
    bars[0] = dataclasses.replace(bars[0], nominal_axis_m=((0.0, 0.0, 0.5), (1.0, 0.0, 0.5)))
    write_bars(path, {"lattice": tuple(bars)})
    manifest.write_text(manifest.read_text().replace(before, file_sha256(path)))
    frame = rdb.bars(root)
    assert (len(frame), set(frame["scene"])) == (len(bars), {"lattice"})
    assert frame["bar_id"].tolist() == [bar.bar_id for bar in bars]
    assert set(frame) == {*pq.read_schema(path).names, "length_m"}
    first = frame.iloc[0]
    assert np.array_equal(first["axis"], np.array(bars[0].axis_m))
    assert np.array_equal(first["nominal_axis"], np.array(bars[0].nominal_axis_m))
    assert {axis.shape for axis in frame["nominal_axis"][1:]} == {(0, 3)}
    assert first["length_m"] == pytest.approx(float(np.linalg.norm(np.diff(first["axis"], axis=0), axis=1).sum()))


def test_columns_do_not_depend_on_the_order_of_a_document(two_configs: Result) -> None:
    turned = read_result(json.dumps(_reversed(two_configs.to_dict())).encode(), "x")
    assert turned.to_pandas().iloc[::-1].to_csv(index=False) == two_configs.to_pandas().to_csv(index=False)
    assert turned.to_pandas("views").to_csv() == two_configs.to_pandas("views").to_csv()


def _reversed(value: Any) -> Any:
    """Return a document with the keys of all objects in reverse order."""
    if isinstance(value, dict):
        return {key: _reversed(item) for key, item in reversed(value.items())}
    return [_reversed(item) for item in value] if isinstance(value, list) else value


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
