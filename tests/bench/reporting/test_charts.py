"""Pictures of reports: colour maps, images of views, axes, and marks of charts."""

from __future__ import annotations

import dataclasses
import io
import math
import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from rebar_depth_bench.extended.estimates import MeasureEstimate
from rebar_depth_bench.extended.profiles import DISTANCE_EDGES_M
from rebar_depth_bench.reporting.axes import Axis, decade_axis, log_axis_with_one, select_spaced
from rebar_depth_bench.reporting.charts import (
    ProfileBin,
    ScatterPoint,
    place_labels,
    profile_chart,
    scatter_chart,
)
from rebar_depth_bench.reporting.colormap import (
    COLOURS,
    DEPTH_COLOURS,
    ERROR_COLOURS,
    colour_indices,
    depth_preview,
    robust_range,
)
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
from tests.bench.reporting.results import (
    HOSTILE,
    panels,
    scored_view,
)


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
    image = Image.fromarray(indices)
    image.putpalette(palette)
    out = io.BytesIO()
    image.save(out, "PNG")
    pixels = np.asarray(Image.open(out).convert("RGB"))
    assert pixels[:, 0].tolist() == [
        [0xFC, 0xEF, 0x83],
        DEPTH_COLOURS[85].tolist(),
        [0x15, 0x1C, 0x53],
        [0, 0, 0],
    ]


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
    images = shown_view(ViewPanels(rgb, truth, truth, steel, scored_view("lattice/0000")))
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


PLACES = st.tuples(st.floats(60, 440), st.floats(20, 280))


@given(st.lists(PLACES, max_size=30))
def test_scatter_labels_touch_their_points_and_do_not_overlap(places: list[tuple[float, float]]) -> None:
    assert place_labels([(200, 150)]) == [(214, 150)], "a lonely point has one"
    labels = place_labels(places)
    assert len(labels) == len(places)
    shown = [label for label in labels if label is not None]
    for place, label in zip(places, labels, strict=True):
        assert label is None or max(abs(label[0] - place[0]), abs(label[1] - place[1])) < 15
    for index, label in enumerate(shown):
        for other in [*places, *shown[:index], *shown[index + 1 :]]:
            assert abs(label[0] - other[0]) >= 9 or abs(label[1] - other[1]) >= 9


def make_estimate(value: float) -> MeasureEstimate:
    return MeasureEstimate(value, (0.9 * value, 1.1 * value), 9)


def test_labels_of_a_profile_do_not_overlap() -> None:
    edges = DISTANCE_EDGES_M
    bins = [
        ProfileBin(low, high, make_estimate(0.1), make_estimate(0.01), make_estimate(0.9))
        for low, high in pairwise(edges)
    ]
    chart = profile_chart("distance", "m", bins)
    labels = re.findall(r'<text class="middle" x="([\d.]+)" y="287">([\d.]+)</text>', chart)
    assert labels[0][1] == "0.2"
    ends = [(float(x) - 3.7 * len(text), float(x) + 3.7 * len(text)) for x, text in labels]
    assert all(left[1] <= right[0] for left, right in pairwise(ends))
    assert len(labels) >= 6


@pytest.mark.parametrize("value", [0.0, 5e-324, 1e-30, 1e300, math.inf])
def test_profile_charts_handle_extreme_and_absent_values(value: float) -> None:
    estimate = MeasureEstimate(value, None, 9)
    chart = profile_chart(
        "distance", "m", [ProfileBin(0.3, 0.4, estimate, MeasureEstimate(None, None, 0), estimate)]
    )
    assert "nan" not in chart
    assert chart.count("<circle") == 2
    for number in re.findall(r'c[xy]="([^"]*)"', chart):
        assert 0 <= float(number) <= 460
    none = MeasureEstimate(None, None, 0)
    assert profile_chart("distance", "m", [ProfileBin(0.3, 0.4, none, none, none)]) == ""


def test_marks_of_a_profile_are_placed_by_its_axes() -> None:
    bins = [
        ProfileBin(0.3, 0.4, make_estimate(0.2), make_estimate(0.02), make_estimate(0.9)),
        ProfileBin(0.4, 0.5, make_estimate(0.1), make_estimate(0.01), make_estimate(1.1)),
    ]
    chart = profile_chart("distance", "m", bins)
    marks = {
        kind: [(float(x), float(y)) for x, y in re.findall(rf'class="{kind}" cx="([^"]+)" cy="([^"]+)"', chart)]
        for kind in ("native fill", "scaled ring")
    }
    (near, far, near_scale, far_scale), rings = marks["native fill"], marks["scaled ring"]
    assert near[1] < far[1], "a larger error is higher"
    assert all(native[1] < ring[1] for native, ring in zip((near, far), rings, strict=True))
    assert (near[1] - far[1]) == pytest.approx(rings[0][1] - rings[1][1], abs=0.2), "logarithmic"
    unit_scale_y = float(re.search(r'class="one" d="M52.0 ([\d.]+)H', chart)[1])  # type: ignore[index]
    assert far_scale[1] < unit_scale_y < near_scale[1], "s above 1 is above the line"
    assert chart.count("V") >= 6, "an interval each"
