"""What the tables say: numbers to sort by, intervals, the paper's rows."""

from __future__ import annotations

import dataclasses
import math
import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.scatter import ScatterPoint, label_places, scatter_chart
from rebar_depth_bench.reporting.charts.score_charts import alignment_chart
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.html.published import paper_scenes
from rebar_depth_bench.reporting.html.rows import table_row, view_row
from rebar_depth_bench.reporting.html.view_browser import views_to_show
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.results import HOSTILE, overflowed, result, scored, unpredicted


def _with_intervals(shown: Result, **intervals: tuple[float, float] | None) -> Result:
    found = {name.replace("__", "."): ends for name, ends in intervals.items()}
    tables = {name: dataclasses.replace(table, intervals=found) for name, table in shown.tables.items()}
    return dataclasses.replace(shown, tables=tables)


def test_cells_sort_by_full_precision_and_undefined_ones_by_nothing() -> None:
    row = view_row(scored("lattice/0000", abs_rel=0.123456789))
    assert (row.native[0].text, row.native[0].value) == ("0.1235", 0.123456789)
    assert row.views.value == 43210
    empty = view_row(unpredicted("lattice/0000"))
    assert [cell.value for cell in (*empty.native, *empty.scaled, empty.scale)] == [None] * 9
    assert view_row(overflowed("pier/0000")).native[1].value is None, "infinite"
    page = render_report(result(overflowed("pier/0000"), scored("pier/0001", abs_rel=0.123456789)), [])
    assert '<td class="first" data-value="0.123456789">0.1235</td>' in page
    assert "<td>–</td>" in page
    assert 'data-value="inf"' not in page


def test_intervals_stand_below_their_numbers_with_as_many_decimals() -> None:
    views = [scored("lattice/0000")]
    ends = {"native__abs_rel": (0.70123, 0.79987), "scaled__delta1": (0.9, 1.0), "coverage": (0.94999, 1.0)}
    more = {"within_mm__3": (0.01, 0.02), "scale_median": (0.6, 0.7), "native__rmse_cm": None}
    shown = _with_intervals(result(*views), **ends, **more)
    row = table_row("lattice", shown.tables["lattice"])
    assert row.native[0].interval == "0.7012 – 0.7999"
    assert row.native[1].interval == "", "none"
    assert row.scaled[3].interval == "0.900 – 1.000"
    assert row.coverage.interval == "94.9 – 100.0", "rounded down as coverage is"
    assert row.within[0].interval == "1.0 – 2.0"
    assert row.scale.interval == "0.600 – 0.700"
    page = render_report(shown, [])
    assert '0.7500<span class="interval">0.7012 – 0.7999</span>' in page
    assert formatting.INTERVAL_NOTE in page
    assert "block bootstrap over views" in page
    assert formatting.INTERVAL_NOTE not in render_report(_with_intervals(result(*views)), [])


def test_intervals_that_overflowed_are_left_out() -> None:
    assert formatting.interval_cell((0.1, math.inf), 4) == ""
    assert formatting.interval_cell((math.nan, 1.0), 4) == ""
    assert formatting.coverage_interval_cell(None) == ""


def test_charts_draw_intervals_as_bars() -> None:
    plain = result(scored("lattice/0000"))
    shown = _with_intervals(plain, native__abs_rel=(0.7, 0.8), scaled__abs_rel=(0.06, 0.07))
    assert alignment_chart(shown.tables).count("interval") == 2
    assert "interval" not in alignment_chart(_with_intervals(plain).tables)
    assert paper_scenes(shown)[0].chart.count('class="bars"') == 2


def test_the_papers_rows_stand_beside_own_ones_marked_and_unsorted() -> None:
    shown = result(scored("pier/0000"), scored("lattice/0000"), scored("lattice-zed/0000"), scored("beam/0000"))
    scenes = paper_scenes(shown)
    assert [(scene.heading, scene.distance) for scene in scenes] == [
        ("Lattice", "0.22–0.43 m"),
        ("Pier", "8–17 m"),
    ]
    lattice = scenes[0].rows
    assert [(row.mark, row.name, row.published) for row in lattice[:2]] == [
        ("A", "lattice", False),
        ("1", "FoundationStereo", True),
    ]
    assert [cell.text for cell in lattice[4].cells] == ["91.19", "3.145", "0.029", "0.25"]
    assert [cell.text for cell in lattice[0].cells] == ["20.09", "0.7500", "0.0613", "0.625"]
    assert [row.name for row in scenes[1].rows if row.dagger] == ["COLMAP+ArUco"]
    page = render_report(shown, [])
    part = page[
        page.index('<section aria-labelledby="paper">') : page.index('<section aria-labelledby="by-view">')
    ]
    assert part.count('<tr class="published">') == 12
    assert "sortable" not in part, "sorting would rank them"
    assert "measured on the authors&#39; renders, which are not the renders of this dataset" in part
    assert "206.7<sup>†</sup>" in part
    assert ">1143<" in part
    assert 'id="paper"' not in render_report(result(scored("beam/0000")), [])


def test_a_config_without_values_keeps_its_row_and_loses_its_point() -> None:
    scene = paper_scenes(result(unpredicted("pile/0000")))[0]
    assert [cell.text for cell in scene.rows[0].cells] == ["–"] * 4
    assert scene.chart.count("<circle") == 6
    assert 'class="native fill"' not in scene.chart


def test_scatter_places_points_on_log_axes_and_says_them_in_words() -> None:
    points = [
        ScatterPoint("1", "published one", 0.01, 0.01, published=True),
        ScatterPoint("A", HOSTILE, 1.0, 0.1, published=False, native_interval=(0.9, 1.1)),
    ]
    chart = scatter_chart("title", points)
    hollow = re.search(r'<circle class="published ring" cx="([\d.]+)" cy="([\d.]+)"', chart)
    solid = re.search(r'<circle class="native fill" cx="([\d.]+)" cy="([\d.]+)"', chart)
    assert hollow
    assert solid
    assert float(solid[1]) > float(hollow[1]), "larger native error to the right"
    assert float(solid[2]) < float(hollow[2]), "larger scaled error above"
    bar = re.search(r'class="bars" d="M([\d.]+) [\d.]+H([\d.]+)"', chart)
    assert bar
    assert float(bar[1]) < float(solid[1]) < float(bar[2])
    assert "1: published one, published, native 0.0100, scaled 0.0100; A: =" in chart
    assert "<script" not in chart


_PIXELS = st.tuples(st.floats(60, 440), st.floats(20, 280))


@given(st.lists(_PIXELS, max_size=5))
def test_labels_of_a_few_points_meet_no_point_and_no_label(places: list[tuple[float, float]]) -> None:
    labels = label_places(places)
    for index, label in enumerate(labels):
        for other in [*places, *labels[:index], *labels[index + 1 :]]:
            assert abs(label[0] - other[0]) >= 9 or abs(label[1] - other[1]) >= 9


def test_the_worst_half_is_shown_then_evenly_to_the_best() -> None:
    views = [scored(f"lattice/{index:04d}", abs_rel=(index + 1) / 100) for index in range(100)]
    views[50] = unpredicted("lattice/0050")
    shown = [int(view.view_id[-4:]) for view in views_to_show(views, 12)]
    assert shown[:6] == [50, 99, 98, 97, 96, 95]
    assert shown[-1] == 0, "the best"
    gaps = [first - second for first, second in pairwise(shown[6:])]
    assert all(15 <= gap <= 17 for gap in gaps)


@given(st.integers(0, 40), st.integers(0, 40))
def test_as_many_views_as_asked_for_are_shown_each_once(count: int, total: int) -> None:
    views = [scored(f"lattice/{index:04d}", abs_rel=(index * 7 % 41 + 1) / 100) for index in range(total)]
    shown = views_to_show(views, count)
    assert len({view.view_id for view in shown}) == len(shown) == min(count, total)
    errors = [view.native.abs_rel for view in shown if view.native]
    assert errors == sorted(errors, reverse=True)
    if 1 < count <= total:
        assert errors[-1] == min(view.native.abs_rel for view in views if view.native)


def test_a_negative_number_of_views_is_refused() -> None:
    with pytest.raises(InputError, match="views to show: -1, expected 0 or more"):
        views_to_show([], -1)


def test_templates_and_scripts_come_with_the_package() -> None:
    shipped = {path.suffix for path in Path("rebar_depth_bench/report").iterdir()} - {".py", ""}
    declared = Path("pyproject.toml").read_text(encoding="utf-8").split("[tool.setuptools.package-data]")[1]
    assert all(f'"*{suffix}"' in declared.splitlines()[1] for suffix in shipped)
