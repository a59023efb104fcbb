"""Rank errors of the views of a submission as they are stored, and the ranks that they allow.

Two submissions are compared on the same views, as ``rebar-bench compare`` does: one is better if the 95 % interval
of the paired difference of their rank errors excludes zero.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.base.names import config_of, split_of
from rebar_depth_bench.scoring import bootstrap

_CLEAR, _UNCLEAR = 1.6, 0.6
"""Differences in half widths from which a pair is decided, and below which it is undecided, without draws."""
_CHUNK_PAIRS = 2_000
_CACHED_ROWS = 2048


def view_errors(result: Mapping[str, Any], config: str) -> str | None:
    """Return the ids and the rank errors of the views of a config as JSON, or None if a view has no error.

    ``result`` is the result JSON.
    """
    views = [view for view in result["views"] if config_of(view["view_id"]) == config]
    errors = [view.get("rank_error") for view in views]
    if not errors or None in errors:
        return None
    return json.dumps([[view["view_id"] for view in views], errors])


def rank_ranges(rows: Sequence[str | None]) -> list[tuple[int, int] | None]:
    """Return the first and last rank of each submission that the paired differences allow.

    The first rank is 1 + the number of submissions that are better, the last one is the number of submissions that
    are not worse. None stands for submissions without view errors or with other views than the first one.
    """
    resampled = [None if row is None else _resampled(row) for row in rows]
    views = next((one.view_ids for one in resampled if one), ())
    compared = [(index, one) for index, one in enumerate(resampled) if one and one.view_ids == views]
    ranges: list[tuple[int, int] | None] = [None] * len(rows)
    if len(compared) < 2:
        return ranges
    better = _is_better(np.array([one.means for _, one in compared]), _resampling(views).blocks())
    for place, (index, _) in enumerate(compared):
        ranges[index] = (1 + int(better[:, place].sum()), len(compared) - int(better[place].sum()))
    return ranges


@dataclass(frozen=True)
class _Resampled:
    """Views of a submission, and its mean rank error in each resample of them."""

    view_ids: tuple[str, ...]
    means: Float64[ndarray, " draws"]


@lru_cache(maxsize=_CACHED_ROWS)
def _resampled(row: str) -> _Resampled:
    """Return the resampled means of a row; cached, because other submissions stay the same."""
    view_ids, errors = json.loads(row)
    means = _resampling(tuple(view_ids)).means(np.array(errors)[:, None])[:, 0]
    return _Resampled(tuple(view_ids), means)


@lru_cache(maxsize=4)
def _resampling(view_ids: tuple[str, ...]) -> bootstrap.Resampling:
    return bootstrap.resample_views(view_ids, by_scene=split_of(view_ids[0]) is not None)


def _is_better(means: Float64[ndarray, "n draws"], blocks: int) -> ndarray:
    """Return an n x n matrix: whether submission i is better than j, from their means in each resample.

    It is all False where there are too few blocks of views, or scenes, for an interval.
    """
    n = len(means)
    if blocks < bootstrap.MIN_BLOCKS:
        return np.zeros((n, n), bool)
    covariance = np.cov(means)
    variance = np.diag(covariance)
    width = bootstrap.half_width(blocks) * np.sqrt(np.maximum(variance[:, None] + variance - 2 * covariance, 0))
    difference = means.mean(axis=1)[:, None] - means.mean(axis=1)
    better: ndarray = difference < -_CLEAR * width
    unclear = ~better & (difference < -_UNCLEAR * width)
    first, other = np.nonzero(unclear)
    for start in range(0, len(first), _CHUNK_PAIRS):
        i, j = first[start : start + _CHUNK_PAIRS], other[start : start + _CHUNK_PAIRS]
        upper = np.percentile(means[i] - means[j], bootstrap.end_percents(blocks)[1], axis=1)
        better[i, j] = upper < 0
    return better
