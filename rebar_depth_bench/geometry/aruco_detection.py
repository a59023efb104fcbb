"""ArUco markers in colour pictures, and the board's pose by them, with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.aruco_board import BoardSpec, marker_corners_m
from rebar_depth_bench.geometry.cameras import rigid, rotation_matrix

_REFINEMENT_PX = 4
_REFINEMENT_MODULES = 0.8
"""How far the sub-pixel search reaches from a corner, the lesser of the two: never to the bits inside."""

Corners = dict[int, Float64[ndarray, "4 2"]]
"""A marker's corners by its id, pixels, in OpenCV's order."""


def detected_corners_px(rgb: UInt8[ndarray, "h w 3"], dictionary: str) -> Corners:
    """Return what OpenCV's detector finds in a picture: corners in pixels, centres at integers, by id.

    An id that is found twice is left out.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = _REFINEMENT_PX
    parameters.relativeCornerRefinmentWinSize = _REFINEMENT_MODULES
    parameters.cornerRefinementMaxIterations = 100
    parameters.cornerRefinementMinAccuracy = 0.001
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(grey)
    names = [] if ids is None else ids.ravel().tolist()
    once = {name for name in names if names.count(name) == 1}
    return {name: quad[0].astype(np.float64) for name, quad in zip(names, corners, strict=True) if name in once}


def board_pose(
    corners_px: Corners,
    board: BoardSpec,
    K: Float64[ndarray, "3 3"],
    distortion: Float64[ndarray, " 5"] | None = None,
) -> Float64[ndarray, "4 4"] | None:
    """Return ``cam_from_world``, metres, from the board's markers found in a picture; None where there are none.

    All corners together: OpenCV's solver for planar points (IPPE), then Levenberg-Marquardt on pixels. Corners are
    found about half a pixel inside the true ones (``dataset_builder.audit.markers``): with one marker of 80 px
    that puts the camera 1 % too far, with six hardly anything.
    """
    layout = marker_corners_m(board)
    seen = [marker for marker in layout if marker in corners_px]
    if not seen:
        return None
    corners_m = np.concatenate([layout[marker] for marker in seen])
    found_px = np.concatenate([corners_px[marker] for marker in seen])
    solved, turn, shift = cv2.solvePnP(corners_m, found_px, K, distortion, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        return None
    turn, shift = cv2.solvePnPRefineLM(corners_m, found_px, K, distortion, turn, shift)
    return rigid(rotation_matrix(turn.ravel()), shift.ravel())
