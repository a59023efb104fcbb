"""Point clouds of one view in the world frame, metres: its ground truth, and predictions native and scaled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.cameras import inverse_rigid, transform
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS, colour_indices, robust_range
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median, median_scale
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.viewing.view import ShownView

STEEL, SURROUNDINGS, BACKGROUND = "steel", "surroundings", "background"
"""Parts of every cloud: the pixels of the steel mask, others near the steel, and those farther away."""
_BACKGROUND_RATIO = 1.25
"""The background begins at this multiple of the largest depth of steel."""
MAX_DEPTH_RATIO = 4.0
"""Predicted points beyond this multiple of the largest true depth are left out: they would shrink the picture."""
_COLOURS = ("0072b2", "d55e00", "009e73", "a0488a", "b07800", "2f7f9f")
"""Colours of archives, as in the figure; they repeat."""
_SCALED_TINT = 0.45
"""Share of white in the colour of a scaled prediction."""

Colour = UInt8[ndarray, " 3"]


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in the world frame, metres; ``radii_m`` are half the size of their pixels, ``colours`` are sRGB."""

    points_m: Float64[ndarray, "n 3"]
    radii_m: Float64[ndarray, " n"]
    colours: UInt8[ndarray, "n 3"]


Clouds = Mapping[str, PointCloud]
"""Clouds of ``STEEL``, ``SURROUNDINGS`` and ``BACKGROUND``."""


@dataclass(frozen=True, eq=False)
class PredictionClouds:
    """Prediction of one archive.

    ``scale`` is that of the protocol; ``scale`` and ``scaled`` are None where the view has no valid prediction on
    its scored pixels, or a scale that is no positive number. ``too_far`` counts native points that are left out.
    """

    name: str
    native: Clouds
    scaled: Clouds | None
    scale: float | None
    too_far: int


def truth_clouds(view: ShownView) -> Clouds:
    """Return the ground truth of all pixels that have any, coloured by the left image, or by depth without one."""
    left = view.left
    colours = left.rgb if left.rgb is not None else _depth_colours(left.depth_m)
    return _clouds(view, left.depth_m, left.depth_m > 0, colours)


def prediction_clouds(
    view: ShownView, name: str, predicted_m: Float[ndarray, "h w"], colour: Colour, error_limit_m: float | None
) -> PredictionClouds:
    """Return a prediction (planar depth, metres) on the pixels that have ground truth and a valid prediction.

    With ``error_limit_m`` the points are coloured by predicted - true depth, saturated at that error, instead of
    by ``colour``.
    """
    truth_m = view.left.depth_m
    valid = is_valid_prediction(predicted_m) & (truth_m > 0)
    scale = _protocol_scale(view, predicted_m)

    def clouds(scale: float, tint: Colour) -> tuple[Clouds, int]:
        with np.errstate(over="ignore", invalid="ignore"):
            depth_m = predicted_m.astype(np.float64) * scale
            near = valid & (depth_m <= MAX_DEPTH_RATIO * truth_m.max(initial=0.0))
            error_m = depth_m - truth_m
        if error_limit_m is None:
            colours = np.broadcast_to(tint, (*truth_m.shape, 3))
        else:
            colours = ERROR_COLOURS[colour_indices(error_m, -error_limit_m, error_limit_m)]
        return _clouds(view, depth_m, near, colours), int(np.count_nonzero(valid & ~near))

    native, too_far = clouds(1.0, colour)
    scaled = None if scale is None else clouds(scale, _tinted(colour))[0]
    return PredictionClouds(name, native, scaled, scale, too_far)


def archive_colour(index: int) -> Colour:
    """Return the colour of the archive at a position."""
    return np.frombuffer(bytes.fromhex(_COLOURS[index % len(_COLOURS)]), dtype=np.uint8)


def _tinted(colour: Colour) -> Colour:
    tinted: Colour = np.rint(colour * (1 - _SCALED_TINT) + 255 * _SCALED_TINT).astype(np.uint8)
    return tinted


def _protocol_scale(view: ShownView, predicted_m: Float[ndarray, "h w"]) -> float | None:
    """Return median(truth) / median(prediction) on the scored pixels with a valid prediction, or None."""
    pixels = scored_pixels(view.left.mask, view.left.depth_m)
    p_m, z_m = predicted_m.ravel()[pixels], view.left.depth_m.ravel()[pixels]
    valid = is_valid_prediction(p_m)
    if not valid.any():
        return None
    scale = median_scale(p_m[valid], median(z_m[valid]))
    return scale if 0 < scale < math.inf else None


def _clouds(
    view: ShownView, depth_m: Float[ndarray, "h w"], shown: Bool[ndarray, "h w"], colours: UInt8[ndarray, "h w 3"]
) -> Clouds:
    world_from_cam = inverse_rigid(view.left.camera.cam_from_world)
    focal_px = view.left.camera.K[0, 0]
    clouds = {}
    for part, belongs in _parts(view).items():
        pixels = shown & belongs
        part_depth_m = depth_m[pixels].astype(np.float64)
        points_m = transform(world_from_cam, view.rays[pixels] * part_depth_m[:, None])
        clouds[part] = PointCloud(points_m, part_depth_m / (2 * focal_px), colours[pixels])
    return clouds


def _parts(view: ShownView) -> dict[str, Bool[ndarray, "h w"]]:
    """Return which pixels belong to each part; without steel none is background, without a mask all are steel."""
    mask, depth_m = view.left.mask, view.left.depth_m
    steel = np.ones(depth_m.shape, dtype=bool) if mask is None else mask
    is_far = depth_m > _BACKGROUND_RATIO * depth_m[steel].max(initial=0.0) if steel.any() else np.zeros_like(steel)
    return {STEEL: steel, SURROUNDINGS: ~steel & ~is_far, BACKGROUND: ~steel & is_far}


def _depth_colours(depth_m: Float[ndarray, "h w"]) -> UInt8[ndarray, "h w 3"]:
    surface = depth_m > 0
    if not surface.any():
        return np.zeros((*depth_m.shape, 3), dtype=np.uint8)
    near_m, far_m = robust_range(depth_m[surface])
    colours: ndarray = DEPTH_COLOURS[colour_indices(depth_m, far_m, near_m)]
    return colours
