"""Pages of tables and line charts: completeness, escaping, self-containment and mark positions."""

from __future__ import annotations

import math
import re

import pytest
from markupsafe import Markup

from rebar_depth_bench.reporting.charts.axes import LogAxis
from rebar_depth_bench.reporting.charts.lines import HEIGHT, LEFT, RIGHT, TOP, ChartText, LinearAxis, Series, chart
from rebar_depth_bench.reporting.table_page import PageFigure, PageTable, TablePage, render_page
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE

CHART_TEXT = ChartText("Title", "Described", "x of it", "y of it")
X_AXIS, Y_AXIS = LogAxis(1.0, 100.0, LEFT, RIGHT), LinearAxis(-1.0, 1.0, HEIGHT, TOP)


def table_page(text: str = "plain") -> TablePage:
    series = [Series(text, 0, line=[(1, 0.0), (10, 0.5)]), Series("b", 1)]
    chart_text = ChartText(text, text, text, text)
    return TablePage(
        subject="crossings",
        title=f"{text}: one scale for all",
        lead=f"lead {text}",
        stamps=[("Protocol", "rebar-2"), (f"Archive of {text}", "sha256:12")],
        figures=[PageFigure(chart(series, X_AXIS, Y_AXIS, chart_text), f"Figure {text}", f"caption {text}")],
        tables=[PageTable(f"table {text}", [("k", "views"), (text, "")], [["1", text], ["2", "−0.5"]])],
        notes=[f"note {text}"],
    )


def test_page_shows_all_content() -> None:
    page = Page(render_page(table_page()))
    for stated in ("plain: one scale for all", "lead plain", "rebar-2", "sha256:12", "Figure plain", "note plain"):
        assert stated in page.text
    assert (page.count("h1"), page.count("svg"), page.count("table"), page.count("td")) == (1, 1, 1, 2)


def test_hostile_text_is_escaped() -> None:
    rendered = render_page(table_page(HOSTILE))
    hostile, plain = Page(rendered), Page(render_page(table_page()))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert "<script" not in rendered
    assert hostile.text.count("<script") >= 10


def test_page_is_self_contained_without_scripts() -> None:
    rendered = render_page(table_page())
    page = Page(rendered)
    assert not re.search(r"https?://|<script|<link|<iframe|@import|url\(|javascript:", rendered)
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert "default-src 'none'" in rendered
    assert "prefers-color-scheme: dark" in rendered
    assert rendered == render_page(table_page())


def test_table_row_with_missing_cell_raises() -> None:
    with pytest.raises(ValueError, match="table 't': a row has 1 cells, expected 2"):
        PageTable("t", [("a", ""), ("b", "")], [["1", "2"], ["1"]])


def test_marks_are_placed_at_their_values() -> None:
    svg = chart([Series("s", 2, line=[(10, 0.0), (100, 1.0)])], X_AXIS, Y_AXIS, CHART_TEXT)
    middle, level = (LEFT + RIGHT) / 2, (TOP + HEIGHT) / 2
    assert f'<path class="line c2" d="M{middle:.1f} {level:.1f}L{RIGHT:.1f} {TOP:.1f}"/>' in svg
    assert svg.count("<circle") == 2, "a marker each; one name needs no legend"


def test_two_names_need_legend() -> None:
    both = [Series("near", 0, line=[(1, 0.0)]), Series("near", 0, line=[(1, 0.5)])]
    assert ">near<" not in chart(both, X_AXIS, Y_AXIS, CHART_TEXT)
    with_legend = chart([*both, Series("far", 8)], X_AXIS, Y_AXIS, CHART_TEXT)
    assert with_legend.count(">near<") == with_legend.count(">far<") == 1
    assert 'class="disc c1"' in with_legend, "colours start again after the seventh"


def test_non_finite_values_are_not_drawn() -> None:
    nan = math.nan
    svg = chart([Series("s", 0, [(1, nan), (10, math.inf)])], X_AXIS, Y_AXIS, CHART_TEXT)
    assert isinstance(svg, Markup)
    assert "nan" not in svg
    assert "inf" not in svg
    assert "c0" not in svg


def test_ticks_of_a_linear_axis_are_round() -> None:
    assert Y_AXIS.ticks() == [-1.0, -0.5, 0.0, 0.5, 1.0]
