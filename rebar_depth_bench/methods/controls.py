"""The control that knows nothing: the same depth everywhere. Whatever scaling it corrects is scale, not shape.

Controls that know the answer: exact depth, and exact depth spoiled by a known factor and noise.

For teaching and for tests: what a perfect submission scores, and what scale and noise of known size do to each
number. They read the ground truth and so are no methods.

The control that knows the board and nothing else: the plane it lies in, from its markers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray

from rebar_depth_bench.data.dataset import ConfigViews
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.geometry.cameras import pixel_rays
from rebar_depth_bench.methods.base import Method, MethodInfo, MultiViewMethod, Predictor, Prepared
from rebar_depth_bench.progress import Progress

CONSTANT_DEPTH_M = 1.0


def _load() -> Predictor:
    return _predict


def _predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    return np.full(row["left_rgb"].shape[:2], CONSTANT_DEPTH_M, np.float32)


CONSTANT = Method(
    MethodInfo(
        name="constant",
        summary=f"control: {CONSTANT_DEPTH_M:g} m at every pixel",
        columns=("left_rgb",),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
    ),
    _load,
)


FACTOR = 1.25
NOISE = 0.01


def spoiled(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    """Return ``FACTOR`` times the truth, times 1 + Gaussian noise of standard deviation ``NOISE`` at each pixel.

    The noise depends on the view's id alone. No answer where there is no surface.
    """
    seed = int.from_bytes(hashlib.sha256(row["view_id"].encode()).digest()[:8], "little")
    depth_m = row["left_depth"].astype(np.float64)
    noise = np.random.default_rng(seed).normal(0.0, NOISE, depth_m.shape)
    return np.asarray(FACTOR * depth_m * (1 + noise), np.float32)


def _control(name: str, summary: str) -> MethodInfo:
    return MethodInfo(
        name=name,
        summary=f"control that reads the ground truth: {summary}",
        columns=("left_depth",),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
        reads_truth=True,
    )


TRUTH = Method(_control("truth", "exact depth"), lambda: lambda row: np.asarray(row["left_depth"]))
NOISY_TRUTH = Method(
    _control("noisy-truth", f"{FACTOR:g} times exact depth, with {NOISE:.0%} of noise"), lambda: spoiled
)


def plane_depth_m(
    cam_from_board: Float64[ndarray, "4 4"], rays_cam: Float64[ndarray, "h w 3"]
) -> Float32[ndarray, "h w"]:
    """Return the planar depth, metres, at which rays (z = 1) meet the board's plane z = 0; NaN where they do not.

    With n the board's normal and t its origin in the camera frame: depth = n . t / n . ray.
    """
    normal, origin_m = cam_from_board[:3, 2], cam_from_board[:3, 3]
    with np.errstate(divide="ignore", over="ignore"):
        depth_m = np.asarray(normal @ origin_m / (rays_cam @ normal), np.float32)
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, np.float32(np.nan))


def _check(views: ConfigViews) -> None:
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise MethodError(
            f"board-plane needs OpenCV ({error}): pip install 'rebar-depth-bench[methods]'"
        ) from None
    if views.board is None:
        raise MethodError(
            f"{views.config}: the scene has no ArUco board; name configs that have one (--config lattice pile)"
        )


def _prepare(views: ConfigViews, work: Path, progress: Progress) -> Prepared:
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
        summary="control: the plane of the ArUco board, by its markers in the left picture; none seen, no answer",
        columns=("left_rgb", "left_K", "left_distortion"),
        uses_intrinsics=True,
        source="this project, OpenCV's ArUco detector",
        licence="Apache-2.0",
    ),
    _prepare,
    _check,
)
