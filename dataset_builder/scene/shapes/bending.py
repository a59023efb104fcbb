"""Bends bars: a path of straight legs becomes a centreline with arcs at its corners."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

SMALL_BAR_M = 0.016
"""Up to this diameter EN 1992-1-1 (table 8.1N) bends round four diameters, above it round seven."""


def mandrel_diameter_m(diameter_m: float) -> float:
    """Return the least mandrel diameter of EN 1992-1-1, table 8.1N: 4 d up to 16 mm, 7 d above, metres."""
    return (4.0 if diameter_m <= SMALL_BAR_M else 7.0) * diameter_m


def bend_radius_m(diameter_m: float) -> float:
    """Return the radius of the centreline in a bend round the least mandrel, metres."""
    return (mandrel_diameter_m(diameter_m) + diameter_m) / 2


def bent_line_m(
    corners_m: Float64[ndarray, "n 3"], radius_m: float, step_deg: float = 6.0
) -> Float64[ndarray, "k 3"]:
    """Return the path through ``corners_m`` with an arc of ``radius_m`` at each inner corner, metres.

    Arcs touch both legs and come as points ``step_deg`` apart at most; straight legs keep their two ends.
    Collinear corners stay as they are. Raises ``ValueError`` where two arcs would overlap on a leg, a leg has
    no length, or a corner turns straight back.
    """
    corners = np.asarray(corners_m, dtype=np.float64)
    legs = np.diff(corners, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    if len(lengths) == 0 or lengths.min() <= 0:
        raise ValueError("a bar needs two or more corners, none repeated in a row")
    directions = legs / lengths[:, None]
    turns = [_turn(before, after) for before, after in pairwise(directions)]
    taken = np.array([0.0, *(radius_m * np.tan(turn / 2) for turn in turns), 0.0])
    short = np.flatnonzero(taken[:-1] + taken[1:] > lengths + 1e-12)
    if len(short):
        leg = int(short[0])
        raise ValueError(
            f"leg {leg + 1} is {lengths[leg]:.4f} m long, its bends of radius {radius_m:.4f} m take "
            f"{taken[leg] + taken[leg + 1]:.4f} m"
        )
    pieces = [corners[:1]]
    for n, turn in enumerate(turns):
        pieces.append(_arc(corners[n + 1], directions[n], directions[n + 1], turn, radius_m, step_deg))
    pieces.append(corners[-1:])
    return _without_repeats(np.concatenate(pieces))


def resampled_m(line_m: Float64[ndarray, "n 3"], step_m: float) -> Float64[ndarray, "k 3"]:
    """Return points spread evenly along a line, both ends included, ``step_m`` apart or closer."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    at_m = np.linspace(0.0, along_m[-1], int(np.ceil(along_m[-1] / step_m)) + 1)
    return np.stack([np.interp(at_m, along_m, column) for column in line_m.T], axis=-1)


def _turn(before: Float64[ndarray, " 3"], after: Float64[ndarray, " 3"]) -> float:
    """Return the angle by which the direction changes at a corner, radians."""
    turn = float(np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after))
    if turn > np.deg2rad(179.0):
        raise ValueError("the path turns straight back on itself at a corner; give the turn two corners")
    return turn


def _arc(
    corner: Float64[ndarray, " 3"],
    before: Float64[ndarray, " 3"],
    after: Float64[ndarray, " 3"],
    turn: float,
    radius_m: float,
    step_deg: float,
) -> Float64[ndarray, "k 3"]:
    """Return the arc's points, both ends included, or the bare corner where the path goes straight on."""
    if turn < 1e-9:
        return corner[None]
    start = corner - before * radius_m * np.tan(turn / 2)
    inward = after - (after @ before) * before
    inward /= np.linalg.norm(inward)
    angle = np.linspace(0.0, turn, max(2, int(np.ceil(np.rad2deg(turn) / step_deg)) + 1))[:, None]
    return np.asarray(start + radius_m * (np.sin(angle) * before + (1 - np.cos(angle)) * inward))


def _without_repeats(points: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Drop points that repeat the one before: two arcs may meet on a leg that they take up whole."""
    new = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-9
    return np.asarray(points[np.concatenate([[True], new])])
