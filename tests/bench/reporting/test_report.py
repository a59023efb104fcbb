"""HTML report and page of a detector: golden texts, structure, escaping, views shown, and reports of archives."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import math
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench import InputError, score
from rebar_depth_bench.data import codecs
from rebar_depth_bench.reporting.charts import precision_chart
from rebar_depth_bench.reporting.detections import DetectionPage, PageTable, render_page
from rebar_depth_bench.reporting.html.page import WORST_SHOWN, render_report
from rebar_depth_bench.reporting.html.views import views_to_show
from rebar_depth_bench.reporting.published import paper_scenes
from rebar_depth_bench.scoring.columns import COVERAGE, NATIVE, SCALE, SCALED, WITHIN, Cell
from tests.bench.reporting.pages import Page, without_embedded
from tests.bench.reporting.results import (
    HOSTILE,
    example,
    overflowed_view,
    result,
    scored_view,
    split_result,
    unpredicted_view,
)
from tests.bench.reporting.results import shown as images_of

REMOTE = r"https?://|<link|<iframe|@import|url\(|javascript:|fetch|import\(|XMLHttp|innerHTML"
"""Parts of a page that would load or run something from outside."""


@pytest.fixture(scope="module")
def rendered() -> str:
    """Return the report of the example with two views."""
    shown = example()
    return render_report(shown, [images_of(view.view_id, view) for view in (shown.views[0], shown.views[9])])


def detection_page(text: str = "plain") -> DetectionPage:
    """Return a page with a chart, a table and a note, which have ``text`` in all places."""
    chart = precision_chart(text, text, {text: [(0.0, 1.0), (0.5, 0.5)], "b": []})
    return DetectionPage(
        title=f"{text}: one scale for all",
        lead=f"lead {text}",
        stamps=[("Protocol", "rebar-2"), (f"Archive of {text}", "sha256:12")],
        figures=[(chart, f"Figure {text}", f"caption {text}")],
        tables=[PageTable(f"table {text}", [("k", "views"), (text, "")], [["1", text], ["2", "−0.5"]])],
        notes=[f"note {text}"],
    )


def test_pages_are_the_golden_texts(rendered: str, check_golden: Callable[[str, str], None]) -> None:
    check_golden("report.html", without_embedded(rendered))
    check_golden("detections.html", without_embedded(render_page(detection_page())))


@pytest.mark.parametrize(("scale", "differ"), [(1.01 / 1.02, False), (1.001 / 1.02, True)])
def test_captions_of_error_maps_state_that_their_ranges_differ(scale: float, differ: bool) -> None:
    score = scored_view("lattice/0000", scale=scale)
    page = render_report(result(score), [images_of("lattice/0000", score, 1.02)])
    captions = re.findall(r"<figcaption><strong>(?:Native|Scaled) error</strong>.*?</figcaption>", page, re.DOTALL)
    assert ["other colour range" in caption for caption in captions] == [differ, differ]
    assert (len(set(re.findall(r"−([\d.]+) cm", "".join(captions)))) == 2) == differ


def test_page_is_well_formed_with_alternative_texts(rendered: str) -> None:
    page = Page(rendered)
    assert page.count("h1") == 1
    assert page.attributes_of("html") == [{"lang": "en"}]
    assert page.count("svg") == page.count("desc")
    assert page.count("article") == 2
    assert page.count("img") == 2 * 5 + 4 + 3, "panels, and the colour bars of their scales"
    alts = [image["alt"] for image in page.attributes_of("img") if image["alt"]]
    assert len(alts) == len(set(alts)) == 2 * 5
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    hidden = [(name, attributes) for name, attributes in page.tags if "hidden" in attributes]
    assert hidden == [("div", {"class": "controls", "hidden": None})], "buttons that do nothing without script"


def test_page_is_self_contained_with_one_hashed_script(rendered: str) -> None:
    page = Page(rendered)
    assert not re.search(REMOTE, rendered)
    [script] = re.findall(r"<script[^>]*>(.*?)</script>", rendered, re.DOTALL)
    assert page.attributes_of("script") == [{}], "inline: no source"
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert all((image["src"] or "").startswith("data:image/") for image in page.attributes_of("img"))
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    policy = [meta for meta in page.attributes_of("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policy[0]["content"] == (
        f"default-src 'none'; script-src 'sha256-{digest}'; img-src data:; style-src 'unsafe-inline'"
    )


def test_page_of_a_detector_is_self_contained_and_escaped() -> None:
    rendered, hostile = render_page(detection_page()), render_page(detection_page(HOSTILE))
    plain, escaped = Page(rendered), Page(hostile)
    assert not re.search(rf"{REMOTE}|<script", rendered)
    assert not [name for _, attributes in plain.tags for name in attributes if name.startswith("on")]
    assert "prefers-color-scheme: dark" in rendered
    assert [tag for tag, _ in escaped.tags] == [tag for tag, _ in plain.tags]
    assert "<script" not in hostile
    assert escaped.text.count("<script") >= 10


def test_hostile_names_are_escaped() -> None:
    hostile = result(scored_view("<b>x/0000"), method=HOSTILE)
    rendered = render_report(hostile, [images_of("<b>x/0000")])
    page = Page(rendered)
    benign = Page(render_report(result(scored_view("beam/0000")), [images_of("beam/0000")]))
    assert page.count("script") == 1, "the page's own"
    assert page.count("b") == benign.count("b")
    assert "<b>x" not in rendered
    assert '=<script src="//evil.example/x.js">alert(1)</script>[red]' in page.text
    groups = render_report(split_result(HOSTILE, "<b>\x1b[31m"), [])
    assert Page(groups).count("script") == 1
    for character in "\x1b\u202e":
        assert character not in rendered + groups


def test_sections_without_content_are_left_out() -> None:
    page = render_report(result(scored_view("beam/0000")), [])
    for absent in ("<article", "<img", 'id="paper"', "Groups of views", "Extended measures", "Small figures"):
        assert absent not in page
    assert "Extended measures" not in render_report(example(), [])


def test_worst_views_come_first_then_all_in_protocol_order() -> None:
    views = [
        scored_view(f"lattice/{index:04d}", abs_rel=0.1 * (index % 7 + 1)) for index in range(WORST_SHOWN + 5)
    ]
    views[3] = unpredicted_view("lattice/0003")
    page = Page(render_report(result(*views), []))
    ids = re.findall(r"lattice/\d{4}", page.text)
    assert ids[:3] == ["lattice/0003", "lattice/0006", "lattice/0013"]
    assert ids[WORST_SHOWN:] == [view.view_id for view in views]
    assert page.count("details") == 1
    assert not Page(render_report(result(*views[:WORST_SHOWN]), [])).count("details")


def test_overflow_and_zero_errors_render() -> None:
    exact = scored_view("lattice/0001", abs_rel=0.0, scale=1.0)
    shown = result(overflowed_view("pier/0000"), unpredicted_view("lattice/0000"), exact)
    page = render_report(shown, [images_of(factor=1e30), images_of(factor=math.nan)])
    assert "no prediction on scored pixels" in page
    assert "off the scale" in page
    assert 'data-value="inf"' not in page


def test_cells_sort_by_full_precision_and_skip_undefined() -> None:
    assert NATIVE[0].cell(scored_view("lattice/0000", abs_rel=0.123456789)) == Cell("0.1235", 0.123456789)
    empty = unpredicted_view("lattice/0000")
    assert {column.cell(empty) for column in (*NATIVE, *SCALED, SCALE)} == {Cell("–")}
    assert NATIVE[1].cell(overflowed_view("pier/0000")) == Cell("–"), "infinite"
    page = render_report(result(scored_view("pier/0001", abs_rel=0.123456789)), [])
    assert '<td class="first" data-value="0.123456789">0.1235</td>' in page


def test_intervals_use_the_decimals_of_their_numbers() -> None:
    ends = {
        "native.abs_rel": (0.70123, 0.79987),
        "scaled.delta1": (0.9, 1.0),
        "coverage": (0.94999, 1.0),
        "within_mm.3": (0.01, 0.02),
        "scale_median": (0.6, 0.7),
        "native.rmse_cm": None,
    }
    table = dataclasses.replace(result(scored_view("lattice/0000")).tables["lattice"], intervals=ends)
    columns = (NATIVE[0], NATIVE[1], SCALED[3], COVERAGE, WITHIN[0], SCALE)
    assert [column.cell(table).interval for column in columns] == [
        "0.7012 – 0.7999",
        "",
        "0.900 – 1.000",
        "94.9 – 100.0",  # Rounded down as coverage is.
        "1.0 – 2.0",
        "0.600 – 0.700",
    ]
    assert COVERAGE.interval_text(None) == ""


def test_published_rows_are_marked_and_not_sortable(rendered: str) -> None:
    section = rendered[rendered.index('<section aria-labelledby="paper"') :].partition("</section>")[0]
    assert section.count('<tr class="published">') == 12
    assert "sortable" not in section, "sorting would rank them"
    [scene] = paper_scenes(result(unpredicted_view("pile/0000"), scored_view("lattice-zed/0000")))
    assert [cell.text for cell in scene.rows[0].cells] == ["–"] * 4


def test_views_to_show_takes_worst_half_then_even_steps() -> None:
    views = [scored_view(f"lattice/{index:04d}", abs_rel=(index + 1) / 100) for index in range(100)]
    views[50] = unpredicted_view("lattice/0050")
    shown = [int(view.view_id[-4:]) for view in views_to_show(views, 12)]
    assert shown[:6] == [50, 99, 98, 97, 96, 95]
    assert shown[-1] == 0, "the best"
    gaps = [first - second for first, second in pairwise(shown[6:])]
    assert all(15 <= gap <= 17 for gap in gaps)


@settings(max_examples=40)
@given(st.integers(0, 40), st.integers(0, 40))
def test_views_to_show_has_requested_count_and_no_repeats(count: int, total: int) -> None:
    views = [scored_view(f"lattice/{index:04d}", abs_rel=(index * 7 % 41 + 1) / 100) for index in range(total)]
    shown = views_to_show(views, count)
    assert len({view.view_id for view in shown}) == len(shown) == min(count, total)
    errors = [error for view in shown if not math.isnan(error := view["native.abs_rel"])]
    assert errors == sorted(errors, reverse=True)
    if 1 < count <= total:
        assert errors[-1] == np.nanmin([view["native.abs_rel"] for view in views])


def test_templates_and_scripts_are_package_data() -> None:
    shipped = {path.suffix for path in Path("rebar_depth_bench/reporting/html").iterdir()} - {".py", ""}
    declared = Path("pyproject.toml").read_text(encoding="utf-8").split("[tool.setuptools.package-data]")[1]
    assert all(f'"*{suffix}"' in declared.splitlines()[1] for suffix in shipped)


@pytest.mark.slow
def test_report_of_an_archive_embeds_requested_views_worst_first(
    tiny_root: Path,
    tiny_truth: dict[str, np.ndarray],
    archive_of: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    factors = 1.1 + 0.05 * np.random.default_rng(3).permutation(len(tiny_truth))
    archive = archive_of(
        {view: depth_m * factor for (view, depth_m), factor in zip(tiny_truth.items(), factors, strict=True)}
    )
    shown = score(archive, tiny_root)
    worst_first = sorted(shown.views, key=lambda view: view["rank_error"], reverse=True)
    page = tmp_path / "page.html"
    shown.to_html(page, views_shown=3)
    text = page.read_text(encoding="utf-8")
    expected = [view.view_id for view in (*worst_first[:2], worst_first[-1])]
    assert re.findall(r"<h3>(lattice/\d+)</h3>", text) == expected
    assert f"3 of {len(tiny_truth)} views of <b>lattice</b>" in text
    decoded = []
    decode = codecs.decode

    def count(kind: str, content: bytes, grid: tuple[int, int]) -> np.ndarray:
        decoded.append(kind)
        return decode(kind, content, grid)

    monkeypatch.setattr(codecs, "decode", count)
    shown.to_html(page, views_shown=2)
    assert decoded.count("depth") == 2, "only the views that are shown; mistakes are looked for once"
    shown.to_html(page, views_shown=0)
    assert "<article" not in page.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="views to show: -1, expected 0 or more"):
        shown.to_html(page, views_shown=-1)
