"""Corrections of the mistakes that a diagnosis looks for, each a function of one view, and the errors of a view.

A correction undoes a mistake: it returns the depth that the prediction would have been without it. The error of a
pixel is that of the rank error, |p - z| / max(p, z), between 0 and 1. Pixels without a valid prediction do not
count: a correction must not be judged by the places where a method has holes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt32
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import camera_from_row, iterate_rows
from rebar_depth_bench.data.schema import CAMERA_SHAPES
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.metrics import is_valid_prediction, median_scale
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.table import Truth
from rebar_depth_bench.submission import SubmissionReader

Values = Float64[ndarray, " n"]
Image = Float[ndarray, "h w"]

# Views that a diagnosis looks at: some of their scored pixels, and their predictions.

MAX_VIEWS = 8
"""Number of views of a config that are looked at, evenly spaced."""
MAX_PIXELS = 4000
"""Number of scored pixels of an eye that are looked at, evenly spaced in pixel order."""
MIN_PIXELS = 50
"""Scored pixels that a view must have to be looked at."""

COLUMNS = (
    *("left_depth", "left_mask", "right_depth", "right_mask", "baseline_m"),
    *(f"left_{kind}" for kind in CAMERA_SHAPES),
)
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

    ``prediction`` is the submitted image, H x W, meant to be planar depth in metres. ``by_order`` has, for each of
    the wrong orders of views, what was submitted for the view whose prediction it would be, at the pixels of the
    left eye.
    """

    position: int
    camera: Camera
    baseline_m: float
    left: Pixels
    right: Pixels
    prediction: Image
    by_order: Mapping[str, Values]

    @property
    def p(self) -> Values:
        """Prediction at the pixels of the left eye."""
        return self.left.values(self.prediction)


@dataclass(frozen=True, eq=False)
class KeptPredictions:
    """Predictions of a config that a diagnosis looks at: of a few views, and some pixels of others.

    ``pixels`` has the flat indices that are looked at in these views, by position in the config. ``images`` has
    the predictions of these views, and ``by_order`` the values that each wrong order of the views would put at the
    pixels of such a view. Both are filled by ``add``.
    """

    config: DatasetConfig
    pixels: dict[int, Int64[ndarray, " n"]] = field(default_factory=dict)
    images: dict[int, Image] = field(default_factory=dict)
    by_order: dict[tuple[int, str], Values] = field(default_factory=dict)

    @classmethod
    def of_truth(cls, config: DatasetConfig, truth: Truth) -> KeptPredictions:
        """Return none yet of the predictions of a config with this ground truth."""
        place = {view_id: place for place, view_id in enumerate(truth.view_ids)}
        views = {at: truth.views[place[config.view_ids[at]]] for at in positions_to_read(config)}
        return cls(config, {at: _looked_at(view.index) for at, view in views.items()})

    @classmethod
    def of_archive(cls, config: DatasetConfig, submission: SubmissionReader) -> KeptPredictions:
        """Return the predictions of a config that a diagnosis looks at, read from an archive.

        Raises ``EntryError`` and ``DatasetError`` for entries and shards that scoring refuses.
        """
        kept = cls(config)
        kept.pixels.update({at: left.v * config.grid[1] + left.u for at, (_, _, left, _) in kept.truths.items()})
        for position in {*kept.pixels, *kept.sources}:
            kept.add(position, submission.read(config.view_ids[position]))
        return kept

    @cached_property
    def truths(self) -> Mapping[int, tuple[Camera, float, Pixels, Pixels]]:
        """Ground truth of the views that are looked at, by position: camera, baseline, pixels of both eyes.

        It is read when it is first used. Raises ``DatasetError`` if a row is damaged.
        """
        config = self.config
        position = {config.view_ids[one]: one for one in positions_to_read(config)}
        truths = {}
        for row in iterate_rows(config, ("view_id", *COLUMNS), position) if position else ():
            left, right = (_pixels(row[f"{eye}_mask"], row[f"{eye}_depth"]) for eye in ("left", "right"))
            camera = camera_from_row(row, "left", config.grid)
            truths[position[row["view_id"]]] = camera, float(row["baseline_m"]), left, right
        return dict(sorted(truths.items()))

    @cached_property
    def sources(self) -> Mapping[int, Sequence[tuple[int, str]]]:
        """For the position of a prediction, the views that are looked at where wrong orders would put it."""
        found: dict[int, list[tuple[int, str]]] = {}
        for name, (_, source) in orders(len(self.config.views)).items():
            for position in positions_to_read(self.config):
                if 0 <= source(position) < len(self.config.views):
                    found.setdefault(source(position), []).append((position, name))
        return found

    def add(self, position: int, prediction: Image) -> None:
        """Keep what a diagnosis needs of the prediction for the view at a position of the config."""
        if position in self.pixels:
            self.images[position] = np.array(prediction)  # The caller may fill the same array again.
        for viewed, order in self.sources.get(position, ()):
            self.by_order[viewed, order] = prediction.ravel()[self.pixels[viewed]].astype(np.float64)

    def views(self) -> list[DiagnosedView]:
        """Return the views that are looked at, with their predictions. Raises ``DatasetError`` as ``truths``."""
        names = orders(len(self.config.views))
        views = []
        for position, (camera, baseline_m, left, right) in self.truths.items():
            absent = np.full(len(left.v), np.nan)
            by_order = {name: self.by_order.get((position, name), absent) for name in names}
            views.append(DiagnosedView(position, camera, baseline_m, left, right, self.images[position], by_order))
        return views


def positions_to_read(config: DatasetConfig) -> list[int]:
    """Return the positions of ``MAX_VIEWS`` evenly spaced views that have enough scored pixels.

    There are none in a config that lacks a column that is looked at, and in one that is not in a local folder.
    """
    if config.local is None or not config.absent_columns.isdisjoint(COLUMNS):
        return []
    usable = [n for n, view in enumerate(config.views) if view.scored_px >= MIN_PIXELS]
    count = min(len(usable), MAX_VIEWS)
    return [usable[n * len(usable) // count] for n in range(count)]


def _pixels(mask: Bool[ndarray, "h w"] | None, depth_m: Float32[ndarray, "h w"]) -> Pixels:
    v, u = np.divmod(_looked_at(scored_pixels(mask, depth_m)), depth_m.shape[1])
    return Pixels(v, u, depth_m[v, u].astype(np.float64))


def _looked_at(scored: UInt32[ndarray, " n"]) -> Int64[ndarray, " m"]:
    """Return at most ``MAX_PIXELS`` of the flat indices of scored pixels, evenly spaced."""
    return scored[:: -(-len(scored) // MAX_PIXELS) or 1].astype(np.int64)


def mean_error(p: Values, z_m: Values, scale: float | None = None) -> float:
    """Return the mean error of the valid pixels of ``scale * p``, 1 if there are none.

    The default scale is median(z) / median(p).
    """
    valid = is_valid_prediction(p)
    if not valid.any():
        return 1.0
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        scaled, z_m = p[valid] * (median_ratio(p, z_m) if scale is None else scale), z_m[valid]
        return float(np.mean(np.abs(scaled - z_m) / np.maximum(scaled, z_m)))


def median_ratio(p: Values, z_m: Values) -> float:
    """Return median(z) / median(p) over the valid predictions, NaN without any."""
    valid = is_valid_prediction(p)
    return median_scale(p[valid], float(np.median(z_m[valid]))) if valid.any() else math.nan


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


def relative_spread(values: Values) -> float:
    """Return the median deviation of the valid values from their median, as a share of it; 0 without any."""
    valid = values[is_valid_prediction(values)]
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.median(np.abs(valid / np.median(valid) - 1))) if valid.size else 0.0


def rank_correlation(p: Values, z_m: Values) -> float:
    """Return Spearman's rank correlation of valid predictions with depth, NaN if either has one value only."""
    valid = is_valid_prediction(p)
    ranks = []
    for values in (p[valid], z_m[valid]):
        _, index, counts = np.unique(values, return_inverse=True, return_counts=True)
        rank = np.cumsum(counts) - counts / 2  # Equal values share the mean of their ranks.
        ranks.append(rank[index] - len(values) / 2)
    norms = np.linalg.norm(ranks, axis=1)
    return float(np.dot(*ranks) / np.prod(norms)) if norms.all() else math.nan


def valid_share(p: Values) -> float:
    """Return the share of valid predictions."""
    return float(is_valid_prediction(p).mean())


UNITS: Mapping[str, float] = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1 / 0.0254}
"""Units in a metre."""
UNIT_TOLERANCE = 0.3
"""Largest natural logarithm of a factor, divided by the number of units in a metre, that suggests the unit."""
LARGEST_SCALE = 20.0
"""Factor up to which, or of 1 divided by it, a wrong scale is an error of the method; networks reach 12.6."""
SCALE_DEVIATION = 0.1
"""Least standard deviation over the views of the logarithm of a scale that no mistake explains."""
LOGARITHMS: Mapping[str, tuple[str, float]] = {
    "log": ("natural logarithms of depth in metres", 1.0),
    "log10": ("logarithms of depth in metres to base 10", math.log(10)),
}
"""Logarithms of depth, and the natural logarithm of their base."""
LOGARITHM_TOLERANCE = 0.3
"""Largest natural logarithm of a view's scale after a logarithm is undone; that of sound depth is above 0.8."""
NORMALISED_TOLERANCE = 0.005
"""Largest deviation from 1 of the largest value of a picture that was divided by its largest value."""
RELATIVE = '; if the network is relative, declare kind="{}" (prediction= of SubmissionWriter)'
"""Remedy of predictions that a kind other than metric describes."""
MAX_SHIFT_PX = 6
"""Largest shift that is looked for, pixels."""
BETTER_THAN_PLANE = 0.7
"""Largest error after an inversion, as a share of the error of a plane at the median depth.

A line fitted to predictions that have nothing to do with depth is such a plane.
"""


@dataclass(frozen=True)
class Correction:
    """Correction of a mistake: what the predictions seem to be, and the depth without it at the pixels of an eye.

    ``corrected`` returns NaN where there is none. Its errors and those of the prediction are compared as they are
    (``scale`` is None), after the scale of each view, or after one scale of all views, since a wrong order and
    inverse depth show between the views even where the range of depth within each is too small. A view is clearly
    better after the correction if its error is at most ``clearly_better`` of that before. ``remedy`` ends the
    description of the mistake.
    """

    name: str
    seems: str
    corrected: Callable[[DiagnosedView], Values]
    scale: Literal["view", "all"] | None = "view"
    eye: Literal["left", "right"] = "left"
    clearly_better: float = 0.8
    remedy: str = ""


def unit_corrections(views: Sequence[DiagnosedView], depth_scale: float | None = None) -> list[Correction]:
    """Return the corrections of depth divided by its largest value, and of the factor of all views if it is one.

    ``depth_scale`` is the scale of an archive of PNG images.
    """
    seems = "depth divided by the largest value of each picture"
    hint = RELATIVE.format("scale")
    corrections = [Correction("normalised", seems, _without_normalisation, scale=None, remedy=hint)]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        scales = np.log([median_ratio(view.p, view.left.depth_m) for view in views if valid_share(view.p)])
        factor, deviation = float(1 / np.exp(np.median(scales))), np.std(scales)
    if deviation < SCALE_DEVIATION and not 1 / LARGEST_SCALE <= factor <= LARGEST_SCALE:
        name, seems = "factor", f"{factor:.4g} times the depth in metres"
        for unit, units_in_metre in UNITS.items():
            if abs(math.log(factor / units_in_metre)) <= UNIT_TOLERANCE:
                name, seems, factor, hint = unit, f"in {unit}, {seems}", units_in_metre, ""
        if depth_scale:
            hint = f"; depth_scale is {depth_scale:g}, try {depth_scale / factor:.3g}"
        corrected = partial(_without_factor, factor=factor)
        corrections.append(Correction(name, seems, corrected, scale=None, remedy=hint))
    return corrections


def _without_factor(view: DiagnosedView, factor: float) -> Values:
    return view.p / factor


def _without_normalisation(view: DiagnosedView) -> Values:
    valid = view.prediction[is_valid_prediction(view.prediction)]
    is_normalised = valid.size and abs(valid.max() - 1) <= NORMALISED_TOLERANCE and np.ptp(view.p) != 0
    return view.p * (median_ratio(view.p, view.left.depth_m) if is_normalised else math.nan)


def logarithm_corrections() -> list[Correction]:
    """Return the corrections of logarithms of depth, of which those of depth below a metre are no valid depth."""
    return [
        Correction(name, seems, partial(_without_logarithm, log_base=log_base))
        for name, (seems, log_base) in LOGARITHMS.items()
    ]


def _without_logarithm(view: DiagnosedView, log_base: float) -> Values:
    with np.errstate(over="ignore", under="ignore"):
        depth_m = np.exp(view.p * log_base)
    scale = median_ratio(depth_m, view.left.depth_m)
    is_logarithm = scale > 0 and abs(math.log(scale)) <= LOGARITHM_TOLERANCE
    return depth_m if is_logarithm else np.full_like(depth_m, np.nan)


def shape_corrections(views: Sequence[DiagnosedView], count: int) -> list[Correction]:
    """Return the corrections of everything but units, for the ``views`` of a config that has ``count`` views."""
    height, width = views[0].prediction.shape
    turns = {**_TURNS, **(_QUARTER_TURNS if height == width else {})}
    dv, du = best_shift(views)
    pixels = "disparity in pixels instead of depth, which is focal length times baseline / disparity"
    inverse = "disparity or inverse depth instead of depth"
    hint = RELATIVE.format("affine-disparity")
    ray = "distances along the rays instead of depth along the optical axis"
    # Range and shift change most pixels by less than the errors of a method. The sound predictions of those in
    # "tests.mistakes" are not better than 0.98 after these corrections.
    corrections = [
        Correction("range", ray, _planar_depth, clearly_better=0.95),
        Correction("disparity", pixels, _depth_of_disparity, scale=None, clearly_better=0.5),
        Correction("inverse", inverse, _inverse, scale="all", clearly_better=0.7, remedy=hint),
        Correction("inverse", f"{inverse}, with a shift", _shifted_inverse, scale="all", remedy=hint),
        Correction("right-eye", "those of the right pictures", _at_right_pixels, eye="right"),
    ]
    for name, (seems, turn) in turns.items():
        corrections.append(Correction(name, seems, partial(_turned, turn=turn)))
    for name, (order, _) in orders(count).items():
        corrected = partial(_of_other_view, order=name)
        corrections.append(Correction(name, f"those of other views: {order}", corrected, scale="all"))
    if (dv, du) != (0, 0):
        seems = f"shifted by {du:+d} columns and {dv:+d} rows"
        corrections.append(Correction("shift", seems, partial(_shifted, dv=dv, du=du), clearly_better=0.75))
    return corrections


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


def orders(count: int) -> Mapping[str, tuple[str, Callable[[int], int]]]:
    """Return the wrong orders of ``count`` views, each with the position at which a view's prediction stands.

    A position outside the config means that the prediction of the view is missing.
    """
    as_text = sorted(range(count), key=str)
    position = {view: n for n, view in enumerate(as_text)}
    sorted_as_text = "sorted by numbers as text, 0, 1, 10, 100"
    return {
        "reversed": ("in reverse order", lambda view: count - 1 - view),
        "one-early": ("each is that of the next view", lambda view: view - 1),
        "one-late": ("each is that of the view before", lambda view: view + 1),
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
    return min(
        shifts,
        key=lambda shift: math.fsum(mean_error(_shifted(view, *shift), view.left.depth_m) for view in views),
    )


def _shifted(view: DiagnosedView, dv: int, du: int) -> Values:
    return view.left.values(view.prediction, dv, du)


def _planar_depth(view: DiagnosedView) -> Values:
    range_per_depth = np.linalg.norm(view.camera.rays(), axis=-1)[view.left.v, view.left.u]
    return np.asarray(view.p / range_per_depth)


def _inverse(view: DiagnosedView) -> Values:
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        return 1 / view.p


def _depth_of_disparity(view: DiagnosedView) -> Values:
    return np.asarray(view.camera.K[0, 0] * view.baseline_m * _inverse(view))


def _shifted_inverse(view: DiagnosedView) -> Values:
    """Return the depth of a line fitted to inverse depth, because disparity often has an offset."""
    p, z_m = view.p, view.left.depth_m
    valid = is_valid_prediction(p)
    slope, intercept = resistant_line(p[valid], 1 / z_m[valid]) if valid.any() else (0.0, 0.0)
    with np.errstate(invalid="ignore"):
        inverse = slope * p + intercept
    depth_m = np.divide(1, inverse, out=np.full_like(p, np.nan), where=valid & (inverse > 0))
    plane_error = mean_error(np.ones_like(z_m), z_m)
    is_better = slope > 0 and mean_error(depth_m, z_m, 1.0) <= BETTER_THAN_PLANE * plane_error
    return depth_m if is_better else np.full_like(p, np.nan)


def _at_right_pixels(view: DiagnosedView) -> Values:
    return view.right.values(view.prediction)


def _turned(view: DiagnosedView, turn: Callable[[Image], Image]) -> Values:
    return view.left.values(turn(view.prediction))


def _of_other_view(view: DiagnosedView, order: str) -> Values:
    return view.by_order[order]
