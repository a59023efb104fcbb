"""Single-bar interior: scored pixels whose 3 x 3 neighbourhood belongs to one bar.

The interior of the protocol erodes the union of all bars. Where bars lie side by side in the image, a scored
pixel can therefore have another bar beside it, at another depth; a prediction that is exact but shifted by one
pixel has a large error there. Errors on the single-bar interior contain no such steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rebar_depth_bench.scoring.metrics import (
    DepthMetrics,
    is_valid_prediction,
    mean,
    mean_metrics,
    metrics_at_scales,
)
from rebar_depth_bench.scoring.score import Truth
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


def single_bar_scores(
    submission: SubmissionReader, truths: Truth, scores: Sequence[ViewScore]
) -> list[SingleBarScore]:
    """Return the scores on single-bar pixels of all views of a config, given their scores in the same order."""
    found = []
    for truth, score in zip(truths, scores, strict=True):
        p_m = submission.read(truth.view_id).ravel().take(truth.index.astype(np.intp))
        single_bar = np.zeros(len(p_m), bool) if truth.single_bar is None else truth.single_bar
        chosen = single_bar & is_valid_prediction(p_m)
        coverage = np.count_nonzero(chosen) / np.count_nonzero(single_bar) if single_bar.any() else None
        native, scaled = None, None
        if score.scale is not None and chosen.any():
            (native, scaled), _ = metrics_at_scales(p_m[chosen], truth.depth_m[chosen], (1.0, score.scale))
        found.append(SingleBarScore(float(np.mean(single_bar)), coverage, native, scaled))
    return found


def mean_single_bar(scores: Sequence[SingleBarScore]) -> SingleBarScore:
    """Return the means over one or more views: the share of all, and the others of those that have a value."""
    return SingleBarScore(
        share=sum(score.share for score in scores) / len(scores),
        coverage=mean([score.coverage for score in scores if score.coverage is not None]),
        native=mean_metrics([score.native for score in scores if score.native]),
        scaled=mean_metrics([score.scaled for score in scores if score.scaled]),
    )
