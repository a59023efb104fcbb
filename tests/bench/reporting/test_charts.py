"""Pictures of reports: colour maps, images of views, axes, and marks of charts."""

from __future__ import annotations

import dataclasses
import io
import math
import re

import numpy as np
import pytest
from PIL import Image

from rebar_depth_bench.extended.working_range import TaskSamples, working_range
from rebar_depth_bench.reporting.axes import Axis, decade_axis, log_axis_with_one, select_spaced
from rebar_depth_bench.reporting.charts import alignment_chart, range_chart, scale_chart, views_chart
from rebar_depth_bench.reporting.colormap import (
    COLOURS,
    DEPTH_COLOURS,
    ERROR_COLOURS,
    colour_indices,
    depth_preview,
    robust_range,
)
from rebar_depth_bench.reporting.html.page import render_report
from rebar_depth_bench.reporting.html.views import (
    ViewPanels,
    depth_image,
    depth_range,
    error_image,
    error_limit_cm,
    shown_view,
    signed_error,
)
from rebar_depth_bench.scoring.protocol import scored_pixels
from tests.bench.reporting.results import HOSTILE, changed, panels, result, scored_view, table_of, unpredicted_view


def luminance_of(colours: np.ndarray) -> np.ndarray:
    """Return the relative luminance of 8-bit sRGB colours."""
    linear = np.where(colours <= 10, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_depth_colours_match_published_anchors_and_rise_in_luminance() -> None:
    assert DEPTH_COLOURS.shape == (COLOURS, 3)
    assert DEPTH_COLOURS[0].tolist() == [0x15, 0x1C, 0x53]
    assert DEPTH_COLOURS[127].tolist() == [0xD1, 0x40, 0x79]
    assert DEPTH_COLOURS[254].tolist() == [0xFC, 0xEF, 0x83]
    assert DEPTH_COLOURS[8].tolist() == [31, 30, 95], "a rounded, integer interpolation between two anchors"
    assert (np.diff(luminance_of(DEPTH_COLOURS)) > 0).all()


def test_error_colours_are_lightest_at_zero_error() -> None:
    luminance = luminance_of(ERROR_COLOURS)
    assert luminance.argmax() == 127
    assert (np.diff(luminance[:128]) > 0).all()
    assert (np.diff(luminance[127:]) < 0).all()
    assert abs(luminance[0] - luminance[254]) < 0.02
    assert ERROR_COLOURS[127].tolist() == [0xF3] * 3
    assert ERROR_COLOURS[0, 2] > ERROR_COLOURS[0, 0], "negative is blue"
    assert ERROR_COLOURS[254, 0] > ERROR_COLOURS[254, 2], "positive is red"


def test_colour_indices_clip_and_map_nan_to_zero() -> None:
    values = np.array([-9.0, 0.0, 0.5, 1.0, 9.0, np.inf, -np.inf, np.nan])
    assert colour_indices(values, 0.0, 1.0).tolist() == [0, 0, 127, 254, 254, 254, 0, 0]
    assert colour_indices(values[1:4], 1.0, 0.0).tolist() == [254, 127, 0]
    assert colour_indices(values[1:4], 1.0, 1.0).tolist() == [127, 127, 127]


def test_robust_range_takes_order_statistics() -> None:
    values = np.arange(101, dtype=float)[::-1]
    assert robust_range(values) == (2.0, 98.0)
    assert robust_range(np.array([3.0])) == (3.0, 3.0)


def test_preview_is_bright_near_and_black_without_depth() -> None:
    depth = np.zeros((4, 50), dtype=np.float32)
    depth[0] = 0.25
    depth[1] = 0.5
    depth[2] = 1.0
    indices, palette = depth_preview(depth)
    assert indices.dtype == np.uint8
    assert len(palette) == 768
    assert indices[:, 0].tolist() == [255, 86, 1, 0], "even in inverse depth: 4, 2, 1 per metre"
    colours = np.reshape(list(palette), (256, 3))[indices[:, 0]]
    assert colours.tolist() == [[0xFC, 0xEF, 0x83], DEPTH_COLOURS[85].tolist(), [0x15, 0x1C, 0x53], [0, 0, 0]]


def test_preview_is_robust_to_outliers_and_empty_or_constant_depth() -> None:
    depth = np.linspace(0.5, 1.0, 1000, dtype=np.float32).reshape(20, 50)
    outlier = depth.copy()
    outlier[0, 0] = 0.001
    expected, preview = depth_preview(depth)[0], depth_preview(outlier)[0]
    assert np.abs(expected.astype(int) - preview.astype(int)).ravel()[1:].max() <= 1
    assert not depth_preview(np.zeros((3, 4), np.float32))[0].any()
    assert not depth_preview(np.full((3, 4), np.nan, np.float32))[0].any()
    assert np.unique(depth_preview(np.full((3, 4), 2.0, np.float32))[0]).tolist() == [128]


def decoded(webp: bytes) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.asarray(Image.open(io.BytesIO(webp)).convert("RGB"))


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
    page = render_report(result(scored_view("lattice/0000")), [images])
    assert ("<strong>Colour</strong>" in page, "<strong>Native error</strong>" in page) == (False, True)
    assert (images.width, images.truth) == (with_colour.width, with_colour.truth)
    image = error_image(signed_error(view, 1.0), view.steel, None, 1.0)
    assert (image[5, 25].tolist(), image[5, 5].tolist()) == (ERROR_COLOURS[254].tolist(), [0, 0, 0])


def test_scaled_error_uses_scale_of_view() -> None:
    view = panels(factor=1.6)
    assert signed_error(view, 0.625)[5, 25] == pytest.approx(0.0, abs=1e-6)
    images = shown_view(view)
    assert (images.native_limit, images.scaled_limit) == ("30 cm", "0.01 cm")
    assert decoded(images.scaled_error)[5, 25].tolist() == ERROR_COLOURS[127].tolist()
    assert images.predicted == "0.800 m"


@pytest.mark.parametrize(
    ("native_cm", "scaled_cm", "shared"),
    [(2.0, 1.0, True), (3.0, 1.0, True), (1.0, 3.0, True), (5.0, 1.0, False), (1.0, 5.0, False)],
)
def test_error_maps_share_the_larger_range_up_to_a_factor_of_three(
    native_cm: float, scaled_cm: float, shared: bool
) -> None:
    native, scaled = 1 + 0.999 * native_cm / 50, 1 + 0.999 * scaled_cm / 50
    score = scored_view("lattice/0000", scale=scaled / native)
    images = shown_view(panels(score=score, factor=native))
    larger = max(native_cm, scaled_cm)
    limits = (larger, larger) if shared else (native_cm, scaled_cm)
    assert (images.native_limit, images.scaled_limit) == tuple(f"{limit:g} cm" for limit in limits)
    for webp, error_cm, limit in zip(
        (images.native_error, images.scaled_error), (native_cm, scaled_cm), limits, strict=True
    ):
        index = colour_indices(np.array([0.999 * error_cm]), -limit, limit)
        assert decoded(webp)[5, 25] == pytest.approx(ERROR_COLOURS[index[0]], abs=2)


@pytest.mark.parametrize("tied", [0, 1])
def test_prediction_states_its_whole_range_and_the_share_within_the_robust_one(tied: int) -> None:
    """The robust range excludes 2 % of the pixels at either end, but not those that equal an end of it."""
    view = panels()
    scored = scored_pixels(view.steel, view.truth_m)
    out = int(0.02 * (scored.size - 1))
    near, far = np.full(out + tied, 0.140), np.full(out, 79.06)
    middle = np.linspace(0.146, 0.357, scored.size - len(near) - len(far))
    view.prediction_m.ravel()[scored] = np.concatenate([near, middle, far])
    inside = scored.size - out - (0 if tied else out)
    low = "0.140" if tied else "0.146"
    expected = f"{low}–0.357 m ({math.floor(100 * inside / scored.size)} %), 0.140–79.06 m in all"
    assert shown_view(view).predicted == expected


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
    score = scored_view("lattice/0000")
    images = shown_view(ViewPanels(rgb, truth, truth, steel, scored_pixels(steel, truth), score))
    assert (images.width, images.height) == (640, 360)
    depth = decoded(images.truth).reshape(-1, 3)
    assert len(np.unique(depth, axis=0)) == 1, "an average would have made depths that do not exist"
    assert depth[0].tolist() == DEPTH_COLOURS[round((2.1 - 1.0) / 1.2 * 254)].tolist()
    assert images.colour is not None
    assert abs(int(decoded(images.colour)[180, 320, 0]) - 100) <= 3


def test_axes_have_positions_and_round_ticks() -> None:
    axis = Axis(0.01, 1.0, 0.0, 100.0)
    assert axis.at(0.1) == pytest.approx(50.0)
    assert (axis.at(0.0), axis.at(math.inf)) == (0.0, 100.0)
    assert axis.ticks() == [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0]
    assert Axis(1e-6, 1e6, 0, 1).ticks() == [1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4, 1e6]
    assert Axis(-1.0, 1.0, 0.0, 1.0, linear=True).ticks() == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert select_spaced([10.0, 1.0, 11.0, 100.0], Axis(1.0, 100.0, 0.0, 100.0), 40.0) == [10.0, 1.0, 100.0]


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


def test_charts_of_configs_place_their_marks_and_describe_them() -> None:
    views = [scored_view("a/0000", 0.1, scale=0.8), scored_view("a/0001", 0.4, scale=1.25)]
    scored = {HOSTILE: views, "none": [unpredicted_view("none/0000")]}
    tables = {name: table_of(of_config) for name, of_config in scored.items()}
    chart = alignment_chart(tables)
    ring, disc = (float(x) for x in re.findall(r'<circle class="[a-z ]*" cx="([\d.]+)"', chart))
    assert ring < disc, "the larger native error is to the right of the scaled one"
    assert "0.2500 → 0.0613 scaled; none: no prediction.</desc>" in chart
    assert "<script" not in chart

    chart = scale_chart(tables, scored)
    near, far = (float(x) for x in re.findall(r"M([\d.]+) [-\d.]+h0", chart))
    one = re.findall(r'class="one" d="M([\d.]+)', chart)
    assert len(one) == 2
    assert near < float(one[0]) < far
    assert "median s –" in chart


def test_chart_of_views_has_a_dot_for_each_error_and_a_mark_for_each_view_without() -> None:
    views = [
        scored_view("a/0000", 0.1),
        unpredicted_view("a/0001"),
        changed(scored_view("a/0002"), {"scale": 1e9}),
    ]
    chart = views_chart(HOSTILE, views)
    dots = re.findall(r"M([\d.]+) ([\d.]+)h0", chart)
    without = re.findall(r'class="missing" d="M([\d.]+)', chart)
    assert len(dots) == 4
    assert float(dots[0][0]) < float(without[0]) < float(dots[1][0])
    assert len(re.findall("h0", views_chart("a", views * 30))) == 120
    assert "large" in chart
    assert "large" not in views_chart("a", views * 61)
    assert "<script" not in chart


def test_alignment_without_samples_has_no_panel() -> None:
    """The laser reads nothing if no view has true depth at its centre."""
    some = working_range(TaskSamples(5.0, np.arange(50), *[np.full(50, 0.6)] * 4))
    none = working_range(TaskSamples(5.0, np.arange(0), *[np.empty(0)] * 4))
    chart = range_chart("ties", {"native": {"net": some}, "laser": {"net": none}})
    assert chart == range_chart("ties", {"native": {"net": some}})
    assert range_chart("ties", {"native": {"net": none}, "laser": {"net": none}}) is None
