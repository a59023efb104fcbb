"""Pseudo-reference study: full-frame scores of every method against every reference, view by view.

Instead of a steel mask, the scored pixels are those where both reference and prediction have depth. Paper, II.C:
"Physical monocular scores use the full frame: pixels where that pseudo-reference is valid and the prediction is
finite and positive in the evaluation range". The metrics of a view are those of ``rebar-2`` on these pixels
(``scoring.score.score_view``), scaled by the view's own s = median(z) / median(p).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy import ndarray

from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.scoring.ground_truth import ViewTruth
from rebar_depth_bench.scoring.score import score_view
from rebar_depth_bench.scoring.view_score import ViewScore
from rebar_depth_bench.studies.depth_source import DepthSource
from rebar_depth_bench.submission import EntryError


@dataclass(frozen=True)
class DepthRange:
    """Evaluation range [``near_m``, ``far_m``] in metres; values outside it are treated as missing.

    Raises ``InputError`` unless 0 <= near < far.
    """

    near_m: float
    far_m: float

    def __post_init__(self) -> None:
        if not (0 <= self.near_m < self.far_m and not math.isnan(self.far_m)):
            raise InputError(f"the range is {self.near_m} to {self.far_m} m, expected 0 <= near < far")

    def describe(self) -> str:
        """Return the range as text, such as ``0.1 to 20 m``."""
        return f"{self.near_m:g} to {self.far_m:g} m"


@dataclass(frozen=True)
class FrameScore:
    """Score of a prediction against a reference on one view.

    ``score`` is None if the reference has no depth in the view; ``score.coverage`` is the fraction of the
    reference's pixels with a valid prediction.
    """

    frame_px: int
    reference_px: int
    score: ViewScore | None

    @property
    def frame_share(self) -> float:
        """Return the fraction of the frame that is scored, where reference and prediction both have depth."""
        return 0.0 if self.score is None else self.score.coverage * self.reference_px / self.frame_px


@dataclass(frozen=True)
class Agreement:
    """Agreement of a reference a with another reference b on one view.

    ``common_share`` is the fraction of the frame where both have depth. On these pixels, ``abs_rel`` =
    mean(|a - b| / b) and ``median_ratio`` = median(a / b); both are None if there are no common pixels.
    """

    common_share: float
    abs_rel: float | None
    median_ratio: float | None


def mask_invalid_depth(depth_m: Float[ndarray, "h w"], depth_range: DepthRange) -> Float[ndarray, "h w"]:
    """Return the depth map with NaN wherever it is not finite, not > 0 or outside the range.

    A float16 map is converted to float32.
    """
    if depth_m.dtype == np.float16:
        # In float16 the ends of the range would be rounded to three digits.
        depth_m = depth_m.astype(np.float32)
    with np.errstate(invalid="ignore"):
        valid = (
            np.isfinite(depth_m) & (depth_m > 0) & (depth_m >= depth_range.near_m) & (depth_m <= depth_range.far_m)
        )
    return np.asarray(np.where(valid, depth_m, np.nan))


def has_depth(masked_m: Float[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Return the mask of the pixels with depth of a map from ``mask_invalid_depth``."""
    return np.asarray(~np.isnan(masked_m))


def reference_as_truth(view_id: str, reference_m: Float[ndarray, "h w"]) -> ViewTruth | None:
    """Return a masked reference as the ground truth to score predictions against, None if it has no depth."""
    index = np.flatnonzero(has_depth(reference_m)).astype(np.uint32)
    if not len(index):
        return None
    z_m = reference_m.ravel()[index].astype(np.float64)
    return ViewTruth(view_id, index, z_m, float(np.median(z_m)))


def score_frame(truth: ViewTruth | None, prediction_m: Float[ndarray, "h w"]) -> FrameScore:
    """Score a masked prediction on a reference's pixels; ``truth`` is None if that has no depth in the view."""
    if truth is None:
        return FrameScore(prediction_m.size, 0, None)
    return FrameScore(prediction_m.size, len(truth.index), score_view(truth, prediction_m))


def compare_references(first_m: Float[ndarray, "h w"], other_m: Float[ndarray, "h w"]) -> Agreement:
    """Compare a masked reference a = ``first_m`` with another one, b = ``other_m``, in float64."""
    common = has_depth(first_m) & has_depth(other_m)
    a_m: Float64[ndarray, " n"] = first_m[common].astype(np.float64)
    b_m: Float64[ndarray, " n"] = other_m[common].astype(np.float64)
    share = len(a_m) / first_m.size
    if not len(a_m):
        return Agreement(share, None, None)
    with np.errstate(over="ignore", under="ignore"):
        ratio = a_m / b_m
        return Agreement(share, float(np.mean(np.abs(ratio - 1))), float(np.median(ratio)))


def restrict_to_pixels(masked_m: Float[ndarray, "h w"], pixels: Bool[ndarray, "h w"]) -> Float[ndarray, "h w"]:
    """Return a masked map without depth outside the mask ``pixels``."""
    return np.where(pixels, masked_m, np.nan)


EXACT_LABEL = "exact"
"""Label of the exact depth of a dataset folder as a reference."""
DepthMap = Float[ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class FrameView:
    """View to score: id, (H, W), and its exact depth in metres if there is ground truth."""

    view_id: str
    shape: tuple[int, int]
    exact_m: DepthMap | None = None


@dataclass(frozen=True)
class FrameOutcome:
    """Outcome of one view.

    ``scores`` is keyed by (method, reference), ``shares`` (fraction of the frame with depth) by reference, and
    ``agreements`` by pairs of references. ``problems`` are (source label, problem); if there are any, the other
    fields are empty.
    """

    scores: Mapping[tuple[str, str], FrameScore] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    agreements: Mapping[tuple[str, str], Agreement] = field(default_factory=dict)
    problems: tuple[tuple[str, Problem], ...] = ()


def exact_label_within(reference: str) -> str:
    """Return the label of the exact depth restricted to the pixels of a pseudo-reference."""
    return f"{EXACT_LABEL} where {reference} has depth"


def score_frame_view(
    view: FrameView,
    methods: Mapping[str, DepthSource],
    references: Mapping[str, DepthSource],
    depth_range: DepthRange,
) -> FrameOutcome:
    """Score one view of every method against every reference, and against the exact depth if available."""
    problems: list[tuple[str, Problem]] = []
    predictions = {
        name: _read_depth(name, source, view, depth_range, problems) for name, source in methods.items()
    }
    pseudo = {name: _read_depth(name, source, view, depth_range, problems) for name, source in references.items()}
    if problems:
        return FrameOutcome(problems=tuple(problems))
    maps = {**pseudo, **_exact_maps(view, pseudo, depth_range)}
    scores, shares = {}, {}
    for name, reference_m in maps.items():
        truth = reference_as_truth(view.view_id, reference_m)
        shares[name] = float(has_depth(reference_m).mean())
        for method, prediction_m in predictions.items():
            scores[method, name] = score_frame(truth, prediction_m)
    compared = [*pseudo, *([EXACT_LABEL] if EXACT_LABEL in maps else [])]
    pairs = [(first, other) for first, other in permutations(compared, 2) if first != EXACT_LABEL]
    return FrameOutcome(scores, shares, {pair: compare_references(maps[pair[0]], maps[pair[1]]) for pair in pairs})


def _exact_maps(view: FrameView, pseudo: Mapping[str, DepthMap], depth_range: DepthRange) -> dict[str, DepthMap]:
    """Return the exact depth by label: whole, and restricted to the pixels of each pseudo-reference.

    The restricted maps separate the two effects of a pseudo-reference: a different set of pixels, and wrong depth
    on these pixels. The result is empty if the view has no ground truth.
    """
    if view.exact_m is None:
        return {}
    exact_m = mask_invalid_depth(view.exact_m, depth_range)
    return {EXACT_LABEL: exact_m} | {
        exact_label_within(name): restrict_to_pixels(exact_m, has_depth(pseudo_m))
        for name, pseudo_m in pseudo.items()
    }


def _read_depth(
    name: str, source: DepthSource, view: FrameView, depth_range: DepthRange, problems: list[tuple[str, Problem]]
) -> DepthMap:
    """Return the masked map of a view, without any depth if it is missing or invalid (then add a problem)."""
    if view.view_id in source.view_ids:
        try:
            return mask_invalid_depth(source.read(view.view_id), depth_range)
        except EntryError as error:
            problems.append((name, error.problem))
    return np.full(view.shape, np.nan, dtype=np.float32)
