"""Views that a diagnosis looks at: their scored pixels, read from the shards, and their predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import CAMERA_KINDS, RowDecoder, camera_from_row
from rebar_depth_bench.data.shards import rows_at
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.protocol import scored_pixels

MAX_VIEWS = 8
"""Number of views of a config that are looked at, evenly spaced."""
MAX_PIXELS = 4000
"""Number of scored pixels of an eye that are looked at, evenly spaced in pixel order."""
MIN_PIXELS = 50
"""Scored pixels that a view must have to be looked at."""

_COLUMNS = (
    "view_id",
    *("left_depth", "left_mask", "right_depth", "right_mask"),
    *(f"left_{kind}" for kind in CAMERA_KINDS),
)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Scored pixels of an eye: rows ``v``, columns ``u``, and planar depth in metres."""

    v: Int64[ndarray, " n"]
    u: Int64[ndarray, " n"]
    depth_m: Float64[ndarray, " n"]

    def values(self, image: Float[ndarray, "h w"], dv: int = 0, du: int = 0) -> Float64[ndarray, " n"]:
        """Return the values of an image ``dv`` rows below and ``du`` columns to the right; NaN outside of it."""
        v, u = self.v + dv, self.u + du
        height, width = image.shape
        inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
        values = np.full(len(v), np.nan)
        values[inside] = image[v[inside], u[inside]]
        return values


@dataclass(frozen=True, eq=False)
class DiagnosedView:
    """Ground truth and prediction of a view; ``position`` counts the views of its config.

    ``prediction`` is the submitted image, H x W, meant to be planar depth in metres.
    """

    position: int
    camera: Camera
    left: Pixels
    right: Pixels
    prediction: Float[ndarray, "h w"]


def positions_to_read(config: DatasetConfig) -> list[int]:
    """Return the positions of ``MAX_VIEWS`` evenly spaced views that have enough scored pixels.

    There are none in a config that lacks a column that is looked at.
    """
    if not config.absent_columns.isdisjoint(_COLUMNS):
        return []
    usable = [n for n, view in enumerate(config.views) if view.scored_px >= MIN_PIXELS]
    count = min(len(usable), MAX_VIEWS)
    return [usable[n * len(usable) // count] for n in range(count)]


def read_views(
    config: DatasetConfig, positions: Sequence[int], read: Callable[[int], Float[ndarray, "h w"]]
) -> Iterator[DiagnosedView]:
    """Yield the views at ``positions``; ``read`` returns the prediction of the view at a position.

    Only these rows are read, by their place in the shards; a view that is not there is left out. Raises
    ``DatasetError`` for a damaged shard.
    """
    position_by_id = {config.view_ids[position]: position for position in positions}
    for row in map(RowDecoder.of(config).row, rows_at(config, _COLUMNS, positions)):
        position = position_by_id.get(row["view_id"])
        if position is not None:
            camera = camera_from_row(row, "left", config.grid)
            yield DiagnosedView(position, camera, _pixels(row, "left"), _pixels(row, "right"), read(position))


def _pixels(row: Mapping[str, Any], eye: str) -> Pixels:
    depth_m = row[f"{eye}_depth"]
    index = scored_pixels(row[f"{eye}_mask"], depth_m).astype(np.int64)
    index = index[:: -(-len(index) // MAX_PIXELS) or 1]
    v, u = np.divmod(index, depth_m.shape[1])
    return Pixels(v, u, depth_m[v, u].astype(np.float64))
