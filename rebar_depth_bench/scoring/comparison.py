"""Two submissions on the same views: the paired difference of every number, and whether it stands out.

Both see the same views, so the views' difficulty cancels in the difference of each: its interval is far narrower
than the two intervals by themselves, and only it says whether one submission is better here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from rebar_depth_bench.errors import InputError
from rebar_depth_bench.scoring.bootstrap import Interval, interval, resample
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.provenance import ArchiveStamp, Stamp
from rebar_depth_bench.scoring.result import (
    SCALE,
    VIEW_NUMBERS,
    Result,
    ViewScore,
    estimate_draws,
    protocol_indices,
)
from rebar_depth_bench.scoring.rounding import INTERVAL_DIGITS, rounded
from rebar_depth_bench.submission import config_of

Verdict = Literal["better", "worse", "equal", "undecided", "not ranked", ""]

_OF_ALL_VIEWS = ("coverage", "within_mm.")
_HIGHER_IS_BETTER = ("coverage", "native.delta1", "scaled.delta1", "within_mm.")


@dataclass(frozen=True)
class Difference:
    """One number of both submissions on the same views, and ``other - first`` with its 95 % interval.

    ``verdict`` says how the other does: "equal" where all views agree, "undecided" where the interval holds zero
    or there is none, "not ranked" for errors where either submission is not ranked, for an error over the pixels
    one chose to predict is no merit; "" for the scale factor, where neither direction is better.
    """

    name: str
    views: int
    first: float | None
    other: float | None
    difference: float | None
    interval: Interval | None
    verdict: Verdict


@dataclass(frozen=True)
class Comparison:
    """Every number's difference by config, for the configs that both archives hold."""

    stamp: Stamp
    configs: Mapping[str, Sequence[Difference]]

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as a JSON object."""
        return {
            **self.stamp.to_dict(),
            "configs": {name: [_difference_dict(one) for one in rows] for name, rows in self.configs.items()},
        }


def compare(first: Result, other: Result) -> Comparison:
    """Return how ``other`` differs from ``first``.

    Raises ``InputError`` if they were scored against different ground truth or share no config.
    """
    if first.dataset_digest != other.dataset_digest:
        raise InputError(
            f"{other.method} was scored on the dataset {other.dataset_digest}, expected {first.dataset_digest} as "
            f"{first.method}: only submissions on the same ground truth can be compared"
        )
    shared = [config for config in first.tables if config in other.tables]
    if not shared:
        raise InputError(
            f"{first.method} has {', '.join(first.tables)} and {other.method} has {', '.join(other.tables)}: "
            "expected a config that is in both"
        )
    archives = [ArchiveStamp(one.method, one.submission_sha256) for one in (first, other)]
    return Comparison(
        stamp=Stamp(PROTOCOL, first.dataset_digest, first.dataset_version, archives),
        configs={config: _of_config(first, other, config) for config in shared},
    )


def _of_config(first: Result, other: Result, config: str) -> list[Difference]:
    found = _differences(_views(first, config), _views(other, config))
    if first.tables[config].ranked and other.tables[config].ranked:
        return found
    return [
        one if one.name == SCALE or one.name.startswith(_OF_ALL_VIEWS) else replace(one, verdict="not ranked")
        for one in found
    ]


def _views(result: Result, config: str) -> dict[str, ViewScore]:
    return {view.view_id: view for view in result.views if config_of(view.view_id) == config}


def _differences(first: Mapping[str, ViewScore], other: Mapping[str, ViewScore]) -> list[Difference]:
    """Return a difference per number. Error metrics go over the views where both submissions have a value."""
    both = [view_id for view_id in first if first[view_id].native and other[view_id].native]
    of_all, of_both = (_on_views([first[v] for v in ids], [other[v] for v in ids]) for ids in (list(first), both))
    return [of_all[name] if name.startswith(_OF_ALL_VIEWS) else of_both[name] for name in VIEW_NUMBERS]


def _on_views(first: Sequence[ViewScore], other: Sequence[ViewScore]) -> dict[str, Difference]:
    """Return the differences on these views of both, by name; the same resamples serve both sides."""
    resampling = resample(protocol_indices([view.view_id for view in first]))
    draws = estimate_draws(other, resampling) - estimate_draws(first, resampling)
    found = {}
    for k, name in enumerate(VIEW_NUMBERS):
        a, b = (_estimate(name, views) for views in (first, other))
        ends = interval(draws[:, k])
        change = None if a is None or b is None else b - a
        found[name] = Difference(name, len(first), a, b, change, ends, _verdict(name, ends))
    return found


def _estimate(name: str, views: Sequence[ViewScore]) -> float | None:
    values = [value for view in views if (value := VIEW_NUMBERS[name](view)) is not None]
    if not values or not np.isfinite(values).all():
        return None
    return float(np.median(values) if name == SCALE else np.mean(values))


def _verdict(name: str, ends: Interval | None) -> Verdict:
    if name == SCALE:
        return ""
    if ends == (0.0, 0.0):
        return "equal"
    if ends is None or ends[0] <= 0.0 <= ends[1]:
        return "undecided"
    return "better" if (ends[0] > 0) == name.startswith(_HIGHER_IS_BETTER) else "worse"


def _difference_dict(one: Difference) -> dict[str, Any]:
    return {
        "name": one.name,
        "views": one.views,
        "first": rounded(one.first),
        "other": rounded(one.other),
        "difference": rounded(one.difference),
        "ci95": None if one.interval is None else [rounded(end, INTERVAL_DIGITS) for end in one.interval],
        "verdict": one.verdict,
    }
