"""Multi-view pipeline: undistorted images, sparse reconstruction, metric scale, dense depth and the predictor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.methods.base import Prepared
from rebar_depth_bench.methods.multiview.dense import (
    DepthReader,
    patch_match_depth,
    plane_sweep_depth,
    require_cuda,
)
from rebar_depth_bench.methods.multiview.metric_scale import camera_errors, fit_board
from rebar_depth_bench.methods.multiview.sfm import (
    LeftImages,
    SparseReconstruction,
    reconstruct,
    row_columns,
    write_left_images,
)
from rebar_depth_bench.parallel import Progress
from rebar_depth_bench.scoring.protocol import interior

_TRUTH_COLUMNS = ("left_depth", "left_mask")


def check(views: Views, name: str, *, uses_patch_match: bool, is_anchored: bool) -> None:
    """Raise ``MethodError`` if the method ``name`` cannot run here, or if the config has no board for its scale.

    Raises ``DatasetError`` if the config has no colour, or no ground truth for an anchored scale.
    """
    views.check_columns(row_columns(views), name)
    if uses_patch_match:
        require_cuda()
    if is_anchored:
        views.check_columns(_TRUTH_COLUMNS, "a scale anchored to the ground truth")
    elif views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board to determine the scale; select configs with one "
            "(--config lattice pile), or use a method whose name ends in -anchored"
        )


def prepare(
    views: Views, work: Path, progress: Progress, *, uses_patch_match: bool, is_anchored: bool
) -> Prepared:
    """Reconstruct a config from its left views; notes compare cameras and scale with ground truth.

    Intermediate results are stored in ``work`` and reused. Views that were not registered have no prediction.
    """
    left_images = write_left_images(views, work / "images")
    reconstruction = reconstruct(left_images, views.board, work, progress)
    dense_depth = patch_match_depth if uses_patch_match else plane_sweep_depth
    if is_anchored:
        read_depth = dense_depth(left_images, reconstruction, work, progress)
        scale_m, scale_notes = _scale_from_ground_truth(views, left_images, reconstruction, read_depth)
    else:  # The scale comes first: missing markers raise an error before hours of dense matching.
        assert views.board is not None
        scale_m, scale_notes = _scale_from_markers(views.board, left_images, reconstruction)
        read_depth = dense_depth(left_images, reconstruction, work, progress)
    notes = {
        "views_registered": len(reconstruction.cam_from_sfm),
        "views": len(left_images.names),
        "sparse_points": len(reconstruction.points),
        "reprojection_px": round(reconstruction.reprojection_px, 4),
        **scale_notes,
    }
    no_depth = np.full(views.grid, np.nan, np.float32)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        name = left_images.names[row["view_id"]]
        if name not in reconstruction.cam_from_sfm:
            return no_depth
        return np.asarray(left_images.grid.depth_on_left_grid(read_depth(name)) * np.float32(scale_m))

    return Prepared(predict, notes)


def _scale_from_markers(
    board: BoardSpec, left_images: LeftImages, reconstruction: SparseReconstruction
) -> tuple[float, Mapping[str, Any]]:
    """Return metres per unit of the reconstruction by the markers of the board, and notes."""
    fit = fit_board(left_images.markers, reconstruction.cam_from_sfm, left_images.grid.K, board)
    notes = {
        "scale_from": f"ArUco markers of {board.marker_side_m:g} m, triangulated",
        "markers": list(fit.markers),
        "marker_rms_mm": round(1000 * fit.rms_m, 4),
        **camera_errors(reconstruction.cam_from_sfm, left_images.cam_from_world, fit.metric.scale, fit.metric),
    }
    return fit.metric.scale, notes


def _scale_from_ground_truth(
    views: Views, left_images: LeftImages, reconstruction: SparseReconstruction, read_depth: DepthReader
) -> tuple[float, Mapping[str, Any]]:
    """Return the median over views of median(z / z_estimated) on scored pixels (the paper, II.C), and notes."""
    ratios = []
    for row in views.rows(*_TRUTH_COLUMNS):
        name = left_images.names[row["view_id"]]
        if name not in reconstruction.cam_from_sfm:
            continue
        estimated = left_images.grid.depth_on_left_grid(read_depth(name))
        scored = interior(row["left_mask"]) & (row["left_depth"] > 0) & np.isfinite(estimated)
        if scored.any():
            ratios.append(float(np.median(row["left_depth"][scored].astype(np.float64) / estimated[scored])))
    if not ratios:
        raise MethodError(
            f"{views.config}: no registered view has depth on steel, expected at least one to determine the scale"
        )
    scale_m = float(np.median(ratios))
    notes = {
        "scale_from": "the median of ground truth over depth found: not metric by itself",
        "views_anchored_with": len(ratios),
        **camera_errors(reconstruction.cam_from_sfm, left_images.cam_from_world, scale_m),
    }
    return scale_m, notes
