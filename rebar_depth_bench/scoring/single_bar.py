"""Single-bar interior: scored pixels whose 3 x 3 neighbourhood belongs to one bar.

The interior of the protocol erodes the union of all bars. Where bars lie side by side in the image, a scored
pixel can therefore have another bar beside it, at another depth; a prediction that is exact but shifted by one
pixel has a large error there. Errors on the single-bar interior contain no such steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.scoring.metrics import (
    DepthMetrics,
    is_valid_prediction,
    mean,
    mean_metrics,
    metrics_at_scales,
)
from rebar_depth_bench.scoring.score import Truth, ViewTruth
from rebar_depth_bench.scoring.table import ViewScore
from rebar_depth_bench.submission import SubmissionReader


@dataclass(frozen=True)
class SingleBarScore:
    """Share of a view's scored pixels that are single-bar, their coverage, and the metrics of the valid ones.

    ``coverage`` is None without such pixels, ``native`` and ``scaled`` without valid predictions on them.
    ``scaled`` uses the view's scale, that of all its scored pixels.
    """

    share: float
    coverage: float | None
    native: DepthMetrics | None
    scaled: DepthMetrics | None


def score_single_bar(truth: ViewTruth, prediction_m: Float[ndarray, "h w"], scale: float | None) -> SingleBarScore:
    """Return the score of a view on its single-bar pixels, none of which is known without bar ids.

    ``prediction_m`` is planar depth, metres, and ``scale`` the view's scale, None if it has none.
    """
    single_bar = np.zeros(len(truth.index), bool) if truth.single_bar is None else truth.single_bar
    share = float(np.mean(single_bar))
    p_m = prediction_m.ravel().take(truth.index.astype(np.intp))
    chosen = single_bar & is_valid_prediction(p_m)
    coverage = np.count_nonzero(chosen) / np.count_nonzero(single_bar) if share else None
    if scale is None or not chosen.any():
        return SingleBarScore(share, coverage, None, None)
    (native, scaled), _ = metrics_at_scales(p_m[chosen], truth.depth_m[chosen], (1.0, scale), ())
    return SingleBarScore(share, coverage, native, scaled)


def single_bar_scores(
    submission: SubmissionReader, truths: Truth, scores: Sequence[ViewScore]
) -> list[SingleBarScore]:
    """Return the scores on single-bar pixels of all views of a config, given their scores in the same order."""
    return [
        score_single_bar(truth, submission.read(truth.view_id), score.scale)
        for truth, score in zip(truths, scores, strict=True)
    ]


def mean_single_bar(scores: Sequence[SingleBarScore]) -> SingleBarScore:
    """Return the means over one or more views: the share of all, and the others of those that have a value."""
    return SingleBarScore(
        share=sum(score.share for score in scores) / len(scores),
        coverage=mean([score.coverage for score in scores if score.coverage is not None]),
        native=mean_metrics([score.native for score in scores if score.native]),
        scaled=mean_metrics([score.scaled for score in scores if score.scaled]),
    )
