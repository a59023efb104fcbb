"""The A3 sheet under the assembly: where its ArUco markers are, and the picture printed on it.

Sheet coordinates are world x and y (metres, origin in the middle, the sheet seen from above with x to the
right and y up). The picture's row 0 is the sheet's +y edge, its column 0 the -x edge.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from dataset_builder.specs import BoardSpec

MARKER_MODULES = 6
"""Modules across a marker of a 4 x 4 dictionary, its black frame included."""

MARGIN_MODULES = 1.5
"""White between a marker and the sheet's edge: the quiet zone, and half a module for the printed line."""

LINE_M = 0.0005
LINE_INSET_M = 0.002
PAPER, INK, GREY_INK = 255, 0, 120


def marker_corners_m(spec: BoardSpec) -> dict[int, Float64[ndarray, "4 3"]]:
    """Return each marker's world corners, metres, in OpenCV's order as printed.

    The order is top left, top right, bottom right, bottom left, for a reader who faces +y. Ids count
    from 0 along the sheet's rows, from the top left marker on.
    """
    half = spec.marker_side_m / 2
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    return {
        marker_id: square + np.array([x_m, y_m, 0.0])
        for marker_id, (x_m, y_m) in enumerate(_marker_centres_m(spec))
    }


def board_texture(spec: BoardSpec, px_per_m: float) -> UInt8[ndarray, "h w"]:
    """Return the printed sheet in grey levels; every marker edge falls on a pixel edge.

    Raises ``ValueError`` where ``px_per_m`` does not resolve the markers' modules into whole pixels.
    """
    height, width = (_whole(side * px_per_m, spec, px_per_m) for side in (spec.height_m, spec.width_m))
    texture = np.full((height, width), PAPER, dtype=np.uint8)
    _draw_border(texture, px_per_m)
    module_px = _whole(spec.marker_side_m / MARKER_MODULES * px_per_m, spec, px_per_m)
    side_px = module_px * MARKER_MODULES
    dictionary = _dictionary(spec)
    for marker_id, corners in marker_corners_m(spec).items():
        row = _whole((spec.height_m / 2 - corners[0, 1]) * px_per_m, spec, px_per_m)
        column = _whole((spec.width_m / 2 + corners[0, 0]) * px_per_m, spec, px_per_m)
        marker = cv2.aruco.generateImageMarker(dictionary, marker_id, side_px)
        texture[row : row + side_px, column : column + side_px] = marker
        _draw_caption(texture, f"{spec.dictionary} {marker_id}", row + side_px, column, module_px)
    return texture


def _marker_centres_m(spec: BoardSpec) -> list[tuple[float, float]]:
    """Return the markers' middles, row by row from the top, as far from the assembly as the sheet allows.

    Six stand in two columns at the short sides, beyond the assembly's shadow; twelve also fill the long
    sides. Whole millimetres keep marker edges on the pixel edges of a texture.
    """
    inset_m = spec.marker_side_m * (0.5 + MARGIN_MODULES / MARKER_MODULES)
    x_m = _whole_millimetres(spec.width_m / 2 - inset_m)
    y_m = _whole_millimetres(spec.height_m / 2 - inset_m)
    if spec.markers == 6:
        edge_row = [-x_m, x_m]
    elif spec.markers == 12:
        inner_m = _whole_millimetres(x_m / 2)
        edge_row = [-x_m, -inner_m, 0.0, inner_m, x_m]
    else:
        raise ValueError(f"a board has 6 or 12 markers, not {spec.markers}")
    rows = {y_m: edge_row, 0.0: [-x_m, x_m], -y_m: edge_row}
    centres = [(x, y) for y, row in rows.items() for x in row]
    _check_quiet_zones(centres, spec)
    return centres


def _check_quiet_zones(centres: list[tuple[float, float]], spec: BoardSpec) -> None:
    points = np.array(centres)
    apart = np.abs(points[:, None] - points[None]).max(axis=-1)
    nearest_m = apart[~np.eye(len(points), dtype=bool)].min()
    needed_m = spec.marker_side_m * (1 + 1 / MARKER_MODULES)
    if nearest_m < needed_m:
        raise ValueError(
            f"{spec.markers} markers of {spec.marker_side_m} m leave each other no quiet zone on a sheet of"
            f" {spec.width_m} x {spec.height_m} m: {nearest_m:.4f} m apart, {needed_m:.4f} m needed"
        )


def _whole_millimetres(length_m: float) -> float:
    return float(np.floor(length_m * 1000 + 1e-9) / 1000)


def _whole(pixels: float, spec: BoardSpec, px_per_m: float) -> int:
    """Return ``pixels`` as the whole number it must be, or say which resolution misses the pixel edges."""
    if abs(pixels - round(pixels)) > 1e-6:
        raise ValueError(
            f"at {px_per_m} px/m an edge of the board {spec} falls {pixels:.4f} pixels in, on no pixel edge"
        )
    return round(pixels)


def _dictionary(spec: BoardSpec) -> cv2.aruco.Dictionary:
    if not spec.dictionary.startswith("DICT_4X4_"):
        raise ValueError(f"the board knows 4 x 4 dictionaries, not {spec.dictionary}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))


def _draw_border(texture: UInt8[ndarray, "h w"], px_per_m: float) -> None:
    """Draw the thin line round the printed area."""
    inset, line = round(LINE_INSET_M * px_per_m), max(1, round(LINE_M * px_per_m))
    ring = texture[inset:-inset, inset:-inset]
    inner = ring[line:-line, line:-line].copy()
    ring[:] = GREY_INK
    ring[line:-line, line:-line] = inner


def _draw_caption(texture: UInt8[ndarray, "h w"], text: str, row_below: int, column: int, module_px: int) -> None:
    """Print ``text`` small and grey under a marker, below its quiet zone; none where the sheet ends."""
    scale, thickness = module_px / 70, max(1, module_px // 20)
    baseline = row_below + round(1.75 * module_px)
    if baseline < texture.shape[0] - module_px:
        origin = (column, baseline)
        cv2.putText(texture, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, GREY_INK, thickness, cv2.LINE_AA)
