"""Colour maps of depth and error, and depth previews."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from rebar_depth_bench.reporting.colormap import (
    COLOURS,
    DEPTH_COLOURS,
    ERROR_COLOURS,
    colour_indices,
    depth_preview,
    robust_range,
)


def _luminance(colours: np.ndarray) -> np.ndarray:
    """Return the relative luminance of 8-bit sRGB colours."""
    linear = np.where(colours <= 10, colours / 255 / 12.92, ((colours / 255 + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def test_depth_colours_match_published_anchors() -> None:
    assert DEPTH_COLOURS.shape == (COLOURS, 3)
    assert DEPTH_COLOURS[0].tolist() == [0x15, 0x1C, 0x53]
    assert DEPTH_COLOURS[127].tolist() == [0xD1, 0x40, 0x79]
    assert DEPTH_COLOURS[254].tolist() == [0xFC, 0xEF, 0x83]
    assert DEPTH_COLOURS[8].tolist() == [31, 30, 95], "a rounded, integer interpolation between two anchors"


def test_depth_luminance_rises_at_every_step() -> None:
    assert (np.diff(_luminance(DEPTH_COLOURS)) > 0).all()


def test_error_colours_are_lightest_at_zero_error() -> None:
    luminance = _luminance(ERROR_COLOURS)
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


def test_preview_is_robust_to_outliers() -> None:
    depth = np.linspace(0.5, 1.0, 1000, dtype=np.float32).reshape(20, 50)
    outlier = depth.copy()
    outlier[0, 0] = 0.001
    expected, preview = depth_preview(depth)[0], depth_preview(outlier)[0]
    assert np.abs(expected.astype(int) - preview.astype(int)).ravel()[1:].max() <= 1


def test_preview_of_empty_and_constant_depth() -> None:
    assert not depth_preview(np.zeros((3, 4), np.float32))[0].any()
    assert not depth_preview(np.full((3, 4), np.nan, np.float32))[0].any()
    assert np.unique(depth_preview(np.full((3, 4), 2.0, np.float32))[0]).tolist() == [128]
