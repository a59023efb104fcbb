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

from rebar_depth_bench.reporting.charts.axes import LogAxis, decade_axis, unit_axis
from rebar_depth_bench.reporting.charts.score_charts import alignment_chart, scale_chart, views_chart
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.page import WORST_SHOWN, render_report
from rebar_depth_bench.reporting.html.view_images import (
    ViewPanels,
    depth_image,
    depth_range,
    error_image,
    error_limit_cm,
    signed_error,
    view_images,
)
from rebar_depth_bench.scoring.result import ViewScore
from tests.bench.reporting.pages import Page
from tests.bench.reporting.results import HOSTILE, overflowed, result, scored, unpredicted


def panels(view_id: str = "lattice/0000", score: ViewScore | None = None, factor: float = 1.6) -> ViewPanels:
    """Return a 40 x 60 view: a bar at 0.5 m before a wall at 1 m, predicted ``factor`` times too far."""
    truth = np.ones((40, 60), np.float32)
    steel = np.zeros((40, 60), bool)
    steel[:, 20:30] = True
    truth[steel] = 0.5
    rgb = np.full((40, 60, 3), 128, np.uint8)
    return ViewPanels(view_id, rgb, truth, truth * np.float32(factor), steel, score or scored(view_id))


def _decoded(uri: str) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB"))


def test_numbers_stamps_and_alignment_are_on_the_page() -> None:
    page = Page(render_report(result(scored("lattice/0000"), unpredicted("pile/0000")), [panels()]))
    for stated in (
        *("0.7500", "20.09", "18.71", "0.123", "0.0613", "1.52", "1.17", "0.988", "0.625"),
        *("1.2", "4.6", "7.9", "13.6"),
        *("my model", "rebar-1", "1.2.3", "sha256:" + "fedcba9876543210" * 4, "0123456789abcdef" * 4),
        "Native (no alignment) and scaled (oracle median scale per view, s = median(z)/median(p))",
        "is not ranked: 1 of 1 view without any prediction; coverage 0.0 % is below 95 %.",
        "43\N{NARROW NO-BREAK SPACE}210 scored pixels",
    ):
        assert stated in page.text


def test_hostile_names_stay_text() -> None:
    hostile = result(scored("<b>x/0000"), method=HOSTILE)
    rendered = render_report(hostile, [panels("<b>x/0000")], title="<i>mine</i>")
    page = Page(rendered)
    assert len(page.named("script")) == 1, "the page's own"
    benign = Page(render_report(result(scored("beam/0000")), [panels("beam/0000")], title="mine"))
    assert len(page.named("b")) == len(benign.named("b"))
    assert "<b>x" not in rendered
    assert "<i>mine" not in rendered
    assert '=<script src="//evil.example/x.js">alert(1)</script>[red]' in page.text
    assert "\x1b" not in rendered
    assert "\u202e" not in rendered


def test_the_page_asks_nothing_of_the_network_and_runs_one_script_that_its_policy_names() -> None:
    rendered = render_report(result(scored("lattice/0000")), [panels()])
    page = Page(rendered)
    assert not re.search(
        r"https?://|<link|<iframe|@import|url\(|javascript:|fetch|import\(|XMLHttp|innerHTML", rendered
    )
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", rendered, re.DOTALL)
    assert len(scripts) == len(page.named("script")) == 1
    assert page.named("script") == [{}], "inline: no source"
    digest = base64.b64encode(hashlib.sha256(scripts[0].encode()).digest()).decode()
    assert len(page.named("img")) == 5 + 4, "five panels, four colour bars"
    assert all((image["src"] or "").startswith("data:image/") for image in page.named("img"))
    assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
    policy = [meta for meta in page.named("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policy[0]["content"] == (
        f"default-src 'none'; script-src 'sha256-{digest}'; img-src data:; style-src 'unsafe-inline'"
    )


def test_the_page_is_complete_without_its_script() -> None:
    views = [scored(f"lattice/{index:04d}", abs_rel=0.1 * (index + 1)) for index in range(3)]
    page = Page(render_report(result(*views), [panels(view.view_id, view) for view in views]))
    assert len(page.named("article")) == 3
    assert [tags for tags in page.named("div") if tags.get("class") == "controls"] == [
        {"class": "controls", "hidden": None}
    ], "buttons that do nothing do not show"
    hidden = [attributes for name, attributes in page.tags if "hidden" in attributes and name != "div"]
    assert hidden == []
    assert "3 of 3 views of lattice" in page.text


def test_the_page_is_well_formed_and_described() -> None:
    page = Page(render_report(result(scored("lattice/0000"), scored("pile/0000")), [panels()]))
    assert len(page.named("h1")) == 1
    assert page.named("html") == [{"lang": "en"}]
    assert len(page.named("svg")) == len(page.named("desc")) == 6
    alts = [image["alt"] for image in page.named("img")]
    assert sum(bool(alt) for alt in alts) == 5
    assert len({alt for alt in alts if alt}) == 5
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))


def test_same_input_same_bytes() -> None:
    shown = result(scored("lattice/0000"), unpredicted("pile/0000"))
    assert render_report(shown, [panels()]) == render_report(shown, [panels()])


def test_no_panels_no_section() -> None:
    page = Page(render_report(result(scored("lattice/0000")), []))
    assert not page.named("article")
    assert not page.named("img")


def test_the_worst_views_come_first_and_all_views_follow_in_protocol_order() -> None:
    views = [scored(f"lattice/{index:04d}", abs_rel=0.1 * (index % 7 + 1)) for index in range(WORST_SHOWN + 5)]
    views[3] = unpredicted("lattice/0003")
    page = Page(render_report(result(*views), []))
    ids = re.findall(r"lattice/\d{4}", page.text)
    assert ids[:3] == ["lattice/0003", "lattice/0006", "lattice/0013"]
    assert ids[WORST_SHOWN:] == [view.view_id for view in views]
    assert len(page.named("details")) == 1
    assert not Page(render_report(result(*views[:WORST_SHOWN]), [])).named("details")


def test_overflow_and_zero_errors_render() -> None:
    perfect = dataclasses.replace(scored("lattice/0000"), native=None, scaled=None, scale=None)
    exact = scored("lattice/0001", abs_rel=0.0, scale=1.0)
    shown = result(overflowed("pier/0000"), perfect, exact)
    text = Page(render_report(shown, [panels(factor=1e30), panels(factor=math.nan)])).text
    assert "is not ranked: a number overflowed." in text
    assert "nothing to compare: no prediction on scored pixels" in text
    assert "off the scale" in text


def test_depth_shares_one_range_and_marks_what_is_missing() -> None:
    near, far = 0.5, 1.0
    image = depth_image(np.array([[0.5, 1.0, 0.75, 9.0, 0.1, 0.0, np.nan]]), near, far)
    assert image[0, 0].tolist() == DEPTH_COLOURS[254].tolist(), "near is bright"
    assert image[0, 1].tolist() == image[0, 3].tolist() == DEPTH_COLOURS[0].tolist()
    assert image[0, 2].tolist() == DEPTH_COLOURS[127].tolist()
    assert image[0, 4].tolist() == image[0, 0].tolist()
    for missing in (image[0, 5], image[0, 6]):
        assert len(set(missing.tolist())) == 1, "neutral grey"


def test_error_is_signed_only_on_steel_and_missing_predictions_are_striped() -> None:
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


def test_scaled_error_uses_the_views_own_scale() -> None:
    view = panels(factor=1.6)
    assert signed_error(view, 0.625)[5, 25] == pytest.approx(0.0, abs=1e-6)
    images = view_images(view)
    assert images.native_limit_cm == 30.0
    assert images.scaled_limit_cm == 0.01
    assert _decoded(images.scaled_error)[5, 25].tolist() == ERROR_COLOURS[127].tolist()
    assert images.predicted_m == pytest.approx((0.8, 0.8))


@pytest.mark.parametrize(
    ("error_cm", "limit"), [(0.0, 0.01), (0.11, 0.2), (2.01, 3.0), (7.0, 7.0), (71.0, 100.0), (1e300, 1e9)]
)
def test_error_limits_are_round_and_hold_the_errors(error_cm: float, limit: float) -> None:
    assert error_limit_cm(np.full((1, 20), -error_cm / 100), np.arange(20)) == limit


def test_error_limit_leaves_out_the_worst_twentieth() -> None:
    error = np.full((1, 100), 0.02)
    error[0, :5] = 1.0
    assert error_limit_cm(error, np.arange(100)) == 2.0
    error[0, 5] = 1.0
    assert error_limit_cm(error, np.arange(100)) == 100.0
    assert error_limit_cm(np.full((1, 4), np.nan), np.arange(4)) is None


def test_the_depth_range_comes_from_scored_pixels_not_from_the_wall() -> None:
    view = panels()
    scored_px = np.flatnonzero(view.steel.ravel())
    assert depth_range(view.truth_m, scored_px) == pytest.approx((0.495, 0.505))


def test_large_panels_are_halved_maps_by_sampling_colour_by_averaging() -> None:
    truth = np.full((720, 1280), 2.0, np.float32)
    truth[::2, ::2] = 1.0
    rgb = np.zeros((720, 1280, 3), np.uint8)
    rgb[::2] = 200
    steel = np.ones((720, 1280), bool)
    images = view_images(ViewPanels("lattice/0000", rgb, truth, truth, steel, scored("lattice/0000")))
    assert (images.width, images.height) == (640, 360)
    depth = _decoded(images.truth).reshape(-1, 3)
    assert len(np.unique(depth, axis=0)) == 1, "an average would have made depths that do not exist"
    assert depth[0].tolist() == DEPTH_COLOURS[round((2.1 - 1.0) / 1.2 * 254)].tolist()
    assert abs(int(_decoded(images.colour)[180, 320, 0]) - 100) <= 3


def test_images_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"lattice/0000: .* share H x W = \(40, 60\)"):
        dataclasses.replace(panels(), steel=np.ones((2, 2), bool))


def test_log_axis_places_and_labels() -> None:
    axis = LogAxis(0.01, 1.0, 0.0, 100.0)
    assert axis.at(0.1) == pytest.approx(50.0)
    assert (axis.at(0.0), axis.at(math.inf)) == (0.0, 100.0)
    assert axis.ticks() == [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    assert LogAxis(1e-6, 1e6, 0, 1).ticks() == [1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6]


def test_axes_fit_their_values() -> None:
    axis = decade_axis([0.0, math.inf, 0.013, 0.7], 0, 1)
    assert (axis.low, axis.high) == (0.01, 1.0)
    unit = unit_axis([0.998, 1.003], 0, 1)
    assert unit.low < 0.998 < 1.003 < unit.high
    assert 1.0 in unit.ticks()
    assert len(unit.ticks()) >= 3
    for extreme in ([], [5e-324], [1e308], [1e-300, 1e300]):
        assert len(decade_axis(extreme, 0, 1).ticks()) >= 2
        assert len(unit_axis(extreme, 0, 1).ticks()) >= 2


def test_charts_mark_every_view_and_every_config() -> None:
    views = [scored("lattice/0000"), scored("lattice/0001", scale=0.5), unpredicted("lattice/0002")]
    tables = result(*views, scored("pile/0000")).tables
    dumbbell, strips = alignment_chart(tables), scale_chart(tables, {"lattice": views})
    assert dumbbell.count("<circle") == 4
    assert "lattice: native 0.7500, scaled 0.0613" in dumbbell
    assert strips.count("h0") == 2
    assert "median s 0.562" in strips
    errors = views_chart("lattice", views)
    assert errors.count("h0") == 4
    assert errors.count("v10") == 1
    assert "3 views of lattice, 1 without any prediction" in errors
