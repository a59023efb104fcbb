"""Diagnosis of a submission: the mistakes whose correction makes most of the views clearly better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.diagnosis.corrections import Correction, Errors, shape_corrections, unit_corrections
from rebar_depth_bench.diagnosis.errors import plane_error
from rebar_depth_bench.diagnosis.views import DiagnosedView, positions_to_read, read_views
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.submission import SubmissionReader

MIN_VIEWS = 3
"""Number of views below which nothing is said."""
MOST_VIEWS = 0.75
"""Share of the views that a correction must make clearly better."""
CLEARLY_BETTER = 0.5
"""Largest error after a correction, as a share of the error before."""
BETTER_THAN_PLANE = 0.7
"""Largest error after scaling and a correction, as a share of that of a plane at the median depth."""
LEAST_ERROR = 0.002
"""Error from which a prediction is worth correcting."""


@dataclass(frozen=True)
class PossibleMistake:
    """Mistake that most of the views of a config show.

    ``name`` is that of the correction, ``text`` describes the mistake with its figures, in one sentence.
    """

    config: str
    name: str
    text: str


def diagnose(evaluation: Evaluation) -> list[PossibleMistake]:
    """Return the possible mistakes in a submission, at most one of units and one other for each config.

    Up to ``views.MAX_VIEWS`` views of each config in a local folder are read. Raises ``EntryError`` and
    ``DatasetError`` for entries and shards that scoring refuses.
    """
    local = [config for config in evaluation.configs if config.local is not None]
    return [mistake for config in local for mistake in _diagnose_config(config, evaluation.submission)]


def _diagnose_config(config: DatasetConfig, submission: SubmissionReader) -> list[PossibleMistake]:
    def read(position: int) -> np.ndarray:
        return submission.read(config.view_ids[position])

    views = list(read_views(config, positions_to_read(config), read))
    if len(views) < MIN_VIEWS:
        return []
    if is_same_map(views):
        text = (
            f"the predictions of {config.name} seem to be one picture: {len(views)} of {len(views)} are identical"
        )
        return [PossibleMistake(config.name, "same-map", text)]
    found = [
        best_mistake(config.name, views, corrections)
        for corrections in (
            unit_corrections(),
            shape_corrections(views, read, len(config.views)),
        )
    ]
    return [mistake for mistake in found if mistake]


def is_same_map(views: Sequence[DiagnosedView]) -> bool:
    """Return whether all views have the same prediction, and not merely one depth for every pixel."""
    first = views[0].prediction
    is_constant = bool((first == first.flat[0]).all())
    return not is_constant and all(np.array_equal(first, view.prediction, equal_nan=True) for view in views[1:])


def best_mistake(
    config: str, views: Sequence[DiagnosedView], corrections: Sequence[Correction]
) -> PossibleMistake | None:
    """Return the mistake whose correction leaves the smallest error.

    None if no correction makes most of the views clearly better.
    """
    mistakes = {}
    for correction in corrections:
        errors = [one for view in views if (one := correction.errors(view)).after <= _bound(correction, one, view)]
        if len(errors) >= MOST_VIEWS * len(views):
            before, after = (
                float(np.median([getattr(one, name) for one in errors])) for name in ("before", "after")
            )
            text = (
                f"the predictions of {config} seem to be {correction.seems}: the {correction.measure} is "
                f"{_percent(before)}, and {_percent(after)} if that is undone, "
                f"in {len(errors)} of {len(views)} views"
            )
            mistakes[after] = PossibleMistake(config, correction.name, text)
    return mistakes[min(mistakes)] if mistakes else None


def _bound(correction: Correction, errors: Errors, view: DiagnosedView) -> float:
    """Return the largest error after a correction that is clearly better; below zero if nothing is."""
    if not errors.before >= LEAST_ERROR:
        return -1.0
    plane = math.inf if correction.in_metres else BETTER_THAN_PLANE * plane_error(view.left.depth_m)
    return min(CLEARLY_BETTER * errors.before, plane)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
