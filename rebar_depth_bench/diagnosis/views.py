"""Views that a diagnosis looks at: some of their scored pixels, and their predictions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import CAMERA_KINDS
from rebar_depth_bench.geometry.cameras import Camera
from rebar_depth_bench.scoring.evaluation import View
from rebar_depth_bench.scoring.protocol import scored_pixels

MAX_VIEWS = 8
"""Number of views of a config that are looked at, evenly spaced."""
MAX_PIXELS = 4000
"""Number of scored pixels of an eye that are looked at, evenly spaced in pixel order."""
MIN_PIXELS = 50
"""Scored pixels that a view must have to be looked at."""

COLUMNS = (
    *("left_depth", "left_mask", "right_depth", "right_mask"),
    *(f"left_{kind}" for kind in CAMERA_KINDS),
)
"""Columns that are looked at."""


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

    There are none in a config that lacks a column that is looked at, and in one that is not in a local folder.
    """
    if config.local is None or not config.absent_columns.isdisjoint(COLUMNS):
        return []
    usable = [n for n, view in enumerate(config.views) if view.scored_px >= MIN_PIXELS]
    count = min(len(usable), MAX_VIEWS)
    return [usable[n * len(usable) // count] for n in range(count)]


def diagnosed_view(view: View) -> DiagnosedView:
    """Return what a diagnosis needs of a view. Raises ``EntryError`` for an invalid entry of the archive."""
    left, right = (_pixels(view.cell(f"{eye}_mask"), view.cell(f"{eye}_depth")) for eye in ("left", "right"))
    return DiagnosedView(view.position, view.camera("left"), left, right, view.prediction_m)


def _pixels(mask: Bool[ndarray, "h w"] | None, depth_m: Float32[ndarray, "h w"]) -> Pixels:
    index = scored_pixels(mask, depth_m).astype(np.int64)
    index = index[:: -(-len(index) // MAX_PIXELS) or 1]
    v, u = np.divmod(index, depth_m.shape[1])
    return Pixels(v, u, depth_m[v, u].astype(np.float64))
