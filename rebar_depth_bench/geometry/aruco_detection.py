"""ArUco marker detection and board pose estimation with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import rigid, rotation_matrix

_CORNER_WINDOW_PX = 4
_CORNER_WINDOW_MODULES = 0.8
"""Half window of the sub-pixel corner search, in pixels and in modules; the smaller one applies.

It never reaches the marker's inner bits.
"""

Corners = dict[int, Float64[ndarray, "4 2"]]
"""Corners of each marker in pixels, in OpenCV's order, keyed by marker id."""


def detected_corners_px(rgb: UInt8[ndarray, "h w 3"], dictionary: str) -> Corners:
    """Detect ArUco markers in an image and return their corners, keyed by id.

    Coordinates are pixels with pixel centres at integers. Ids detected more than once are omitted.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = _CORNER_WINDOW_PX
    parameters.relativeCornerRefinmentWinSize = _CORNER_WINDOW_MODULES
    parameters.cornerRefinementMaxIterations = 100
    parameters.cornerRefinementMinAccuracy = 0.001
    aruco_dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    corners, ids, _ = cv2.aruco.ArucoDetector(aruco_dictionary, parameters).detectMarkers(grey)
    marker_ids = [] if ids is None else ids.ravel().tolist()
    unique_ids = {marker_id for marker_id in marker_ids if marker_ids.count(marker_id) == 1}
    return {
        marker_id: quad[0].astype(np.float64)
        for marker_id, quad in zip(marker_ids, corners, strict=True)
        if marker_id in unique_ids
    }


def board_pose(
    corners_px: Corners,
    board: BoardSpec,
    K: Float64[ndarray, "3 3"],
    distortion: Float64[ndarray, " 5"] | None = None,
) -> Float64[ndarray, "4 4"] | None:
    """Estimate the camera pose ``cam_from_world`` (metres) from detected corners of the board's markers.

    All corners are used together: OpenCV's solver for planar points (IPPE), then Levenberg-Marquardt on the pixel
    residuals. Returns None if no marker of the board was detected or the solver fails.

    Corners are detected about half a pixel inside the true ones: with one
    marker of 80 px the camera comes out 1 % too far away, with six markers the error is negligible.
    """
    layout = marker_corners_m(board)
    visible_ids = [marker for marker in layout if marker in corners_px]
    if not visible_ids:
        return None
    object_points_m = np.concatenate([layout[marker] for marker in visible_ids])
    image_points_px = np.concatenate([corners_px[marker] for marker in visible_ids])
    solved, rvec, tvec = cv2.solvePnP(object_points_m, image_points_px, K, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        return None
    rvec, tvec = cv2.solvePnPRefineLM(object_points_m, image_points_px, K, distortion, rvec, tvec)
    return rigid(rotation_matrix(rvec.ravel()), tvec.ravel())
