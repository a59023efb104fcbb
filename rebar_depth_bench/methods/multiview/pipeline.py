"""Multi-view pipeline: undistorted images, sparse reconstruction, metric scale, dense depth and the predictor."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.methods.base import Prepared
from rebar_depth_bench.methods.multiview.dense import DENSE_METHODS
from rebar_depth_bench.methods.multiview.images import LeftImages, row_columns, select_pairs, write_left_images
from rebar_depth_bench.methods.multiview.metric_scale import SCALE_SOURCES
from rebar_depth_bench.methods.multiview.sfm import SparseReconstruction, reconstruct_sparse
from rebar_depth_bench.parallel import Progress, silent


def reconstruct_images(
    views: Views, left_images: LeftImages, work: Path, progress: Progress = silent
) -> SparseReconstruction:
    """Return the sparse reconstruction of a config; if there is a board, its markers select the pairs to match."""
    K, board = left_images.grid.K, views.board
    pairs = select_pairs(left_images.markers, board, K) if board else None
    names = list(left_images.names.values())
    return reconstruct_sparse(left_images.folder, names, K, work, pairs=pairs, progress=progress)


def check(views: Views, dense: str, scale_source: str) -> None:
    """Raise ``MethodError`` if the named dense method cannot run or the scale source does not suit the config.

    Raises ``DatasetError`` if the config has no colour.
    """
    views.check_columns(row_columns(views), f"{dense}-{scale_source}")
    DENSE_METHODS[dense].check()
    SCALE_SOURCES[scale_source].check(views)


def prepare(views: Views, work: Path, progress: Progress, dense: str, scale_source: str) -> Prepared:
    """Reconstruct a config from its left views; notes compare cameras and scale with ground truth.

    Intermediate results are stored in ``work`` and reused. Views that were not registered have no prediction.
    """
    left_images = write_left_images(views, work / "images")
    reconstruction = reconstruct_images(views, left_images, work, progress)
    reader = cache(lambda: DENSE_METHODS[dense].run(left_images, reconstruction, work, progress))
    # The scale comes first: missing markers raise an error before hours of dense matching.
    metric_scale = SCALE_SOURCES[scale_source].scale(views, left_images, reconstruction, reader)
    read_depth = reader()
    notes = {
        "views_registered": len(reconstruction.cam_from_sfm),
        "views": len(left_images.names),
        "sparse_points": len(reconstruction.points),
        "reprojection_px": round(reconstruction.reprojection_px, 4),
        **metric_scale.notes,
    }
    no_depth = np.full(views.grid, np.nan, np.float32)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        name = left_images.names[row["view_id"]]
        if name not in reconstruction.cam_from_sfm:
            return no_depth
        return np.asarray(left_images.grid.depth_on_left_grid(read_depth(name)) * np.float32(metric_scale.scale_m))

    return Prepared(predict, notes)
