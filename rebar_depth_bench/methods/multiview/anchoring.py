"""Metres for a reconstruction, by name in a registry: the board's markers, or ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.config_views import ConfigViews
from rebar_depth_bench.methods.multiview.dense import DepthReader
from rebar_depth_bench.methods.multiview.pictures import LeftPictures
from rebar_depth_bench.methods.multiview.pose_report import placed_report, scaled_report
from rebar_depth_bench.methods.multiview.scale import board_fit
from rebar_depth_bench.methods.multiview.structure import Structure
from rebar_depth_bench.protocol import interior


@dataclass(frozen=True)
class Scaled:
    """Metres per unit of the reconstruction, and what there is to tell of it: plain JSON values."""

    scale_m: float
    notes: Mapping[str, Any]


@dataclass(frozen=True)
class Anchoring:
    """``check`` raises ``MethodError`` for a config that it cannot scale."""

    check: Callable[[ConfigViews], None]
    scale: Callable[[ConfigViews, LeftPictures, Structure, Callable[[], DepthReader]], Scaled]
    """Dense depth is made when it is asked for."""


def _needs_board(views: ConfigViews) -> None:
    if views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board to take metres from; name configs that have one "
            "(--config lattice pile), or take a method whose name ends in -anchored"
        )


def _by_markers(
    views: ConfigViews, pictures: LeftPictures, structure: Structure, reader: Callable[[], DepthReader]
) -> Scaled:
    del reader
    board = views.board
    assert board is not None
    fit = board_fit(pictures.markers, structure.cam_from_sfm, pictures.grid.K, board)
    notes = {
        "scale_from": f"ArUco markers of {board.marker_side_m:g} m, triangulated",
        "markers": list(fit.markers),
        "marker_rms_mm": round(1000 * fit.rms_m, 4),
        **placed_report(structure.cam_from_sfm, pictures.cam_from_world, fit.metric),
    }
    return Scaled(fit.metric.scale, notes)


def _by_truth(
    views: ConfigViews, pictures: LeftPictures, structure: Structure, reader: Callable[[], DepthReader]
) -> Scaled:
    """Return the median over views of median(z / z_found) on the scored pixels (the paper, II.C)."""
    ratios, read = [], reader()
    for row in views.rows("left_depth", "left_mask"):
        name = pictures.names[row["view_id"]]
        if name not in structure.cam_from_sfm:
            continue
        found = pictures.grid.depth_on_left_grid(read(name))
        kept = interior(row["left_mask"]) & (row["left_depth"] > 0) & np.isfinite(found)
        if kept.any():
            ratios.append(float(np.median(row["left_depth"][kept].astype(np.float64) / found[kept])))
    if not ratios:
        raise MethodError(f"{views.config}: no registered view has depth on steel to anchor with")
    scale_m = float(np.median(ratios))
    notes = {
        "scale_from": "the median of ground truth over depth found: not metric by itself",
        "views_anchored_with": len(ratios),
        **scaled_report(structure.cam_from_sfm, pictures.cam_from_world, scale_m),
    }
    return Scaled(scale_m, notes)


ANCHORINGS: Mapping[str, Anchoring] = {
    "aruco": Anchoring(_needs_board, _by_markers),
    "anchored": Anchoring(lambda _: None, _by_truth),
}
