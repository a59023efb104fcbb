"""Tables of the HTML report: sort values, intervals, published rows, scatter charts and view selection."""

from __future__ import annotations

import dataclasses
import math
import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts import ScatterPoint, alignment_chart, place_labels, scatter_chart
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.html.views import views_to_show
from rebar_depth_bench.reporting.published import paper_scenes
from rebar_depth_bench.scoring.columns import COVERAGE, NATIVE, RANK_ERROR, SCALE, SCALED, WITHIN, Cell
from rebar_depth_bench.scoring.reference import Errors
from rebar_depth_bench.scoring.result import Result
from tests.bench.reporting.results import (
    HOSTILE,
    REFERENCE,
    overflowed_view,
    result,
    scored_view,
    unpredicted_view,
)


def _with_intervals(shown: Result, **intervals: tuple[float, float] | None) -> Result:
    intervals_by_metric = {name.replace("__", "."): ends for name, ends in intervals.items()}
    tables = {
        name: dataclasses.replace(table, intervals=intervals_by_metric) for name, table in shown.tables.items()
    }
    return dataclasses.replace(shown, tables=tables)


def test_constants_of_results_on_other_pixels_are_named() -> None:
    """The constants of two results without some pixels look alike and share a row."""
    named = {"a": 1.0, "b": 0.9, "c\x1b": 0.8, "d": 1.0}
    tables = {name: result(scored_view("lattice/0000", coverage=share)) for name, share in named.items()}
    rows = [(name, one.tables["lattice"]) for name, one in tables.items()]
    assert formatting.scaled_constants(rows) == {
        "constant": (0.0571, 2.21),
        "constant, b, c\N{REPLACEMENT CHARACTER}": (0.0529, 2.05),
    }
    assert formatting.scaled_constants(rows[1:3]) == {"constant": (0.0529, 2.05)}
    titles = [title for title, _ in formatting.reference_rows(rows)]
    assert titles == [*formatting.scaled_constants(rows), "one pixel"]
    without = dataclasses.replace(rows[0][1], reference=REFERENCE)
    assert formatting.reference_rows([("x", without)])[0][0] == "one pixel"


def test_scaled_error_is_compared_with_the_constant_on_the_same_pixels() -> None:
    table = result(scored_view("lattice/0000", coverage=0.9)).tables["lattice"]
    assert any("above that of a constant (0.0529)" in finding for finding in formatting.reference_findings(table))
    reference = dataclasses.replace(REFERENCE, scaled_constant=Errors(0.07, 2.6))
    between = dataclasses.replace(table, reference=reference)
    assert not any("constant" in finding for finding in formatting.reference_findings(between))


def test_cells_sort_by_full_precision_and_skip_undefined() -> None:
    assert NATIVE[0].cell(scored_view("lattice/0000", abs_rel=0.123456789)) == Cell("0.1235", 0.123456789)
    empty = unpredicted_view("lattice/0000")
    assert {column.cell(empty) for column in (*NATIVE, *SCALED, SCALE)} == {Cell("–")}
    assert NATIVE[1].cell(overflowed_view("pier/0000")) == Cell("–"), "infinite"
    page = render_report(result(overflowed_view("pier/0000"), scored_view("pier/0001", abs_rel=0.123456789)), [])
    assert '<td class="first" data-value="0.123456789">0.1235</td>' in page
    assert "<td>–</td>" in page
    assert '<td class="first" data-value="43210">43\N{NARROW NO-BREAK SPACE}210</td>' in page
    assert 'data-value="inf"' not in page


def test_intervals_use_decimals_of_their_numbers() -> None:
    views = [scored_view("lattice/0000")]
    ends = {"native__abs_rel": (0.70123, 0.79987), "scaled__delta1": (0.9, 1.0), "coverage": (0.94999, 1.0)}
    more = {"within_mm__3": (0.01, 0.02), "scale_median": (0.6, 0.7), "native__rmse_cm": None}
    shown = _with_intervals(result(*views), **ends, **more)
    columns = (NATIVE[0], NATIVE[1], SCALED[3], COVERAGE, WITHIN[0], SCALE)
    assert [column.cell(shown.tables["lattice"]).interval for column in columns] == [
        "0.7012 – 0.7999",
        "",
        "0.900 – 1.000",
        "94.9 – 100.0",  # Rounded down as coverage is.
        "1.0 – 2.0",
        "0.600 – 0.700",
    ]
    page = render_report(shown, [])
    assert '0.7500<span class="interval">0.7012 – 0.7999</span>' in page
    assert formatting.INTERVAL_NOTE in page
    assert "block bootstrap over views" in page
    assert formatting.INTERVAL_NOTE not in render_report(_with_intervals(result(*views)), [])


def test_overflowed_intervals_are_omitted() -> None:
    assert RANK_ERROR.interval_text((0.1, math.inf)) == ""
    assert RANK_ERROR.interval_text((math.nan, 1.0)) == ""
    assert COVERAGE.interval_text(None) == ""


def test_charts_draw_intervals_as_bars() -> None:
    plain = result(scored_view("lattice/0000"))
    shown = _with_intervals(plain, native__abs_rel=(0.7, 0.8), scaled__abs_rel=(0.06, 0.07))
    assert alignment_chart(shown.tables).count("interval") == 2
    assert "interval" not in alignment_chart(_with_intervals(plain).tables)
    [bars] = re.findall(r'class="bars" d="(.*?)"', paper_scenes(shown)[0].chart)
    assert (bars.count("H"), bars.count("V")) == (1, 1)


def test_published_rows_are_marked_and_not_sortable() -> None:
    shown = result(
        scored_view("pier/0000"),
        scored_view("lattice/0000"),
        scored_view("lattice-zed/0000"),
        scored_view("beam/0000"),
    )
    scenes = paper_scenes(shown)
    assert [(scene.heading, scene.distance) for scene in scenes] == [
        ("Lattice", "0.22–0.43 m"),
        ("Pier", "8–17 m"),
    ]
    lattice = scenes[0].rows
    assert [(row.mark, row.name, row.published) for row in lattice[:2]] == [
        ("1", "lattice", False),
        ("A", "FoundationStereo", True),
    ]
    assert [cell.text for cell in lattice[4].cells] == ["91.19", "3.145", "0.029", "0.25"]
    assert [cell.text for cell in lattice[0].cells] == ["20.09", "0.7500", "0.0613", "0.625"]
    assert [row.name for row in scenes[1].rows if row.dagger] == ["COLMAP+ArUco"]
    page = render_report(shown, [])
    section = page[
        page.index('<section aria-labelledby="paper">') : page.index('<section aria-labelledby="by-view">')
    ]
    assert section.count('<tr class="published">') == 12
    assert "sortable" not in section, "sorting would rank them"
    assert "measured on the authors&#39; renders, which are not the renders of this dataset" in section
    assert "206.7<sup>†</sup>" in section
    assert ">1143<" in section
    assert 'id="paper"' not in render_report(result(scored_view("beam/0000")), [])


def test_config_without_values_has_row_but_no_point() -> None:
    scene = paper_scenes(result(unpredicted_view("pile/0000")))[0]
    assert [cell.text for cell in scene.rows[0].cells] == ["–"] * 4
    assert scene.chart.count("<circle") == 6
    assert 'class="native fill"' not in scene.chart


def test_scatter_chart_positions_and_describes_points() -> None:
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


@given(st.lists(_PIXELS, max_size=30))
def test_scatter_labels_touch_their_points_and_do_not_overlap(places: list[tuple[float, float]]) -> None:
    labels = place_labels(places)
    assert len(labels) == len(places)
    shown = [label for label in labels if label is not None]
    for place, label in zip(places, labels, strict=True):
        assert label is None or max(abs(label[0] - place[0]), abs(label[1] - place[1])) < 15
    for index, label in enumerate(shown):
        for other in [*places, *shown[:index], *shown[index + 1 :]]:
            assert abs(label[0] - other[0]) >= 9 or abs(label[1] - other[1]) >= 9


def test_lonely_scatter_point_has_a_label() -> None:
    assert place_labels([(200, 150)]) == [(214, 150)]


def test_views_to_show_takes_worst_half_then_even_steps() -> None:
    views = [scored_view(f"lattice/{index:04d}", abs_rel=(index + 1) / 100) for index in range(100)]
    views[50] = unpredicted_view("lattice/0050")
    shown = [int(view.view_id[-4:]) for view in views_to_show(views, 12)]
    assert shown[:6] == [50, 99, 98, 97, 96, 95]
    assert shown[-1] == 0, "the best"
    gaps = [first - second for first, second in pairwise(shown[6:])]
    assert all(15 <= gap <= 17 for gap in gaps)


@given(st.integers(0, 40), st.integers(0, 40))
def test_views_to_show_has_requested_count_and_no_repeats(count: int, total: int) -> None:
    views = [scored_view(f"lattice/{index:04d}", abs_rel=(index * 7 % 41 + 1) / 100) for index in range(total)]
    shown = views_to_show(views, count)
    assert len({view.view_id for view in shown}) == len(shown) == min(count, total)
    errors = [view.native.abs_rel for view in shown if view.native]
    assert errors == sorted(errors, reverse=True)
    if 1 < count <= total:
        assert errors[-1] == min(view.native.abs_rel for view in views if view.native)


def test_negative_view_count_raises() -> None:
    with pytest.raises(InputError, match="views to show: -1, expected 0 or more"):
        views_to_show([], -1)


def test_templates_and_scripts_are_package_data() -> None:
    shipped = {path.suffix for path in Path("rebar_depth_bench/reporting/html").iterdir()} - {".py", ""}
    declared = Path("pyproject.toml").read_text(encoding="utf-8").split("[tool.setuptools.package-data]")[1]
    assert all(f'"*{suffix}"' in declared.splitlines()[1] for suffix in shipped)
