"""Texture of the printed ArUco board under the assembly (A3).

Row 0 is the +y edge of the board, column 0 the -x edge.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m

LINE_M = 0.0005
"""Width of the border line, metres."""
LINE_INSET_M = 0.002
"""Distance of the border line from the edge of the board, metres."""
PAPER, GREY_INK = 255, 120


def board_texture(spec: BoardSpec, px_per_m: float) -> UInt8[ndarray, "h w"]:
    """Return the printed board as grey levels, for a dictionary of 4 x 4 modules.

    Marker edges coincide with pixel edges if their distances are whole numbers of pixels at ``px_per_m``.
    """
    height, width = round(spec.height_m * px_per_m), round(spec.width_m * px_per_m)
    texture = np.full((height, width), PAPER, dtype=np.uint8)
    _draw_border(texture, px_per_m)
    module_px = round(spec.marker_side_m / MARKER_MODULES * px_per_m)
    side_px = module_px * MARKER_MODULES
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    for marker_id, corners in marker_corners_m(spec).items():
        row = round((spec.height_m / 2 - corners[0, 1]) * px_per_m)
        column = round((spec.width_m / 2 + corners[0, 0]) * px_per_m)
        marker = cv2.aruco.generateImageMarker(dictionary, marker_id, side_px)
        texture[row : row + side_px, column : column + side_px] = marker
        _draw_caption(texture, f"{spec.dictionary} {marker_id}", row + side_px, column, module_px)
    return texture


def _draw_border(texture: UInt8[ndarray, "h w"], px_per_m: float) -> None:
    """Draw the thin border line around the printed area."""
    inset, line = round(LINE_INSET_M * px_per_m), max(1, round(LINE_M * px_per_m))
    ring = texture[inset:-inset, inset:-inset]
    inner = ring[line:-line, line:-line].copy()
    ring[:] = GREY_INK
    ring[line:-line, line:-line] = inner


def _draw_caption(texture: UInt8[ndarray, "h w"], text: str, row_below: int, column: int, module_px: int) -> None:
    """Draw ``text`` small and grey below the quiet zone of a marker; omit it if the board ends there."""
    scale, thickness = module_px / 70, max(1, module_px // 20)
    baseline = row_below + round(1.75 * module_px)
    if baseline < texture.shape[0] - module_px:
        origin = (column, baseline)
        cv2.putText(texture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, GREY_INK, thickness, cv2.LINE_AA)
