"""The A3 sheet under an assembly: its markers' size, dictionary and places. World frame, metres.

Sheet coordinates are world x and y (origin in the middle, the sheet seen from above with x to the right and y up).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

MARKER_MODULES = 6
"""Modules across a marker of a 4 x 4 dictionary, its black frame included."""

MARGIN_MODULES = 1.5
"""White between a marker and the sheet's edge: the quiet zone, and half a module for the printed line."""


@dataclass(frozen=True)
class BoardSpec:
    """An A3 sheet, long side along world x, centred on the origin, with ArUco markers round the assembly."""

    width_m: float = 0.420
    height_m: float = 0.297
    markers: int = 6
    marker_side_m: float = 0.050
    dictionary: str = "DICT_4X4_50"


def marker_corners_m(spec: BoardSpec) -> dict[int, Float64[ndarray, "4 3"]]:
    """Return each marker's world corners, metres, in OpenCV's order as printed.

    The order is top left, top right, bottom right, bottom left, for a reader who faces +y. Ids count
    from 0 along the sheet's rows, from the top left marker on.

    Raises ``ValueError`` for a board that is neither of 6 nor of 12 markers, or whose markers stand too close.
    """
    half = spec.marker_side_m / 2
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    return {
        marker_id: square + np.array([x_m, y_m, 0.0])
        for marker_id, (x_m, y_m) in enumerate(_marker_centres_m(spec))
    }


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
