"""Corrections of the mistakes that a diagnosis looks for, each a function of one view, and the errors of a view.

A correction undoes a mistake and returns the errors of the prediction before and after. All but those of units are
independent of the scale of the predictions. The error of a pixel is that of the rank error, |p - z| / max(p, z),
between 0 and 1. Pixels without a valid prediction do not count: a correction must not be judged by the places
where a method has holes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import CAMERA_SHAPES
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.evaluation import View
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median_scale
from rebar_depth_bench.scoring.protocol import scored_pixels

Values = Float64[ndarray, " n"]
Image = Float[ndarray, "h w"]

# Views that a diagnosis looks at: some of their scored pixels, and their predictions.

MAX_VIEWS = 8
"""Number of views of a config that are looked at, evenly spaced."""
MAX_PIXELS = 4000
"""Number of scored pixels of an eye that are looked at, evenly spaced in pixel order."""
MIN_PIXELS = 50
"""Scored pixels that a view must have to be looked at."""

COLUMNS = (*("left_depth", "left_mask", "right_depth", "right_mask"), *(f"left_{kind}" for kind in CAMERA_SHAPES))
"""Columns that are looked at."""


@dataclass(frozen=True, eq=False)
class Pixels:
    """Scored pixels of an eye: rows ``v``, columns ``u``, and planar depth in metres."""

    v: Int64[ndarray, " n"]
    u: Int64[ndarray, " n"]
    depth_m: Float64[ndarray, " n"]

    def values(self, image: Image, dv: int = 0, du: int = 0) -> Values:
        """Return the values of an image ``dv`` rows below and ``du`` columns to the right; NaN outside of it."""
        v, u = self.v + dv, self.u + du
        height, width = image.shape
        inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
        values = np.full(len(v), np.nan)
        values[inside] = image[v[inside], u[inside]]
        return values


@dataclass(frozen=True, eq=False)
class DiagnosedView:
    """Ground truth and prediction of a view; ``position`` counts the views of its config.

    ``prediction`` is the submitted image, H x W, meant to be planar depth in metres.
    """

    position: int
    camera: Camera
    left: Pixels
    right: Pixels
    prediction: Image

    @property
    def p(self) -> Values:
        """Prediction at the pixels of the left eye."""
        return self.left.values(self.prediction)


def positions_to_read(config: DatasetConfig) -> list[int]:
    """Return the positions of ``MAX_VIEWS`` evenly spaced views that have enough scored pixels.

    There are none in a config that lacks a column that is looked at, and in one that is not in a local folder.
    """
    if config.local is None or not config.absent_columns.isdisjoint(COLUMNS):
        return []
    usable = [n for n, view in enumerate(config.views) if view.scored_px >= MIN_PIXELS]
    count = min(len(usable), MAX_VIEWS)
    return [usable[n * len(usable) // count] for n in range(count)]


def diagnosed_view(view: View) -> DiagnosedView:
    """Return what a diagnosis needs of a view. Raises ``EntryError`` for an invalid entry of the archive."""
    left, right = (_pixels(view.cell(f"{eye}_mask"), view.cell(f"{eye}_depth")) for eye in ("left", "right"))
    return DiagnosedView(view.position, view.camera("left"), left, right, view.prediction_m)


def _pixels(mask: Bool[ndarray, "h w"] | None, depth_m: Float32[ndarray, "h w"]) -> Pixels:
    index = scored_pixels(mask, depth_m).astype(np.int64)
    index = index[:: -(-len(index) // MAX_PIXELS) or 1]
    v, u = np.divmod(index, depth_m.shape[1])
    return Pixels(v, u, depth_m[v, u].astype(np.float64))


def pixel_errors(p: Values, z_m: Values, scale: float | None = None) -> Values:
    """Return the errors of the valid pixels of ``scale * p``, by default after the scale median(z) / median(p)."""
    valid = is_valid_prediction(p)
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        scaled, z_m = p[valid] * (median_ratio(p, z_m) if scale is None else scale), z_m[valid]
        return np.asarray(np.abs(scaled - z_m) / np.maximum(scaled, z_m))


def mean_error(p: Values, z_m: Values, scale: float | None = None) -> float:
    """Return the mean of ``pixel_errors``, NaN without any; no pixel counts for more than 1."""
    errors = pixel_errors(p, z_m, scale)
    return float(np.mean(errors)) if errors.size else math.nan


def median_ratio(p: Values, z_m: Values) -> float:
    """Return median(z) / median(p) over the valid predictions, NaN without any."""
    valid = is_valid_prediction(p)
    return median_scale(p[valid], float(np.median(z_m[valid]))) if valid.any() else math.nan


def line_error(p: Values, z_m: Values, of_depth: Callable[[Values], Values]) -> float:
    """Return the median error after a rising line from p to ``of_depth(z)`` has been fitted.

    ``of_depth`` is a monotonic function that is its own inverse: the identity, or the reciprocal for predictions
    of disparity. NaN if no line rises.
    """
    valid = is_valid_prediction(p)
    if not valid.any():
        return math.nan
    p, z_m = p[valid], z_m[valid]
    slope, intercept = resistant_line(p, of_depth(z_m))
    if not slope > 0:
        return math.nan
    fitted = slope * p + intercept
    return _median(pixel_errors(of_depth(np.where(fitted > 0, fitted, np.nan)), z_m, 1.0))


def resistant_line(x: Values, y: Values) -> tuple[float, float]:
    """Return slope and intercept of Tukey's resistant line, which outliers do not bend.

    The slope is that between the medians of the lowest and the highest third of x, 0 if these are equal; the
    intercept is the median of what remains (Tukey, "Exploratory Data Analysis", 1977, chapter 5).
    """
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)
    low, high = order[:third], order[-third:]
    run = float(np.median(x[high]) - np.median(x[low]))
    slope = float(np.median(y[high]) - np.median(y[low])) / run if run > 0 else 0.0
    return slope, float(np.median(y - slope * x))


def _median(errors: Values) -> float:
    return float(np.median(errors)) if errors.size else math.nan


def valid_share(p: Values) -> float:
    """Return the share of valid predictions."""
    return float(is_valid_prediction(p).mean())


ReadPrediction = Callable[[int], Image]
"""Function that returns the prediction submitted for the view at a position of the config."""

UNITS: Mapping[str, float] = {
    "millimetres": 1000.0,
    "centimetres": 100.0,
    "inches": 1 / 0.0254,
    "feet": 1 / 0.3048,
}
"""Units in a metre."""
LOGARITHMS: Mapping[str, tuple[str, float]] = {
    "log": ("natural logarithms of depth in metres", 1.0),
    "log10": ("logarithms of depth in metres to base 10", math.log(10)),
}
"""Logarithms of depth, and the natural logarithm of their base."""
LOGARITHM_TOLERANCE = 0.3
"""Largest natural logarithm of a view's scale after a logarithm is undone; that of sound depth is above 0.8."""
NORMALISED_TOLERANCE = 0.005
"""Largest deviation from 1 of the largest value of a picture that was divided by its largest value."""
UNIT_TOLERANCE = 0.06
"""Largest deviation of a view's scale from that of a unit, as a share of the unit's logarithm.

A wrong scale can have any size, so that the deviation must be the smaller the closer a unit is to the metre: a
factor of 1.5 for millimetres, of 1.07 for feet.
"""
MAX_SHIFT_PX = 6
"""Largest shift that is looked for, pixels."""
BETTER_THAN_PLANE = 0.7
"""Largest error after an inversion, as a share of that of a plane at the median depth.

A line fitted to predictions that have nothing to do with depth is such a plane.
"""
LEAST_VALID_SHARE = 0.8
"""Least number of valid pixels after a correction, as a share of those before."""


@dataclass(frozen=True)
class Errors:
    """Errors of a view's prediction as it was submitted, and after a correction; NaN where there is none."""

    before: float
    after: float


@dataclass(frozen=True)
class Correction:
    """Correction of a mistake: what the predictions seem to be, what the errors are, and the errors of a view.

    A view is clearly better after the correction if its error is at most ``clearly_better`` of that before.
    ``remedy`` ends the description of the mistake.
    """

    name: str
    seems: str
    measure: str
    errors: Callable[[DiagnosedView], Errors]
    clearly_better: float = 0.8
    remedy: str = ""


def unit_corrections() -> list[Correction]:
    """Return the corrections of depth in other units than metres: those of ``UNITS``, or the largest value."""
    units = [
        Correction(unit, f"in {unit}", "mean error", partial(_unit_errors, units_in_metre=units_in_metre))
        for unit, units_in_metre in UNITS.items()
    ]
    seems = "depth divided by the largest value of each picture"
    return [*units, Correction("normalised", seems, "mean error", _normalised_errors)]


def _unit_errors(view: DiagnosedView, units_in_metre: float) -> Errors:
    p, z_m = view.p, view.left.depth_m
    before, scale = mean_error(p, z_m, 1.0), median_ratio(p, z_m) * units_in_metre
    # One depth for every pixel can be near any unit by chance.
    is_unit = scale > 0 and abs(math.log(scale)) <= UNIT_TOLERANCE * math.log(units_in_metre) and np.ptp(p) != 0
    return Errors(before, mean_error(p, z_m, 1 / units_in_metre) if is_unit else math.nan)


def _normalised_errors(view: DiagnosedView) -> Errors:
    p, z_m = view.p, view.left.depth_m
    valid = view.prediction[is_valid_prediction(view.prediction)]
    is_normalised = valid.size and abs(valid.max() - 1) <= NORMALISED_TOLERANCE and np.ptp(p) != 0
    return Errors(mean_error(p, z_m, 1.0), mean_error(p, z_m) if is_normalised else math.nan)


def logarithm_corrections() -> list[Correction]:
    """Return the corrections of logarithms of depth, of which those of depth below a metre are no valid depth."""
    measure = f"{_SCALED}, 100 % at values of 0 and less,"
    return [
        Correction(name, seems, measure, partial(_logarithm_errors, log_base=log_base))
        for name, (seems, log_base) in LOGARITHMS.items()
    ]


def _logarithm_errors(view: DiagnosedView, log_base: float) -> Errors:
    p = view.p
    finite = np.isfinite(p)  # Holes of a method do not count.
    if not finite.any():
        return Errors(math.nan, math.nan)
    p, z_m = p[finite], view.left.depth_m[finite]
    coverage = valid_share(p)
    before = 1 - coverage * (1 - mean_error(p, z_m)) if coverage else 1.0
    with np.errstate(over="ignore", under="ignore"):
        depth_m = np.exp(p * log_base)
    scale = median_ratio(depth_m, z_m)
    is_logarithm = scale > 0 and abs(math.log(scale)) <= LOGARITHM_TOLERANCE and np.ptp(p) != 0
    is_comparable = is_logarithm and valid_share(depth_m) >= LEAST_VALID_SHARE
    return Errors(before, mean_error(depth_m, z_m) if is_comparable else math.nan)


def shape_corrections(views: Sequence[DiagnosedView], read: ReadPrediction, count: int) -> list[Correction]:
    """Return the corrections of everything but units, for the ``views`` of a config that has ``count`` views."""
    height, width = views[0].prediction.shape
    turns = {**_TURNS, **(_QUARTER_TURNS if height == width else {})}
    dv, du = best_shift(views)
    hint = '; if the network is relative, declare kind="affine-disparity" (prediction= of SubmissionWriter)'
    ray = "distances along the rays instead of depth along the optical axis"
    # Range and shift change most pixels by less than the errors of a method. The sound predictions of those in
    # "tests.mistakes" are not better than 0.98 after these corrections.
    corrections = [
        Correction("range", ray, _SCALED, _range_errors, clearly_better=0.95),
        Correction(
            "inverse", "disparity or inverse depth instead of depth", _FITTED, _inverse_errors, remedy=hint
        ),
        Correction("right-eye", "those of the right pictures", _SCALED, _right_eye_errors),
    ]
    for name, (seems, turn) in turns.items():
        corrections.append(Correction(name, seems, _SCALED, partial(_turned_errors, turn=turn)))
    for name, (order, source) in _orders(count).items():
        errors = partial(_order_errors, source=source, read=read)
        corrections.append(Correction(name, f"those of other views: {order}", _SCALED, errors))
    if (dv, du) != (0, 0):
        seems = f"shifted by {du:+d} columns and {dv:+d} rows"
        errors = partial(_shift_errors, dv=dv, du=du)
        corrections.append(Correction("shift", seems, _SCALED, errors, clearly_better=0.9))
    return corrections


_SCALED = "mean error after scaling"
_FITTED = "median error after scaling and shifting"
_TURNS: Mapping[str, tuple[str, Callable[[Image], Image]]] = {
    "mirrored": ("mirrored left to right", np.fliplr),
    "upside-down": ("mirrored upside down", np.flipud),
    "rotated": ("rotated by 180 degrees", partial(np.rot90, k=2)),
}
"""Ways to turn a picture, and how to undo them."""
_QUARTER_TURNS: Mapping[str, tuple[str, Callable[[Image], Image]]] = {
    "quarter-left": ("rotated by 90 degrees counter-clockwise", partial(np.rot90, k=-1)),
    "quarter-right": ("rotated by 90 degrees clockwise", np.rot90),
    "transposed": ("transposed: rows and columns exchanged", np.transpose),
}
"""The same for square pictures."""


def _orders(count: int) -> Mapping[str, tuple[str, Callable[[int], int]]]:
    """Return the wrong orders of ``count`` views, each with the position at which a view's prediction stands."""
    as_text = sorted(range(count), key=str)
    position = {view: n for n, view in enumerate(as_text)}
    sorted_as_text = "sorted by numbers as text, 0, 1, 10, 100"
    return {
        "reversed": ("in reverse order", lambda view: count - 1 - view),
        "one-early": ("each is that of the next view", lambda view: max(view - 1, 0)),
        "one-late": ("each is that of the view before", lambda view: min(view + 1, count - 1)),
        "as-text": (sorted_as_text, lambda view: position[view]),
        "from-text": (f"read as if they had been {sorted_as_text}", lambda view: as_text[view]),
    }


def best_shift(views: Sequence[DiagnosedView]) -> tuple[int, int]:
    """Return the rows and columns by which the predictions of all views are shifted, at most ``MAX_SHIFT_PX``.

    It is the shift without which the mean error over the views is smallest.
    """
    steps = range(-MAX_SHIFT_PX, MAX_SHIFT_PX + 1)
    shifts = sorted(
        ((dv, du) for dv in steps for du in steps), key=lambda shift: (abs(shift[0]) + abs(shift[1]), shift)
    )
    return min(shifts, key=lambda shift: math.fsum(_shift_errors(view, *shift).after for view in views))


def _shift_errors(view: DiagnosedView, dv: int, du: int) -> Errors:
    return _errors(view, view.left.values(view.prediction, dv, du))


def _range_errors(view: DiagnosedView) -> Errors:
    range_per_depth = np.linalg.norm(view.camera.rays(), axis=-1)[view.left.v, view.left.u]
    return _errors(view, view.p / range_per_depth)


def _inverse_errors(view: DiagnosedView) -> Errors:
    """Return the errors of lines fitted to depth and to inverse depth, because disparity often has an offset."""
    p, z_m = view.p, view.left.depth_m
    as_depth, as_inverse = line_error(p, z_m, np.positive), line_error(p, z_m, np.reciprocal)
    # A plane at the median depth is the line fitted to nothing but noise; no rising line describes more.
    plane = _median(pixel_errors(np.ones_like(z_m), z_m))
    before = plane if math.isnan(as_depth) else as_depth
    return Errors(before, as_inverse if as_inverse <= BETTER_THAN_PLANE * plane else math.nan)


def _right_eye_errors(view: DiagnosedView) -> Errors:
    return _errors(view, view.right.values(view.prediction), view.right.depth_m)


def _turned_errors(view: DiagnosedView, turn: Callable[[Image], Image]) -> Errors:
    return _errors(view, view.left.values(turn(view.prediction)))


def _order_errors(view: DiagnosedView, source: Callable[[int], int], read: ReadPrediction) -> Errors:
    return _errors(view, view.left.values(read(source(view.position))))


def _errors(view: DiagnosedView, corrected: Values, corrected_z_m: Values | None = None) -> Errors:
    """Return the errors after scaling of the prediction, and of the corrected values unless fewer are valid.

    ``corrected_z_m`` is the true depth of the corrected values, by default that of the left eye.
    """
    p, z_m = view.p, view.left.depth_m
    is_comparable = valid_share(corrected) >= LEAST_VALID_SHARE * valid_share(p)
    after = mean_error(corrected, z_m if corrected_z_m is None else corrected_z_m) if is_comparable else math.nan
    return Errors(mean_error(p, z_m), after)
