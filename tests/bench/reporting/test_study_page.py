"""Page and line charts of studies: completeness, escaping, self-containment and mark positions."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import Markup

from rebar_depth_bench.reporting.charts.axes import LogAxis
from rebar_depth_bench.reporting.charts.lines import (
    HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    ChartText,
    LinearAxis,
    Series,
    chart,
    linear_axis,
    log_axis,
)
from rebar_depth_bench.reporting.html.study_page import PageFigure, PageTable, StudyPage, render_study
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE

CHART_TEXT = ChartText("Title", "Described", "x of it", "y of it")
X_AXIS, Y_AXIS = LogAxis(1.0, 100.0, LEFT, RIGHT), LinearAxis(-1.0, 1.0, HEIGHT, TOP)


def study_page(text: str = "plain") -> StudyPage:
    series = [Series(text, 0, line=[(1, 0.0), (10, 0.5)], area=[(1, -0.5, 0.5), (10, 0.0, 1.0)]), Series("b", 1)]
    chart_text = ChartText(text, text, text, text)
    return StudyPage(
        study="anchor",
        title=f"{text}: one scale for all",
        lead=f"lead {text}",
        stamps=[("Protocol", "rebar-2"), (f"Archive of {text}", "sha256:12")],
        figures=[PageFigure(chart(series, X_AXIS, Y_AXIS, chart_text), f"Figure {text}", f"caption {text}")],
        tables=[PageTable(f"table {text}", [("k", "views"), (text, "")], [["1", text], ["2", "−0.5"]])],
        notes=[f"note {text}"],
    )


def test_page_shows_all_content() -> None:
    page = Page(render_study(study_page()))
    for stated in ("plain: one scale for all", "lead plain", "rebar-2", "sha256:12", "Figure plain", "note plain"):
        assert stated in page.text
    assert (page.count("h1"), page.count("svg"), page.count("table"), page.count("td")) == (1, 1, 1, 2)


def test_hostile_text_is_escaped() -> None:
    rendered = render_study(study_page(HOSTILE))
    hostile, plain = Page(rendered), Page(render_study(study_page()))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert "<script" not in rendered
    assert hostile.text.count("<script") >= 10


def test_page_is_self_contained_without_scripts() -> None:
    rendered = render_study(study_page())
    page = Page(rendered)
    assert not re.search(r"https?://|<script|<link|<iframe|@import|url\(|javascript:", rendered)
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert "default-src 'none'" in rendered
    assert "prefers-color-scheme: dark" in rendered
    assert rendered == render_study(study_page())


def test_table_row_with_missing_cell_raises() -> None:
    with pytest.raises(ValueError, match="table 't': a row has 1 cells, expected 2"):
        PageTable("t", [("a", ""), ("b", "")], [["1", "2"], ["1"]])


def test_marks_are_placed_at_their_values() -> None:
    series = Series(
        "s", 2, cloud=[(1, -1.0)], line=[(10, 0.0), (100, 1.0)], bars=[(10, -1.0, 1.0)], area=[(1, -1.0, 1.0)]
    )
    svg = chart([series], X_AXIS, Y_AXIS, CHART_TEXT, reference=0.0)
    middle, level = (LEFT + RIGHT) / 2, (TOP + HEIGHT) / 2
    assert f'<path class="cloud c2" d="M{LEFT:.1f} {HEIGHT:.1f}h0"/>' in svg
    assert f'<path class="line c2" d="M{middle:.1f} {level:.1f}L{RIGHT:.1f} {TOP:.1f}"/>' in svg
    assert f'<path class="bars c2" d="M{middle:.1f} {HEIGHT:.1f}V{TOP:.1f}"/>' in svg
    assert f'<path class="area c2" d="M{LEFT:.1f} {TOP:.1f}L{LEFT:.1f} {HEIGHT:.1f}Z"/>' in svg
    assert f'<path class="one" d="M{LEFT:g} {level:.1f}H{RIGHT:g}"/>' in svg
    assert svg.count("<circle") == 2, "a marker each; one name needs no legend"


def test_hollow_series_are_dashed_and_two_names_need_legend() -> None:
    both = [Series("near", 0, line=[(1, 0.0)]), Series("near", 0, line=[(1, 0.5)], hollow=True)]
    svg = chart(both, X_AXIS, Y_AXIS, CHART_TEXT)
    assert svg.count("hollow") == 1
    assert svg.count("dashed") == 1
    assert ">near<" not in svg
    with_legend = chart([*both, Series("far", 8)], X_AXIS, Y_AXIS, CHART_TEXT)
    assert with_legend.count(">near<") == with_legend.count(">far<") == 1
    assert 'class="disc c1"' in with_legend, "colours start again after the seventh"


def test_non_finite_values_are_not_drawn() -> None:
    nan = math.nan
    series = Series("s", 0, [(1, nan)], [(1, nan), (10, math.inf)], [(1, nan, 0.0)], [(1, 0.0, nan)])
    svg = chart([series], X_AXIS, Y_AXIS, CHART_TEXT)
    assert isinstance(svg, Markup)
    assert "nan" not in svg
    assert "inf" not in svg
    assert "c0" not in svg


@given(st.lists(st.floats(-1e9, 1e9, allow_subnormal=False), max_size=6))
def test_linear_axis_covers_zero_and_all_values(values: list[float]) -> None:
    axis = linear_axis(values, HEIGHT, TOP)
    ticks = axis.ticks()
    assert 0.0 in ticks
    assert 2 <= len(ticks) <= 8
    for value in (0.0, *values):
        assert axis.low < value < axis.high
        assert TOP <= axis.at(value) <= HEIGHT


@pytest.mark.parametrize("values", [[], [0.0, math.inf], [1.0], [1e-300, 1e300], [0.22, 0.22]])
def test_log_axis_accepts_any_values(values: list[float]) -> None:
    axis = log_axis(values, 0.0, 1.0)
    assert 0 < axis.low < axis.high
    assert axis.ticks()
