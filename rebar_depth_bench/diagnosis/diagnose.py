"""Diagnosis of a submission: the mistakes whose correction makes most of the views clearly better."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.diagnosis.corrections import (
    COLUMNS,
    Correction,
    DiagnosedView,
    Errors,
    diagnosed_view,
    logarithm_corrections,
    positions_to_read,
    shape_corrections,
    unit_corrections,
)
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.relative import has_value
from rebar_depth_bench.submission import SubmissionReader
from rebar_depth_bench.submission.declaration import METRIC

MAX_KEPT = 16
"""Number of predictions of other views that are kept decoded."""
MIN_VIEWS = 3
"""Number of views below which nothing is said."""
LEAST_COVERAGE = 0.05
"""Share of the scored pixels with a valid prediction below which the kinds of invalid values are named."""
MOST_VIEWS = 0.75
"""Share of the views that a correction must make clearly better."""
LEAST_ERROR = 0.002
"""Error from which a prediction is worth correcting."""
SMALLEST_RATIO = 1e-6
"""Bound of the ratios of errors, for predictions that a correction makes exact."""


@dataclass(frozen=True)
class PossibleMistake:
    """Mistake that most of the views of a config show.

    ``name`` is that of the correction, or of the most frequent kind of invalid values; ``text`` describes the
    mistake with its figures, in one sentence.
    """

    config: str
    name: str
    text: str


def diagnose(evaluation: Evaluation) -> list[PossibleMistake]:
    """Return the possible mistakes in a submission, those of ``diagnose_config`` for each config.

    Up to ``corrections.MAX_VIEWS`` views of each config in a local folder are read. Raises ``EntryError`` and
    ``DatasetError`` for entries and shards that scoring refuses.
    """
    mistakes = []
    for config in evaluation.configs:
        views = map(diagnosed_view, evaluation.views(config, COLUMNS, positions_to_read(config)))
        mistakes += diagnose_config(config, list(views), evaluation.submission)
    return mistakes


def diagnose_config(
    config: DatasetConfig, views: Sequence[DiagnosedView], submission: SubmissionReader
) -> list[PossibleMistake]:
    """Return at most two possible mistakes in the ``views`` of a config, those at ``positions_to_read``.

    They are one of units and one other, or with few valid values what the others are, and a logarithm. Of
    predictions that are not metric only the values are looked at: they have no unit, and disparity is no mistake.
    """
    kind = METRIC if submission.meta is None else submission.meta.prediction
    known = {view.position: view.prediction for view in views}

    @lru_cache(MAX_KEPT)
    def read(position: int) -> np.ndarray:
        return known[position] if position in known else submission.read(config.view_ids[position])

    if len(views) < MIN_VIEWS:
        return []
    invalid = invalid_values(config.name, views, kind)
    if invalid is None and is_same_map(views):
        text = (
            f"the predictions of {config.name} seem to be one picture: {len(views)} of {len(views)} are identical"
        )
        return [PossibleMistake(config.name, "same-map", text)]
    if kind != METRIC:
        found = [invalid or _constant_values(config.name, views)]
    elif invalid is not None:
        found = [invalid, best_mistake(config.name, views, logarithm_corrections())]
    else:
        others = [*shape_corrections(views, read, len(config.views)), *logarithm_corrections()]
        found = [best_mistake(config.name, views, corrections) for corrections in (unit_corrections(), others)]
    return [mistake for mistake in found if mistake]


def _constant_values(config: str, views: Sequence[DiagnosedView]) -> PossibleMistake | None:
    """Return the mistake of predictions that have one value in most of the views; None if they have several."""
    count = sum(bool((view.p == view.p[0]).all()) for view in views)
    text = f"the predictions of {config} are the same at all pixels in {count} of {len(views)} views"
    return PossibleMistake(config, "constant", text) if count >= MOST_VIEWS * len(views) else None


def invalid_values(config: str, views: Sequence[DiagnosedView], kind: str = METRIC) -> PossibleMistake | None:
    """Return the mistake of predictions that hardly anywhere have a value of their kind; None if they do."""
    p = np.concatenate([view.p for view in views])
    valid = float(np.mean(has_value(p, kind)))
    if valid >= LEAST_COVERAGE:
        return None
    shares = {
        "negative": float(np.mean(np.isfinite(p) & (p < 0))),
        "infinite": float(np.isinf(p).mean()),
        "NaN": float(np.isnan(p).mean()),
        "zero": float((p == 0).mean()),
    }
    name = "valid depth" if kind == METRIC else "valid"
    text = (
        f"the predictions of {config} are hardly anywhere {name}: of the scored pixels looked at in "
        f"{len(views)} views, {', '.join(f'{_percent(share)} are {name}' for name, share in shares.items())} and "
        f"{_percent(valid)} are finite{'' if kind.startswith('affine') else ' and above 0'}"
    )
    return PossibleMistake(config, max(shares, key=lambda name: shares[name]).lower(), text)


def is_same_map(views: Sequence[DiagnosedView]) -> bool:
    """Return whether all views have the same prediction, and not merely one depth for every pixel."""
    first = views[0].prediction
    is_constant = bool((first == first.flat[0]).all())
    return not is_constant and all(np.array_equal(first, view.prediction, equal_nan=True) for view in views[1:])


def best_mistake(
    config: str, views: Sequence[DiagnosedView], corrections: Sequence[Correction]
) -> PossibleMistake | None:
    """Return the mistake whose correction reduces the errors most.

    None if no correction makes most of the views, and the geometric mean over all views, clearly better.
    """
    found: dict[float, PossibleMistake] = {}
    for correction in corrections:
        errors = [correction.errors(view) for view in views]
        better = [one for one in errors if _ratio(one) <= correction.clearly_better]
        mean_ratio = math.exp(math.fsum(math.log(_ratio(one)) for one in errors) / len(views))
        if len(better) >= MOST_VIEWS * len(views) and mean_ratio <= correction.clearly_better:
            before, after = (
                float(np.median([getattr(one, name) for one in better])) for name in ("before", "after")
            )
            text = (
                f"the predictions of {config} seem to be {correction.seems}: the {correction.measure} is "
                f"{_percent(before)}, and {_percent(after)} if that is undone, "
                f"in {len(better)} of {len(views)} views{correction.remedy}"
            )
            found[mean_ratio] = PossibleMistake(config, correction.name, text)
    return found[min(found)] if found else None


def _ratio(errors: Errors) -> float:
    """Return the error after a correction as a share of that before; 1 where nothing is to be corrected."""
    if not errors.before >= LEAST_ERROR or math.isnan(errors.after):
        return 1.0
    return max(errors.after / errors.before, SMALLEST_RATIO)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
