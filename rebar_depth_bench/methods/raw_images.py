"""Rectified images for methods that do not read the lens distortion, and their depth on the raw left grid.

A method that reads the right image is given the rectified pair (``geometry.rectification``), another one the
undistorted left image (``geometry.rectification``). Its depth is transferred to the raw left image without
interpolation. Multi-view methods, and those that read ``left_distortion``, do this themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from rebar_depth_bench.errors import MethodError, format_shape
from rebar_depth_bench.methods.base import Predictor
from rebar_depth_bench.methods.stereo.disparity import STEREO_COLUMNS

_MONO_COLUMNS = ("left_rgb", "left_K", "left_distortion")
_RECTIFIED_COLUMNS = frozenset(("left_rgb", "right_rgb", "left_K", "right_K", "right_distortion", "baseline_m"))
"""Columns of a rectified row. The poses of a rectified pair are not among them."""

_Rectify = Callable[[Mapping[str, Any]], tuple[dict[str, Any], Callable[[Any], Any]]]
"""Function from a raw row to the cells of the rectified one, and the function of its depth on the raw grid."""


def rectifying_predictor(predictor: Predictor, columns: Sequence[str]) -> tuple[Predictor, tuple[str, ...]]:
    """Return a predictor of raw rows, and the columns that it needs, for a predictor of rectified rows.

    ``columns`` are those that ``predictor`` reads. Raises ``MethodError`` if a rectified row lacks one of them,
    and if OpenCV is missing.
    """
    if others := sorted(set(columns) - _RECTIFIED_COLUMNS):
        raise MethodError(
            f"the images are not rectified: the method needs {', '.join(others)}, expected columns among "
            f"{', '.join(sorted(_RECTIFIED_COLUMNS))}, or left_distortion if it rectifies them itself"
        )
    try:
        import cv2  # noqa: F401
    except ImportError as error:
        raise MethodError(
            f"the images are not rectified, which needs OpenCV ({error}): pip install 'rebar-depth-bench[methods]'"
        ) from None
    is_stereo = any(name.startswith("right_") or name == "baseline_m" for name in columns)
    rectify, needed = (_rectified_pair, STEREO_COLUMNS) if is_stereo else (_undistorted_left, _MONO_COLUMNS)
    return partial(_predict, predictor, tuple(columns), rectify), needed


def _predict(
    predictor: Predictor, columns: Sequence[str], rectify: _Rectify, row: Mapping[str, Any]
) -> Float[ndarray, "h w"]:
    cells, on_raw_grid = rectify(row)
    depth_m = np.asarray(predictor({"view_id": row["view_id"], **{name: cells[name] for name in columns}}))
    expected = cells["left_rgb"].shape[:2]
    if depth_m.shape != expected or depth_m.dtype.kind != "f":
        raise MethodError(
            f"{row['view_id']}: the method returned {depth_m.dtype} of shape {depth_m.shape}, expected float "
            f"metres of the rectified image, {format_shape(expected)}"
        )
    return np.asarray(on_raw_grid(depth_m))


def _rectified_pair(row: Mapping[str, Any]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    from rebar_depth_bench.geometry.rectification import raw_depth_m, rectified_pair

    pair = rectified_pair(row)
    cells = {
        "left_rgb": pair.left_rgb,
        "right_rgb": pair.right_rgb,
        "left_K": pair.K,
        "right_K": pair.K,
        "right_distortion": np.zeros(5),
        "baseline_m": pair.baseline_m,
    }
    return cells, partial(raw_depth_m, pair)


def _undistorted_left(row: Mapping[str, Any]) -> tuple[dict[str, Any], Callable[[Any], Any]]:
    from rebar_depth_bench.geometry.rectification import pinhole_grid, pinhole_image

    height, width, _ = row["left_rgb"].shape
    grid = pinhole_grid(row, width, height)
    return {"left_rgb": pinhole_image(row, grid), "left_K": grid.K}, grid.depth_on_left_grid
