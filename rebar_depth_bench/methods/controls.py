"""Control methods, which serve as reference points for the scores of real methods.

- ``constant``: the same depth at every pixel. Whatever scaling improves in its scores is scale, not shape.
- ``truth`` and ``noisy-truth``: exact depth, and exact depth with a known factor and known noise. They show what a
  perfect submission scores and how scale and noise of known size affect each metric; they are meant for teaching
  and tests. They read the ground truth, so their scores describe no real method.
- ``board-plane``: the plane of the ArUco board, estimated from its markers, and nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.base.parallel import Progress
from rebar_depth_bench.data.rows import Views
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.methods.base import (
    Method,
    MethodInfo,
    MultiViewMethod,
    Prepared,
    import_optional,
    positive_or_nan,
)

CONSTANT_DEPTH_M = 1.0


def _prepare_constant(views: Views, work: Path, progress: Progress) -> Prepared:
    del work, progress
    depth_m = np.full(views.grid, CONSTANT_DEPTH_M, np.float32)
    return Prepared(lambda _: depth_m)


CONSTANT = MultiViewMethod(
    MethodInfo(
        name="constant",
        summary=f"control: {CONSTANT_DEPTH_M:g} m at every pixel",
        columns=(),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
        inputs="rgb",
    ),
    _prepare_constant,
    lambda _: None,
)


NOISY_TRUTH_FACTOR = 1.25
NOISY_TRUTH_STD = 0.01


def noisy_depth_m(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    """Return ground truth depth, metres, times ``NOISY_TRUTH_FACTOR`` and multiplicative Gaussian noise.

    Each pixel is multiplied by 1 + noise of standard deviation ``NOISY_TRUTH_STD``. The noise depends only on the
    view id. Pixels without a surface remain 0 (no prediction).
    """
    seed = int.from_bytes(hashlib.sha256(row["view_id"].encode()).digest()[:8], "little")
    depth_m = row["left_depth"].astype(np.float64)
    noise = np.random.default_rng(seed).normal(0.0, NOISY_TRUTH_STD, depth_m.shape)
    return np.asarray(NOISY_TRUTH_FACTOR * depth_m * (1 + noise), np.float32)


def _ground_truth_info(name: str, summary: str) -> MethodInfo:
    """Return the description of a control that reads the ground truth."""
    return MethodInfo(
        name=name,
        summary=f"control that reads the ground truth: {summary}",
        columns=("left_depth",),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
        uses_ground_truth=True,
    )


TRUTH = Method(_ground_truth_info("truth", "exact depth"), lambda: lambda row: np.asarray(row["left_depth"]))
NOISY_TRUTH = Method(
    _ground_truth_info(
        "noisy-truth", f"{NOISY_TRUTH_FACTOR:g} times exact depth, with {NOISY_TRUTH_STD:.0%} of noise"
    ),
    lambda: noisy_depth_m,
)


def plane_depth_m(
    cam_from_board: Float64[ndarray, "4 4"], rays_cam: Float64[ndarray, "h w 3"]
) -> Float32[ndarray, "h w"]:
    """Return the planar depth, metres, at which rays (z = 1) meet the board plane z = 0; NaN if they miss it.

    With n the normal of the board and t its origin in the camera frame: depth = n . t / n . ray.
    """
    normal, origin_m = cam_from_board[:3, 2], cam_from_board[:3, 3]
    with np.errstate(divide="ignore", over="ignore"):
        depth_m = np.asarray(normal @ origin_m / (rays_cam @ normal))
    return positive_or_nan(depth_m)


def _check_board_plane(views: Views) -> None:
    """Raise ``MethodError`` if OpenCV is missing or the config's scene has no board."""
    import_optional("cv2", "board-plane needs OpenCV", "methods")
    if views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board; name configs that have one (--config lattice pile)"
        )


def _prepare_board_plane(views: Views, work: Path, progress: Progress) -> Prepared:
    del work, progress
    from rebar_depth_bench.geometry.aruco_detection import board_pose, detected_corners_px

    board = views.board
    assert board is not None

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        K, distortion = row["left_K"], row["left_distortion"]
        height, width, _ = row["left_rgb"].shape
        pose = board_pose(detected_corners_px(row["left_rgb"], board.dictionary), board, K, distortion)
        if pose is None:
            return np.full((height, width), np.nan, np.float32)
        return plane_depth_m(pose, pixel_rays(K, width, height, distortion))

    return Prepared(predict)


BOARD_PLANE = MultiViewMethod(
    MethodInfo(
        name="board-plane",
        summary=(
            "control: the plane of the ArUco board, from its markers in the left image; no prediction without them"
        ),
        columns=("left_rgb", "left_K", "left_distortion"),
        uses_intrinsics=True,
        source="this project, OpenCV's ArUco detector",
        licence="Apache-2.0",
    ),
    _prepare_board_plane,
    _check_board_plane,
)
