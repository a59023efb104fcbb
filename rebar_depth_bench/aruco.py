"""ArUco markers in colour pictures, with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

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
