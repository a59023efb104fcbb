"""Diagnosis of a submission: the mistakes whose correction makes most of the views clearly better."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.diagnosis.corrections import (
    Correction,
    DiagnosedView,
    KeptPredictions,
    Values,
    logarithm_corrections,
    mean_error,
    median_ratio,
    rank_correlation,
    relative_spread,
    shape_corrections,
    unit_corrections,
    valid_share,
)
from rebar_depth_bench.scoring.relative import has_value
from rebar_depth_bench.submission.declaration import METRIC

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
LEAST_VALID_SHARE = 0.5
"""Least number of valid pixels after a correction, as a share of those before."""
LEAST_SPREAD = 0.1
"""Least relative spread of corrected depth within a view, as a share of the spread of the true depth."""
LEAST_RANK_CORRELATION = 0.5
"""Rank correlation of corrected and true depth, over all views, up to which the correction explains nothing."""


@dataclass(frozen=True)
class PossibleMistake:
    """Mistake that most of the views of a config show.

    ``name`` is the name of the correction, or of the most frequent kind of invalid values; ``text`` describes the
    mistake with its figures, in one sentence.
    """

    config: str
    name: str
    text: str


def diagnose(
    configs: Iterable[KeptPredictions], kind: str = METRIC, depth_scale: float | None = None
) -> list[PossibleMistake]:
    """Return the possible mistakes in the predictions of configs: what ``diagnose_config`` finds in each.

    ``kind`` is the kind of the predictions, and ``depth_scale`` the scale of an archive of PNG images.
    """
    return [mistake for config in configs for mistake in diagnose_config(config, kind, depth_scale)]


def diagnose_config(
    kept: KeptPredictions, kind: str = METRIC, depth_scale: float | None = None
) -> list[PossibleMistake]:
    """Return at most two possible mistakes in the predictions of a config.

    They are one of units and one other, or with few valid values what the others are, and a logarithm. Of
    predictions that are not metric only the values are looked at: they have no unit, and disparity is no mistake.
    """
    config, views = kept.config, kept.views()
    if len(views) < MIN_VIEWS:
        return []
    invalid = invalid_values(config, views, kind)
    if invalid is None and is_same_map(views):
        count = _count(len(views), views, config)
        text = f"the predictions of {config.name} seem to be one picture: they are identical in {count}"
        return [PossibleMistake(config.name, "same-map", text)]
    if kind != METRIC:
        found = [invalid or _constant_values(config, views)]
    elif invalid is not None:
        found = [invalid, best_mistake(config, views, logarithm_corrections())]
    else:
        units = unit_corrections(views, depth_scale)
        others = [*shape_corrections(views, len(config.views)), *logarithm_corrections()]
        of_units, other = (best_mistake(config, views, corrections) for corrections in (units, others))
        found = [other] if other and other.name == "inverse" else [of_units, other]  # It has no unit of depth.
    return [mistake for mistake in found if mistake]


def _constant_values(config: DatasetConfig, views: Sequence[DiagnosedView]) -> PossibleMistake | None:
    """Return the mistake of predictions that have one value in most of the views; None if they have several."""
    count = sum(bool((view.p == view.p[0]).all()) for view in views)
    text = f"the predictions of {config.name} are the same at all pixels in {_count(count, views, config)}"
    return PossibleMistake(config.name, "constant", text) if count >= MOST_VIEWS * len(views) else None


def invalid_values(
    config: DatasetConfig, views: Sequence[DiagnosedView], kind: str = METRIC
) -> PossibleMistake | None:
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
    what = "valid depth" if kind == METRIC else "valid"
    listed = ", ".join(f"{_percent(share)} are {name}" for name, share in shares.items())
    text = (
        f"the predictions of {config.name} are hardly anywhere {what}: of the scored pixels looked at in "
        f"{len(views)} of {len(config.views)} views, {listed} and "
        f"{_percent(valid)} are finite{'' if kind.startswith('affine') else ' and above 0'}"
    )
    return PossibleMistake(config.name, max(shares, key=lambda name: shares[name]).lower(), text)


def is_same_map(views: Sequence[DiagnosedView]) -> bool:
    """Return whether all views have the same prediction, and not merely one depth for every pixel."""
    first = views[0].prediction
    is_constant = bool((first == first.flat[0]).all())
    return not is_constant and all(np.array_equal(first, view.prediction, equal_nan=True) for view in views[1:])


def best_mistake(
    config: DatasetConfig, views: Sequence[DiagnosedView], corrections: Sequence[Correction]
) -> PossibleMistake | None:
    """Return the mistake whose correction reduces the errors most.

    None if no correction makes most of the views, and the geometric mean over all views, clearly better, and gives
    depth whose ranks, over all views, are those of the true depth.
    """
    best, best_ratio = None, math.inf
    left = [(view.p, view.left.depth_m) for view in views]
    for correction in corrections:
        corrected = [(correction.corrected(view), getattr(view, correction.eye).depth_m) for view in views]
        before, after = scaled_errors(left, correction.scale), scaled_errors(corrected, correction.scale)
        ratios = [
            max(new / old, SMALLEST_RATIO) if old >= LEAST_ERROR and _is_comparable(correction, p, *one) else 1.0
            for old, new, (p, _), one in zip(before, after, left, corrected, strict=True)
        ]
        better = [n for n, ratio in enumerate(ratios) if ratio <= correction.clearly_better]
        mean_ratio = math.exp(math.fsum(map(math.log, ratios)) / len(views))
        if (
            len(better) >= MOST_VIEWS * len(views)
            and mean_ratio <= correction.clearly_better
            and mean_ratio < best_ratio
            and rank_correlation(*map(np.concatenate, zip(*corrected, strict=True))) > LEAST_RANK_CORRELATION
        ):
            measure = f"mean error{_MEASURES[correction.scale]}"
            old, new = (float(np.median([errors[n] for n in better])) for errors in (before, after))
            text = (
                f"the predictions of {config.name} seem to be {correction.seems}: the {measure} is "
                f"{_percent(old)}, and {_percent(new)} if that is undone, "
                f"in {_count(len(better), views, config)}{correction.remedy}"
            )
            best, best_ratio = PossibleMistake(config.name, correction.name, text), mean_ratio
    return best


_MEASURES = {None: "", "view": " after scaling", "all": " after the same scaling of all views"}


def scaled_errors(pairs: Sequence[tuple[Values, Values]], scale: str | None) -> list[float]:
    """Return the mean error of each view, of pairs of predicted and true depth, after ``Correction.scale``."""
    if scale != "all":
        return [mean_error(p, z_m, 1.0 if scale is None else None) for p, z_m in pairs]
    ratios = [median_ratio(p, z_m) for p, z_m in pairs if valid_share(p)]
    one_scale = float(np.median(ratios)) if ratios else 1.0
    return [mean_error(p, z_m, one_scale) for p, z_m in pairs]


def _is_comparable(correction: Correction, p: Values, corrected: Values, z_m: Values) -> bool:
    """Return whether a correction keeps enough valid pixels of a view and is no plane at one depth.

    After the scale of a view, such a plane, as of filled holes, has smaller errors than many a method.
    """
    is_plane = relative_spread(corrected) < LEAST_SPREAD * relative_spread(z_m)
    enough_valid = valid_share(corrected) >= LEAST_VALID_SHARE * valid_share(p)
    return enough_valid and not (is_plane and correction.scale == "view")


def _count(found: int, views: Sequence[DiagnosedView], config: DatasetConfig) -> str:
    """Return in how many of the views looked at something was found, and of how many views these are."""
    total = len(config.views)
    return f"{found} of {len(views)} views" + (f" looked at, of {total}" if len(views) < total else "")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
