"""HTML report: page contents, view images, axes and charts."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import io
import math
import re

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.reporting.axes import Axis, decade_axis, log_axis_with_one
from rebar_depth_bench.reporting.charts import alignment_chart, scale_chart, views_chart
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.page import WORST_SHOWN, render_report
from rebar_depth_bench.reporting.html.views import (
    ViewPanels,
    depth_image,
    depth_range,
    error_image,
    error_limit_cm,
    shown_view,
    signed_error,
)
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, overflowed_view, panels, result, scored_view, unpredicted_view
from tests.bench.reporting.results import shown as images_of


def _decode(webp: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.asarray(Image.open(io.BytesIO(webp)).convert("RGB"))


def test_page_shows_numbers_provenance_and_alignment() -> None:
    page = Page(render_report(result(scored_view("lattice/0000"), unpredicted_view("pile/0000")), [images_of()]))
    for stated in (
        *("0.7500", "20.09", "18.71", "0.123", "0.0613", "1.52", "1.17", "0.988", "0.625"),
        *("1.2", "4.6", "7.9", "13.6"),
        *("my model", "rebar-2", "1.2.3", "sha256:" + "fedcba9876543210" * 4, "0123456789abcdef" * 4),
        "Native (no alignment) and scaled (oracle median scale per view, s = median(z)/median(p))",
        "not compared with those of others: 1 of 1 view without any prediction; coverage 0.0 % is below 95 %.",
        "43\N{NARROW NO-BREAK SPACE}210 scored pixels",
    ):
        assert stated in page.text


def test_hostile_names_are_escaped() -> None:
    hostile = result(scored_view("<b>x/0000"), method=HOSTILE)
    rendered = render_report(hostile, [images_of("<b>x/0000")])
    page = Page(rendered)
    assert len(page.attributes_of("script")) == 1, "the page's own"
    benign = Page(render_report(result(scored_view("beam/0000")), [images_of("beam/0000")]))
    assert len(page.attributes_of("b")) == len(benign.attributes_of("b"))
    assert "<b>x" not in rendered
    assert '=<script src="//evil.example/x.js">alert(1)</script>[red]' in page.text
    assert "\x1b" not in rendered
    assert "\u202e" not in rendered


def test_page_is_self_contained_with_one_hashed_script() -> None:
    rendered = render_report(result(scored_view("lattice/0000")), [images_of()])
    page = Page(rendered)
    assert not re.search(
        r"https?://|<link|<iframe|@import|url\(|javascript:|fetch|import\(|XMLHttp|innerHTML", rendered
    )
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", rendered, re.DOTALL)
    assert len(scripts) == len(page.attributes_of("script")) == 1
    assert page.attributes_of("script") == [{}], "inline: no source"
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert len(page.attributes_of("img")) == 5 + 4, "five panels, four colour bars"
    assert all((image["src"] or "").startswith("data:image/") for image in page.attributes_of("img"))
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    policy = [meta for meta in page.attributes_of("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policy[0]["content"] == (
        f"default-src 'none'; script-src 'sha256-{digest}'; img-src data:; style-src 'unsafe-inline'"
    )


def test_page_is_complete_without_script() -> None:
    views = [scored_view(f"lattice/{index:04d}", abs_rel=0.1 * (index + 1)) for index in range(3)]
    page = Page(render_report(result(*views), [images_of(view.view_id, view) for view in views]))
    assert len(page.attributes_of("article")) == 3
    assert [tags for tags in page.attributes_of("div") if tags.get("class") == "controls"] == [
        {"class": "controls", "hidden": None}
    ], "buttons that do nothing do not show"
    hidden = [attributes for name, attributes in page.tags if "hidden" in attributes and name != "div"]
    assert hidden == []
    assert "3 of 3 views of lattice" in page.text


def test_page_is_well_formed_with_alternative_texts() -> None:
    page = Page(render_report(result(scored_view("lattice/0000"), scored_view("pile/0000")), [images_of()]))
    assert len(page.attributes_of("h1")) == 1
    assert page.attributes_of("html") == [{"lang": "en"}]
    assert len(page.attributes_of("svg")) == len(page.attributes_of("desc")) == 6
    alts = [image["alt"] for image in page.attributes_of("img")]
    assert sum(bool(alt) for alt in alts) == 5
    assert len({alt for alt in alts if alt}) == 5
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_rendering_is_deterministic() -> None:
    shown = result(scored_view("lattice/0000"), unpredicted_view("pile/0000"))
    assert render_report(shown, [images_of()]) == render_report(shown, [images_of()])


def test_no_view_section_without_panels() -> None:
    page = Page(render_report(result(scored_view("lattice/0000")), []))
    assert not page.attributes_of("article")
    assert not page.attributes_of("img")


def test_worst_views_first_then_all_in_protocol_order() -> None:
    views = [
        scored_view(f"lattice/{index:04d}", abs_rel=0.1 * (index % 7 + 1)) for index in range(WORST_SHOWN + 5)
    ]
    views[3] = unpredicted_view("lattice/0003")
    page = Page(render_report(result(*views), []))
    ids = re.findall(r"lattice/\d{4}", page.text)
    assert ids[:3] == ["lattice/0003", "lattice/0006", "lattice/0013"]
    assert ids[WORST_SHOWN:] == [view.view_id for view in views]
    assert len(page.attributes_of("details")) == 1
    assert not Page(render_report(result(*views[:WORST_SHOWN]), [])).attributes_of("details")


def test_overflow_and_zero_errors_render() -> None:
    perfect = dataclasses.replace(scored_view("lattice/0000"), native=None, scaled=None, scale=None)
    exact = scored_view("lattice/0001", abs_rel=0.0, scale=1.0)
    shown = result(overflowed_view("pier/0000"), perfect, exact)
    text = Page(render_report(shown, [images_of(factor=1e30), images_of(factor=math.nan)])).text
    assert "not compared with those of others: a number overflowed." in text
    assert "no prediction on scored pixels" in text
    assert "off the scale" in text


def test_depth_image_clips_to_range_and_greys_missing() -> None:
    near, far = 0.5, 1.0
    image = depth_image(np.array([[0.5, 1.0, 0.75, 9.0, 0.1, 0.0, np.nan]]), near, far)
    assert image[0, 0].tolist() == DEPTH_COLOURS[254].tolist(), "near is bright"
    assert image[0, 1].tolist() == image[0, 3].tolist() == DEPTH_COLOURS[0].tolist()
    assert image[0, 2].tolist() == DEPTH_COLOURS[127].tolist()
    assert image[0, 4].tolist() == image[0, 0].tolist()
    for missing in (image[0, 5], image[0, 6]):
        assert len(set(missing.tolist())) == 1, "neutral grey"


def test_error_image_signs_steel_and_stripes_missing() -> None:
    view = panels(factor=1.02)
    view.prediction_m[0] = np.nan
    view.prediction_m[1] = 0.49
    error = signed_error(view, 1.0)
    assert np.isnan(error[:, :20]).all()
    assert error[5, 25] == pytest.approx(0.01, abs=1e-6)
    image = error_image(error, view.steel, view.rgb, 1.0)
    assert image[5, 25].tolist() == ERROR_COLOURS[254].tolist(), "too far, at the limit"
    assert image[1, 25].tolist() == ERROR_COLOURS[0].tolist(), "too near, at the limit"
    assert {tuple(pixel) for pixel in image[0, 20:30].tolist()} == {(240, 200, 0), (16, 16, 16)}
    assert image[5, 5].tolist() == [44, 44, 44], "dimmed scene"


def test_view_without_colour_has_other_panels() -> None:
    view = dataclasses.replace(panels(factor=1.02), rgb=None)
    images, with_colour = shown_view(view), shown_view(panels(factor=1.02))
    assert images.colour is None
    assert (images.width, images.truth) == (with_colour.width, with_colour.truth)
    image = error_image(signed_error(view, 1.0), view.steel, None, 1.0)
    assert (image[5, 25].tolist(), image[5, 5].tolist()) == (ERROR_COLOURS[254].tolist(), [0, 0, 0])
    text = render_report(result(scored_view("lattice/0000")), [shown_view(view)])
    assert "<strong>Colour</strong>" not in text
    assert "<strong>Native error</strong>" in text


def test_scaled_error_uses_scale_of_view() -> None:
    view = panels(factor=1.6)
    assert signed_error(view, 0.625)[5, 25] == pytest.approx(0.0, abs=1e-6)
    images = shown_view(view)
    assert (images.native_limit, images.scaled_limit) == ("30 cm", "0.01 cm")
    assert _decode(images.scaled_error)[5, 25].tolist() == ERROR_COLOURS[127].tolist()
    assert images.predicted == "0.800 m to 0.800 m"


@pytest.mark.parametrize(
    ("error_cm", "limit"), [(0.0, 0.01), (0.11, 0.2), (2.01, 3.0), (7.0, 7.0), (71.0, 100.0), (1e300, 1e9)]
)
def test_error_limit_is_round_and_covers_errors(error_cm: float, limit: float) -> None:
    assert error_limit_cm(np.full((1, 20), -error_cm / 100), np.arange(20)) == limit


def test_error_limit_ignores_worst_5_percent() -> None:
    error = np.full((1, 100), 0.02)
    error[0, :5] = 1.0
    assert error_limit_cm(error, np.arange(100)) == 2.0
    error[0, 5] = 1.0
    assert error_limit_cm(error, np.arange(100)) == 100.0
    assert error_limit_cm(np.full((1, 4), np.nan), np.arange(4)) is None


def test_depth_range_uses_scored_pixels_only() -> None:
    view = panels()
    scored_px = np.flatnonzero(view.steel.ravel())
    assert depth_range(view.truth_m, scored_px) == pytest.approx((0.495, 0.505))


@pytest.mark.slow
def test_large_panels_sample_depth_and_average_colour() -> None:
    truth = np.full((720, 1280), 2.0, np.float32)
    truth[::2, ::2] = 1.0
    rgb = np.zeros((720, 1280, 3), np.uint8)
    rgb[::2] = 200
    steel = np.ones((720, 1280), bool)
    images = shown_view(ViewPanels(rgb, truth, truth, steel, scored_view("lattice/0000")))
    assert (images.width, images.height) == (640, 360)
    depth = _decode(images.truth).reshape(-1, 3)
    assert len(np.unique(depth, axis=0)) == 1, "an average would have made depths that do not exist"
    assert depth[0].tolist() == DEPTH_COLOURS[round((2.1 - 1.0) / 1.2 * 254)].tolist()
    assert images.colour is not None
    assert abs(int(_decode(images.colour)[180, 320, 0]) - 100) <= 3


def test_log_axis_positions_and_ticks() -> None:
    axis = Axis(0.01, 1.0, 0.0, 100.0)
    assert axis.at(0.1) == pytest.approx(50.0)
    assert (axis.at(0.0), axis.at(math.inf)) == (0.0, 100.0)
    assert axis.ticks() == [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    assert Axis(1e-6, 1e6, 0, 1).ticks() == [1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6]


def test_axes_cover_their_values() -> None:
    axis = decade_axis([0.0, math.inf, 0.013, 0.7], 0, 1)
    assert (axis.low, axis.high) == (0.01, 1.0)
    unit = log_axis_with_one([0.998, 1.003], 0, 1)
    assert unit.low < 0.998 < 1.003 < unit.high
    assert 1.0 in unit.ticks()
    assert len(unit.ticks()) >= 3
    for extreme in ([], [5e-324], [1e308], [1e-300, 1e300]):
        assert len(decade_axis(extreme, 0, 1).ticks()) >= 2
        assert len(log_axis_with_one(extreme, 0, 1).ticks()) >= 2


def test_charts_mark_every_view_and_config() -> None:
    views = [scored_view("lattice/0000"), scored_view("lattice/0001", scale=0.5), unpredicted_view("lattice/0002")]
    tables = result(*views, scored_view("pile/0000")).tables
    dumbbell, strips = alignment_chart(tables), scale_chart(tables, {"lattice": views})
    assert dumbbell.count("<circle") == 4
    assert "lattice: native 0.7500, scaled 0.0613" in dumbbell
    assert strips.count("h0") == 2
    assert "median s 0.562" in strips
    errors = views_chart("lattice", views)
    assert errors.count("h0") == 4
    assert errors.count("V18.0") == 1
    assert "3 views of lattice, 1 without any prediction" in errors
