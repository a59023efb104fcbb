"""The full-frame score of the physical evaluation: no mask, only where a reference and a prediction have depth.

Paper, II.C: "Physical monocular scores use the full frame: pixels where that pseudo-reference is valid and the
prediction is finite and positive in the evaluation range". Numbers of a view are those of ``rebar-1`` on these
pixels (``scoring.score_view``), scaled by the view's own s = median(z)/median(p).

Every method against every reference, view by view: what the study of pseudo-references counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from rebar_depth_bench.data.ground_truth import ViewTruth
from rebar_depth_bench.errors import InputError
from rebar_depth_bench.parallel import ordered_map
from rebar_depth_bench.progress import Progress, silent
from rebar_depth_bench.scoring.result import ViewScore
from rebar_depth_bench.scoring.score import score_view
from rebar_depth_bench.studies.depth_source import DepthSource
from rebar_depth_bench.submission import EntryError


@dataclass(frozen=True)
class DepthRange:
    """The evaluation range: depths from ``near_m`` to ``far_m``, ends included, count; all others are none.

    Raises ``InputError`` unless 0 <= near < far.
    """

    near_m: float
    far_m: float

    def __post_init__(self) -> None:
        if not (0 <= self.near_m < self.far_m and not math.isnan(self.far_m)):
            raise InputError(f"the range is {self.near_m} to {self.far_m} m, expected 0 <= near < far")

    def words(self) -> str:
        """Return the range in words."""
        return f"{self.near_m:g} to {self.far_m:g} m"


@dataclass(frozen=True)
class FrameScore:
    """A prediction against a reference on one view. ``score`` is None where the reference has no pixel at all.

    ``score.coverage`` is the share of the reference's pixels that the prediction covers.
    """

    view_id: str
    frame_px: int
    reference_px: int
    score: ViewScore | None

    @property
    def frame_share(self) -> float:
        """The share of the frame that is scored: reference and prediction both have depth."""
        return 0.0 if self.score is None else self.score.coverage * self.reference_px / self.frame_px


@dataclass(frozen=True)
class Agreement:
    """One reference against another on one view: where both have depth.

    ``abs_rel`` = mean(|a - b| / b) and ``median_ratio`` = median(a / b) on the common pixels, None without any.
    """

    common_share: float
    abs_rel: float | None
    median_ratio: float | None


def usable(depth_m: Float[ndarray, "h w"], allowed: DepthRange) -> Float[ndarray, "h w"]:
    """Return the depth where it is finite, > 0 and in the range, NaN everywhere else. float16 becomes float32."""
    if depth_m.dtype == np.float16:  # the range's ends would be rounded to three digits
        depth_m = depth_m.astype(np.float32)
    with np.errstate(invalid="ignore"):
        kept = np.isfinite(depth_m) & (depth_m > 0) & (depth_m >= allowed.near_m) & (depth_m <= allowed.far_m)
    return np.asarray(np.where(kept, depth_m, np.nan))


def has_depth(usable_m: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return where a map that went through ``usable`` has depth."""
    return np.asarray(~np.isnan(usable_m))


def reference_pixels(view_id: str, reference_m: Float[ndarray, "h w"]) -> ViewTruth | None:
    """Return the pixels of a usable reference as what predictions are scored against, None without any."""
    index = np.flatnonzero(has_depth(reference_m)).astype(np.uint32)
    if not len(index):
        return None
    z_m = reference_m.ravel()[index].astype(np.float64)
    return ViewTruth(view_id, index, z_m, float(np.median(z_m)))


def frame_score(
    view_id: str, shape: tuple[int, int], truth: ViewTruth | None, prediction_m: Float[ndarray, "h w"] | None
) -> FrameScore:
    """Score a usable prediction, None where the view has none, on a reference's pixels."""
    frame_px = shape[0] * shape[1]
    if truth is None:
        return FrameScore(view_id, frame_px, 0, None)
    given_m = no_depth(shape) if prediction_m is None else prediction_m
    return FrameScore(view_id, frame_px, len(truth.index), score_view(truth, given_m))


def agreement(first_m: Float[ndarray, "h w"], other_m: Float[ndarray, "h w"]) -> Agreement:
    """Compare a usable reference a = ``first_m`` with another, b = ``other_m``, in float64."""
    common = has_depth(first_m) & has_depth(other_m)
    a_m: Float64[ndarray, " n"] = first_m[common].astype(np.float64)
    b_m: Float64[ndarray, " n"] = other_m[common].astype(np.float64)
    share = len(a_m) / first_m.size
    if not len(a_m):
        return Agreement(share, None, None)
    with np.errstate(over="ignore", under="ignore"):
        ratio = a_m / b_m
        return Agreement(share, float(np.mean(np.abs(ratio - 1))), float(np.median(ratio)))


def no_depth(shape: tuple[int, int]) -> Float[ndarray, "h w"]:
    """Return a map of (H, W) without depth anywhere."""
    return np.full(shape, np.nan, dtype=np.float32)


def only_on(usable_m: Float[ndarray, "h w"], pixels: Bool[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Return a usable map with no depth outside ``pixels``."""
    return np.where(pixels, usable_m, np.nan)


EXACT = "exact"
Map = Float[ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FrameView:
    """A view to score: its id, (H, W), and its exact depth in metres where there is any truth."""

    view_id: str
    shape: tuple[int, int]
    exact_m: Map | None = None


@dataclass(frozen=True)
class FrameOutcome:
    """One view: (method, reference) scores, the share of the frame that each reference covers, and how two agree.

    ``problems`` are (label of the source, sentence): then there is nothing else.
    """

    scores: Mapping[tuple[str, str], FrameScore] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    agreements: Mapping[tuple[str, str], Agreement] = field(default_factory=dict)
    problems: tuple[tuple[str, str], ...] = ()


def exact_on(reference: str) -> str:
    """Return the name of the exact depth restricted to the pixels of a pseudo-reference."""
    return f"{EXACT} where {reference} has depth"


def score_views(
    views: Iterable[FrameView],
    total: int,
    methods: Mapping[str, DepthSource],
    references: Mapping[str, DepthSource],
    allowed: DepthRange,
    workers: int | None = None,
    progress: Progress = silent,
) -> list[FrameOutcome]:
    """Score ``total`` views on ``workers`` threads; a few views are in memory at a time."""
    outcomes = []
    done = ordered_map(lambda view: score_one(view, methods, references, allowed), views, workers)
    for count, outcome in enumerate(done, start=1):
        outcomes.append(outcome)
        progress("scoring the full frame", count, total)
    return outcomes


def score_one(
    view: FrameView,
    methods: Mapping[str, DepthSource],
    references: Mapping[str, DepthSource],
    allowed: DepthRange,
) -> FrameOutcome:
    """Score one view of every method against every reference, and against the exact depth if there is any."""
    problems: list[tuple[str, str]] = []
    predictions = {name: _read(name, source, view, allowed, problems) for name, source in methods.items()}
    read = {name: _read(name, source, view, allowed, problems) for name, source in references.items()}
    pseudo = {name: no_depth(view.shape) if depth_m is None else depth_m for name, depth_m in read.items()}
    if problems:
        return FrameOutcome(problems=tuple(problems))
    maps = {**pseudo, **_exact_maps(view, pseudo, allowed)}
    scores, shares = {}, {}
    for name, reference_m in maps.items():
        truth = reference_pixels(view.view_id, reference_m)
        shares[name] = float(has_depth(reference_m).mean())
        for method, prediction_m in predictions.items():
            scores[method, name] = frame_score(view.view_id, view.shape, truth, prediction_m)
    compared = [*pseudo, *([EXACT] if EXACT in maps else [])]
    pairs = [(one, other) for one, other in permutations(compared, 2) if one != EXACT]
    return FrameOutcome(scores, shares, {pair: agreement(maps[pair[0]], maps[pair[1]]) for pair in pairs})


def _exact_maps(view: FrameView, pseudo: Mapping[str, Map], allowed: DepthRange) -> dict[str, Map]:
    """Return the exact depth, whole and on each pseudo-reference's pixels; nothing where there is no truth.

    The restricted ones tell the two effects of a pseudo-reference apart: other pixels, and wrong depth on them.
    """
    if view.exact_m is None:
        return {}
    exact_m = usable(view.exact_m, allowed)
    return {EXACT: exact_m} | {exact_on(name): only_on(exact_m, has_depth(one)) for name, one in pseudo.items()}


def _read(
    name: str, source: DepthSource, view: FrameView, allowed: DepthRange, problems: list[tuple[str, str]]
) -> Map | None:
    """Return a source's usable map of a view, None where it has none or what it has is refused."""
    if view.view_id not in source.view_ids:
        return None
    try:
        return usable(source.read(view.view_id), allowed)
    except EntryError as error:
        problems.append((name, error.problem))
        return None
