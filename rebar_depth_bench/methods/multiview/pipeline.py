"""All of it in order: pictures, structure, dense depth, metres; then a predictor that reads a view's depth."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.methods.base import Prepared
from rebar_depth_bench.methods.multiview.dense import DENSE
from rebar_depth_bench.methods.multiview.images import LeftPictures, plausible_pairs, write_pictures
from rebar_depth_bench.methods.multiview.metric_scale import ANCHORINGS
from rebar_depth_bench.methods.multiview.sfm import Structure, find_structure
from rebar_depth_bench.progress import Progress, silent


def pictured_structure(
    views: ConfigViews, pictures: LeftPictures, work: Path, progress: Progress = silent
) -> Structure:
    """Return the reconstruction from a config's pictures; where there is a board its markers choose the pairs."""
    K, board = pictures.grid.K, views.board
    pairs = plausible_pairs(pictures.markers, board, K) if board else None
    names = list(pictures.names.values())
    return find_structure(pictures.folder, names, K, work, pairs=pairs, progress=progress)


def check(views: ConfigViews, dense: str, anchoring: str) -> None:
    """Raise ``MethodError`` where the named parts cannot run here, or not on this config."""
    DENSE[dense].check()
    ANCHORINGS[anchoring].check(views)


def prepare(views: ConfigViews, work: Path, progress: Progress, dense: str, anchoring: str) -> Prepared:
    """Reconstruct a config from its left views; notes tell cameras and scale beside the truth.

    What is done stays in ``work`` and is not done again. A view that was not registered has no answer.
    """
    pictures = write_pictures(views, work / "images")
    structure = pictured_structure(views, pictures, work, progress)
    reader = cache(lambda: DENSE[dense].run(pictures, structure, work, progress))
    scaled = ANCHORINGS[anchoring].scale(views, pictures, structure, reader)  # markers fail before hours of depth
    read = reader()
    notes = {
        "views_registered": len(structure.cam_from_sfm),
        "views": len(pictures.names),
        "sparse_points": len(structure.points),
        "reprojection_px": round(structure.reprojection_px, 4),
        **scaled.notes,
    }
    nothing = np.full(views.grid, np.nan, np.float32)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        name = pictures.names[row["view_id"]]
        if name not in structure.cam_from_sfm:
            return nothing
        return np.asarray(pictures.grid.depth_on_left_grid(read(name)) * np.float32(scaled.scale_m))

    return Prepared(predict, notes)
