"""ArUco board: an A3 sheet under an assembly, with its marker size, dictionary and layout.

The sheet lies in the plane z = 0 of the world frame, centred on the origin, long side along x; seen from above, x
points right and y up. Lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

MARKER_MODULES = 6
"""Modules across a marker of a 4 x 4 dictionary, including its black border."""

MARGIN_MODULES = 1.5
"""White margin between a marker and the sheet's edge, modules: 1 of quiet zone and 0.5 for the printed line."""


@dataclass(frozen=True)
class BoardSpec:
    """A3 sheet with ArUco markers around the assembly; long side along world x, centred on the origin.

    ``markers`` is the number of markers, 6 or 12; ``dictionary`` is the name of an OpenCV ArUco dictionary.
    """

    width_m: float = 0.420
    height_m: float = 0.297
    markers: int = 6
    marker_side_m: float = 0.050
    dictionary: str = "DICT_4X4_50"


def marker_corners_m(spec: BoardSpec) -> dict[int, Float64[ndarray, "4 3"]]:
    """Return the corners of each marker in the world frame, metres, keyed by marker id.

    Corners are in OpenCV's order: top left, top right, bottom right, bottom left, as seen from above with +y up.
    Ids count from 0 row by row, starting at the top left marker.

    Raises ``ValueError`` if the board has neither 6 nor 12 markers or the markers are too close to each other.
    """
    half = spec.marker_side_m / 2
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    return {
        marker_id: square + np.array([x_m, y_m, 0.0])
        for marker_id, (x_m, y_m) in enumerate(_marker_centres_m(spec))
    }


def _marker_centres_m(spec: BoardSpec) -> list[tuple[float, float]]:
    """Return the marker centres, row by row from the top, as far from the assembly as the sheet allows.

    Six markers form two columns at the short sides, outside the assembly's shadow; twelve also fill the long
    sides. Centres are rounded to whole millimetres, which keeps marker edges on the pixel edges of a texture.
    """
    inset_m = spec.marker_side_m * (0.5 + MARGIN_MODULES / MARKER_MODULES)
    x_m = _floor_to_millimetre(spec.width_m / 2 - inset_m)
    y_m = _floor_to_millimetre(spec.height_m / 2 - inset_m)
    if spec.markers == 6:
        edge_row = [-x_m, x_m]
    elif spec.markers == 12:
        inner_m = _floor_to_millimetre(x_m / 2)
        edge_row = [-x_m, -inner_m, 0.0, inner_m, x_m]
    else:
        raise ValueError(f"markers is {spec.markers}, expected 6 or 12")
    rows = {y_m: edge_row, 0.0: [-x_m, x_m], -y_m: edge_row}
    centres = [(x, y) for y, row in rows.items() for x in row]
    _check_quiet_zones(centres, spec)
    return centres


def _check_quiet_zones(centres: list[tuple[float, float]], spec: BoardSpec) -> None:
    points = np.array(centres)
    distance = np.abs(points[:, None] - points[None]).max(axis=-1)
    smallest_m = distance[~np.eye(len(points), dtype=bool)].min()
    min_distance_m = spec.marker_side_m * (1 + 1 / MARKER_MODULES)
    if smallest_m < min_distance_m:
        raise ValueError(
            f"{spec.markers} markers of {spec.marker_side_m} m leave each other no quiet zone on a sheet of"
            f" {spec.width_m} x {spec.height_m} m: {smallest_m:.4f} m apart, {min_distance_m:.4f} m needed"
        )


def _floor_to_millimetre(length_m: float) -> float:
    return float(np.floor(length_m * 1000 + 1e-9) / 1000)
