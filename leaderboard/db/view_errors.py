"""Rank errors of the views of a submission, packed for the database, and the ranks that they allow.

Two submissions are compared on the same views, as ``rebar-bench compare`` does: one is better if the 95 % interval
of the paired difference of their rank errors excludes zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from rebar_depth_bench.names import config_of, scene_of
from rebar_depth_bench.scoring import bootstrap
from rebar_depth_bench.scoring.bootstrap import protocol_indices

_CLEAR, _UNCLEAR = 1.6, 0.6
"""Differences in half widths from which a pair is decided, and below which it is undecided, without draws."""
_CHUNK_PAIRS = 2_000
_CACHED_ROWS = 2048


def view_errors(result: Mapping[str, Any], config: str) -> bytes | None:
    """Return the rank errors of the views of a config, packed, or None if a view has none.

    ``result`` is the result JSON. The indices of the views in their protocol (int32) are followed by the rank
    errors (float64), both little-endian. In a config of several scenes, the number -1 - i of the view's scene i
    takes the place of the index.
    """
    views = [view for view in result["views"] if config_of(view["view_id"]) == config]
    errors = [view.get("rank_error") for view in views]
    if not errors or None in errors:
        return None
    view_ids = [view["view_id"] for view in views]
    by_scene = result["tables"][config].get("split") is not None
    indices = np.array(_scene_numbers(view_ids) if by_scene else protocol_indices(view_ids), "<i4")
    return indices.tobytes() + np.array(errors, "<f8").tobytes()


def _scene_numbers(view_ids: Sequence[str]) -> list[int]:
    """Return -1 - i for the views of scene i, in the order of their first views."""
    number = {scene: -1 - index for index, scene in enumerate(dict.fromkeys(map(scene_of, view_ids)))}
    return [number[scene_of(view_id)] for view_id in view_ids]


def unpack_view_errors(packed: bytes) -> tuple[bytes, Float64[ndarray, " n"]]:
    """Return the packed indices of the views, and their rank errors."""
    size = _indices_size(packed)
    return packed[:size], np.frombuffer(packed[size:], "<f8")


def _indices_size(packed: bytes) -> int:
    return len(packed) // 12 * 4


def rank_ranges(packed: Sequence[bytes | None]) -> list[tuple[int, int] | None]:
    """Return the first and last rank of each submission that the paired differences allow.

    The first rank is 1 + the number of submissions that are better, the last one is the number of submissions that
    are not worse. None stands for submissions without view errors or with other views than the first one.
    """
    views = next((one[: _indices_size(one)] for one in packed if one), b"")
    same_views = [(i, one) for i, one in enumerate(packed) if one and one[: _indices_size(one)] == views]
    rows = [index for index, _ in same_views]
    ranges: list[tuple[int, int] | None] = [None] * len(packed)
    if len(rows) < 2:
        return ranges
    better = _is_better(np.array([_resampled_means(one) for _, one in same_views]), _resampling(views).blocks())
    for row, index in enumerate(rows):
        ranges[index] = (1 + int(better[:, row].sum()), len(rows) - int(better[row].sum()))
    return ranges


@lru_cache(maxsize=_CACHED_ROWS)
def _resampled_means(packed: bytes) -> Float64[ndarray, " draws"]:
    """Return the mean rank error in each resample; cached, because other submissions stay the same."""
    indices, errors = unpack_view_errors(packed)
    return _resampling(indices).means(errors[:, None])[:, 0]


@lru_cache(maxsize=4)
def _resampling(indices: bytes) -> bootstrap.Resampling:
    numbers: list[int] = np.frombuffer(indices, "<i4").tolist()
    return bootstrap.resample_scenes(list(map(str, numbers))) if min(numbers) < 0 else bootstrap.resample(numbers)


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
