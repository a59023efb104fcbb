"""Page of a detector of crossings: completeness, escaping, self-containment and mark positions."""

from __future__ import annotations

import re

from rebar_depth_bench.reporting.axes import Axis
from rebar_depth_bench.reporting.charts import precision_chart
from rebar_depth_bench.reporting.detections import DetectionPage, PageTable, render_page
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE


def detection_page(text: str = "plain") -> DetectionPage:
    chart = precision_chart(text, text, {text: [(0.0, 1.0), (0.5, 0.5)], "b": []})
    return DetectionPage(
        title=f"{text}: one scale for all",
        lead=f"lead {text}",
        stamps=[("Protocol", "rebar-2"), (f"Archive of {text}", "sha256:12")],
        figures=[(chart, f"Figure {text}", f"caption {text}")],
        tables=[PageTable(f"table {text}", [("k", "views"), (text, "")], [["1", text], ["2", "−0.5"]])],
        notes=[f"note {text}"],
    )


def test_page_shows_all_content() -> None:
    page = Page(render_page(detection_page()))
    for stated in ("plain: one scale for all", "lead plain", "rebar-2", "sha256:12", "Figure plain", "note plain"):
        assert stated in page.text
    assert (page.count("h1"), page.count("svg"), page.count("table"), page.count("td")) == (1, 1, 1, 2)


def test_hostile_text_is_escaped() -> None:
    rendered = render_page(detection_page(HOSTILE))
    hostile, plain = Page(rendered), Page(render_page(detection_page()))
    assert [tag for tag, _ in hostile.tags] == [tag for tag, _ in plain.tags]
    assert "<script" not in rendered
    assert hostile.text.count("<script") >= 10


def test_page_is_self_contained_without_scripts() -> None:
    rendered = render_page(detection_page())
    page = Page(rendered)
    assert not re.search(r"https?://|<script|<link|<iframe|@import|url\(|javascript:", rendered)
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    assert "default-src 'none'" in rendered
    assert "prefers-color-scheme: dark" in rendered
    assert rendered == render_page(detection_page())


def test_marks_are_placed_at_their_values() -> None:
    svg = precision_chart("Title", "Described", {"s": [(0.5, 0.5), (1.0, 1.0)]})
    assert '<path class="line c0" d="M255.0 130.0L446.0 30.0"/>' in svg
    assert svg.count("<circle") == 3, "a marker each, and one in the legend"


def test_ticks_of_a_linear_axis_are_round() -> None:
    assert Axis(-1.0, 1.0, 0.0, 1.0, linear=True).ticks() == [-1.0, -0.5, 0.0, 0.5, 1.0]
