"""Views shown with images: their selection and order, and the images with their texts.

The images are colour, true and predicted depth on one scale, native and scaled error. All functions are pure;
colours come from ``rebar_depth_bench.reporting.colormap``.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8, UInt32
from numpy import ndarray
from PIL import Image

from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS, colour_indices, robust_range
from rebar_depth_bench.reporting.html.assets import data_uri
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.table import ViewScore

PANEL_WIDTH = 640
"""Approximate width of a panel, pixels; images are reduced by an integer factor."""

_NO_DEPTH_STRIPES = ((136, 136, 136), (112, 112, 112))
_NO_PREDICTION_STRIPES = ((240, 200, 0), (16, 16, 16))
_HATCH_PX = 4
_MAX_LIMIT_CM = 1e9
_SHARED_LIMIT_FACTOR = 3.0
"""Largest ratio of the colour limits of native and scaled error that are replaced by the larger one."""
_LIMIT_TOLERANCE = 1e-6  # An error of 30 cm in float32 is slightly more than 30 cm.
_ROUND_STEPS = (1, 2, 3, 5, 7, 10)
_BACKDROP_LEVELS = 16
_BACKDROP_MAX_LEVEL = 84


@dataclass(frozen=True)
class ViewPanels:
    """Arrays and scores of one view to be rendered; all arrays share H x W.

    ``rgb`` is uint8 H x W x 3, None in a config without colour; ``truth_m`` float32 metres, 0 without a surface;
    ``prediction_m`` float metres, not finite or <= 0 without a prediction; ``steel`` bool, rim included; ``score``
    holds the view's numbers. ``scored`` has the flat indices of the scored pixels.
    """

    rgb: UInt8[ndarray, "h w 3"] | None
    truth_m: Float32[ndarray, "h w"]
    prediction_m: Float[ndarray, "h w"]
    steel: Bool[ndarray, "h w"]
    scored: UInt32[ndarray, " n"]
    score: ViewScore


@dataclass(frozen=True)
class ShownView:
    """View shown with images: its numbers, its panels as WebP, and the texts of their colour bars.

    ``colour`` is None in a config without colour. Depth colours run from ``near`` to ``far`` for both ground truth
    and prediction, error colours from minus to plus ``native_limit`` or ``scaled_limit`` ("" if no scored pixel
    has an error). ``predicted`` is the text of ``range_text`` of the prediction on scored pixels ("" without any),
    which is ``off_scale`` if its robust range lies outside the colour bar.
    """

    score: ViewScore
    width: int
    height: int
    colour: bytes | None
    truth: bytes
    prediction: bytes
    native_error: bytes
    scaled_error: bytes
    near: str
    far: str
    predicted: str
    off_scale: bool
    native_limit: str
    scaled_limit: str

    @property
    def name(self) -> str:
        """Printable id of the view."""
        return printable(self.score.view_id)

    @property
    def config(self) -> str:
        """Printable name of the view's config."""
        return printable(config_of(self.score.view_id))


def shown_view(view: ViewPanels) -> ShownView:
    """Return a view with its encoded panels, which are about ``PANEL_WIDTH`` pixels wide."""
    step = max(1, round(view.truth_m.shape[1] / PANEL_WIDTH))
    scored = view.scored
    near_m, far_m = depth_range(view.truth_m, scored)
    predicted_m = view.prediction_m.ravel()[scored].astype(np.float64)
    predicted_m = predicted_m[is_valid_prediction(predicted_m)]
    low_m, high_m = robust_range(predicted_m) if predicted_m.size else (near_m, far_m)
    native_m = signed_error(view, 1.0)
    scaled_m = signed_error(view, view.score["scale"])
    native_limit, scaled_limit = (error_limit_cm(error_m, scored) for error_m in (native_m, scaled_m))
    if native_limit and scaled_limit:
        larger = max(native_limit, scaled_limit)
        if larger <= _SHARED_LIMIT_FACTOR * min(native_limit, scaled_limit):
            native_limit = scaled_limit = larger
    truth, steel = depth_image(view.truth_m[::step, ::step], near_m, far_m), view.steel[::step, ::step]
    # Colour is averaged over blocks of pixels; depth and error maps must be sampled instead.
    rgb = None if view.rgb is None else np.asarray(Image.fromarray(view.rgb).reduce(step))
    return ShownView(
        score=view.score,
        width=truth.shape[1],
        height=truth.shape[0],
        colour=None if rgb is None else _webp(rgb, lossless=False),
        truth=_webp(truth),
        prediction=_webp(depth_image(view.prediction_m[::step, ::step], near_m, far_m)),
        native_error=_webp(error_image(native_m[::step, ::step], steel, rgb, native_limit)),
        scaled_error=_webp(error_image(scaled_m[::step, ::step], steel, rgb, scaled_limit)),
        near=f"{_metres(near_m)} m",
        far=f"{_metres(far_m)} m",
        predicted=range_text(predicted_m) if predicted_m.size else "",
        off_scale=low_m > far_m or high_m < near_m,
        native_limit=_centimetres(native_limit),
        scaled_limit=_centimetres(scaled_limit),
    )


def _metres(value: float) -> str:
    if not 0.01 <= abs(value) < 1000:
        return f"{value:.3g}"
    return f"{value:#.3g}" if abs(value) < 10 else f"{value:.2f}"


def _centimetres(value: float | None) -> str:
    return "" if value is None else f"{value:g} cm"


def depth_range(truth_m: Float32[ndarray, "h w"], scored: ndarray) -> tuple[float, float]:
    """Return (near, far), metres: the robust range of true depth at the flat indices ``scored``, widened.

    The margin is a tenth of the range or 1 % of the near end at both ends, whichever is larger. Without scored
    pixels the range is that of all surfaces, and 0 to 1 m without any surface.
    """
    values = truth_m.ravel()[scored] if scored.size else truth_m[truth_m > 0]
    if not values.size:
        return 0.0, 1.0
    near, far = robust_range(values.astype(np.float64))
    margin = max(0.1 * (far - near), 0.01 * near)
    return near - margin, far + margin


def range_text(values_m: Float64[ndarray, " n"]) -> str:
    """Return the range of one or more depths, metres, as text.

    If the robust range is narrower than the whole one, both are stated, the robust one with the share of the
    values that lie in it, rounded down.
    """
    low, high = robust_range(values_m)
    inside = np.count_nonzero((values_m >= low) & (values_m <= high))
    robust, whole = (
        "–".join(dict.fromkeys(map(_metres, ends))) + " m"
        for ends in ((low, high), (values_m.min(), values_m.max()))
    )
    return whole if robust == whole else f"{robust} ({100 * inside // values_m.size} %), {whole} in all"


def signed_error(view: ViewPanels, scale: float) -> Float64[ndarray, "h w"]:
    """Return scale * prediction - truth, metres; NaN if either is missing, and outside the steel mask."""
    prediction = view.prediction_m.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        valid = view.steel & (view.truth_m > 0) & np.isfinite(prediction) & (prediction > 0)
        error = scale * prediction - view.truth_m
    return np.where(valid, error, np.nan)


def error_limit_cm(error_m: Float64[ndarray, "h w"], scored: ndarray) -> float | None:
    """Return the colour limit of an error map, cm, rounded up to one digit.

    It covers at least 95 % of the scored pixels' errors. The result is None if no scored pixel has an error.
    """
    errors = np.abs(error_m.ravel()[scored])
    errors = errors[np.isfinite(errors)]
    if not errors.size:
        return None
    percentile_cm = 100 * float(np.sort(errors)[math.ceil(0.95 * errors.size) - 1])
    return _rounded_up(min(max(percentile_cm, 0.01), _MAX_LIMIT_CM))


def depth_image(depth_m: Float[ndarray, "h w"], near_m: float, far_m: float) -> UInt8[ndarray, "h w 3"]:
    """Return depth in colours from near (bright) to far (dark), with grey hatching for pixels without depth."""
    with np.errstate(invalid="ignore"):
        present = np.isfinite(depth_m) & (depth_m > 0)
    image = hatching(depth_m.shape, *_NO_DEPTH_STRIPES)
    image[present] = DEPTH_COLOURS[colour_indices(depth_m[present], far_m, near_m)]
    return image


def error_image(
    error_m: Float64[ndarray, "h w"],
    steel: Bool[ndarray, "h w"],
    rgb: UInt8[ndarray, "h w 3"] | None,
    limit_cm: float | None,
) -> UInt8[ndarray, "h w 3"]:
    """Return signed error on steel in colours over the dimmed scene, hazard stripes without prediction.

    The backdrop is black without ``rgb``.
    """
    image = np.zeros((*steel.shape, 3), np.uint8) if rgb is None else _backdrop(rgb)
    missing = steel & np.isnan(error_m)
    image[missing] = hatching(steel.shape, *_NO_PREDICTION_STRIPES)[missing]
    valid = steel & ~missing
    if limit_cm is not None:
        image[valid] = ERROR_COLOURS[colour_indices(error_m[valid], -limit_cm / 100, limit_cm / 100)]
    return image


def hatching(
    shape: tuple[int, ...], first: tuple[int, int, int], second: tuple[int, int, int]
) -> UInt8[ndarray, "h w 3"]:
    """Return an image of diagonal stripes of two colours."""
    rows, columns = np.indices(shape)
    stripe = (rows + columns) // _HATCH_PX % 2
    image: ndarray = np.array((first, second), dtype=np.uint8)[stripe]
    return image


def colour_bar_uri(colours: UInt8[ndarray, "n 3"]) -> str:
    """Return a colour map as the data URI of a one-row PNG, first colour on the left."""
    out = io.BytesIO()
    Image.fromarray(colours[None]).save(out, "PNG", optimize=True)
    return data_uri(out.getvalue(), "png")


def _backdrop(rgb: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w 3"]:
    """Return the scene in dark grey with few levels, because noise in the backdrop would double the file size."""
    grey = rgb.astype(np.int64) @ np.array([2, 5, 1]) // 8
    dim = grey * _BACKDROP_LEVELS // 256 * _BACKDROP_MAX_LEVEL // (_BACKDROP_LEVELS - 1)
    return np.repeat(dim.astype(np.uint8)[..., None], 3, axis=2)


def _rounded_up(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return next(round(step * power, 6) for step in _ROUND_STEPS if step * power >= value * (1 - _LIMIT_TOLERANCE))


def _webp(image: UInt8[ndarray, "h w 3"], *, lossless: bool = True) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "WEBP", lossless=lossless, quality=70 if lossless else 80, method=4)
    return out.getvalue()


def worst_first(views: Iterable[ViewScore]) -> list[ViewScore]:
    """Return the views sorted by falling error."""
    return sorted(views, key=attrgetter("error"), reverse=True)


def views_to_show(views: Sequence[ViewScore], count: int) -> list[ViewScore]:
    """Return ``count`` views, worst first: half are the worst, the rest evenly spaced from there to the best.

    All views are returned if there are at most ``count``. A view without a value counts as worst. Raises
    ``InputError`` if ``count`` is negative.
    """
    if count < 0:
        raise InputError(f"views to show: {count}, expected 0 or more of each config")
    ordered = worst_first(views)
    if len(ordered) <= count:
        return ordered
    worst = (count + 1) // 2
    rest, spread = ordered[worst:], count - worst
    return ordered[:worst] + [rest[(n + 1) * len(rest) // spread - 1] for n in range(spread)]


def sorted_views(views: Iterable[ShownView], configs: Sequence[str]) -> list[ShownView]:
    """Return encoded views in the order of ``configs``, the worst view of each config first."""
    rank = {printable(config): number for number, config in enumerate(configs)}
    return sorted(
        views,
        key=lambda view: (rank.get(view.config, len(rank)), -view.score.error, view.score.view_id),
    )
