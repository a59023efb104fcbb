"""Bending of bars: conversion of a path of straight legs to a centreline with arcs at the corners."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

SMALL_BAR_M = 0.016
"""Largest diameter, metres, with a mandrel of 4 d in EN 1992-1-1 (table 8.1N); larger bars need 7 d."""


def mandrel_diameter_m(diameter_m: float) -> float:
    """Return the minimum mandrel diameter of EN 1992-1-1, table 8.1N, metres: 4 d up to 16 mm, 7 d above."""
    return (4.0 if diameter_m <= SMALL_BAR_M else 7.0) * diameter_m


def bend_radius_m(diameter_m: float) -> float:
    """Return the centreline radius of a bend around the minimum mandrel, metres."""
    return (mandrel_diameter_m(diameter_m) + diameter_m) / 2


def bent_line_m(
    corners_m: Float64[ndarray, "n 3"], radius_m: float, step_deg: float = 6.0
) -> Float64[ndarray, "k 3"]:
    """Return the path through ``corners_m`` with an arc of ``radius_m`` at each inner corner, metres.

    Arcs are tangent to both legs and are sampled at steps of at most ``step_deg``; a straight leg is represented
    by its two ends. Collinear corners are kept. Raises ``ValueError`` if two arcs would overlap on a leg, if a leg
    has zero length, or if the path reverses its direction at a corner.
    """
    corners = np.asarray(corners_m, dtype=np.float64)
    legs = np.diff(corners, axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    if len(lengths) == 0 or lengths.min() <= 0:
        raise ValueError("a bar needs two or more corners, none repeated in a row")
    directions = legs / lengths[:, None]
    turns_rad = [_turn_angle(before, after) for before, after in pairwise(directions)]
    tangent_length_m = np.array([0.0, *(radius_m * np.tan(turn_rad / 2) for turn_rad in turns_rad), 0.0])
    too_short = np.flatnonzero(tangent_length_m[:-1] + tangent_length_m[1:] > lengths + 1e-12)
    if len(too_short):
        leg = int(too_short[0])
        raise ValueError(
            f"leg {leg + 1} is {lengths[leg]:.4f} m long, but its bends of radius {radius_m:.4f} m need "
            f"{tangent_length_m[leg] + tangent_length_m[leg + 1]:.4f} m"
        )
    pieces = [corners[:1]]
    for n, turn_rad in enumerate(turns_rad):
        pieces.append(_arc(corners[n + 1], directions[n], directions[n + 1], turn_rad, radius_m, step_deg))
    pieces.append(corners[-1:])
    # Two arcs that together fill a leg share a point.
    return without_repeats(np.concatenate(pieces), 1e-9)


def resample_polyline_m(line_m: Float64[ndarray, "n 3"], step_m: float) -> Float64[ndarray, "k 3"]:
    """Return evenly spaced points along a polyline, including both ends, at most ``step_m`` apart."""
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line_m, axis=0), axis=1))])
    at_m = np.linspace(0.0, along_m[-1], int(np.ceil(along_m[-1] / step_m)) + 1)
    return np.stack([np.interp(at_m, along_m, column) for column in line_m.T], axis=-1)


def _turn_angle(before: Float64[ndarray, " 3"], after: Float64[ndarray, " 3"]) -> float:
    """Return the change of direction at a corner, radians; raise ``ValueError`` above 179 degrees."""
    turn_rad = float(np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after))
    if turn_rad > np.deg2rad(179.0):
        raise ValueError("the path turns straight back on itself at a corner; use two corners for the turn")
    return turn_rad


def _arc(
    corner: Float64[ndarray, " 3"],
    before: Float64[ndarray, " 3"],
    after: Float64[ndarray, " 3"],
    turn_rad: float,
    radius_m: float,
    step_deg: float,
) -> Float64[ndarray, "k 3"]:
    """Return the points of the arc including both ends, or only the corner if the legs are collinear."""
    if turn_rad < 1e-9:
        return corner[None]
    start = corner - before * radius_m * np.tan(turn_rad / 2)
    inward = after - (after @ before) * before
    inward /= np.linalg.norm(inward)
    angle = np.linspace(0.0, turn_rad, max(2, int(np.ceil(np.rad2deg(turn_rad) / step_deg - 1e-9)) + 1))[:, None]
    return np.asarray(start + radius_m * (np.sin(angle) * before + (1 - np.cos(angle)) * inward))


def without_repeats(points: Float64[ndarray, "n 3"], tolerance: float) -> Float64[ndarray, "k 3"]:
    """Return the points without those that are at most ``tolerance`` from their predecessor."""
    is_new = np.linalg.norm(np.diff(points, axis=0), axis=1) > tolerance
    return np.asarray(points[np.concatenate([[True], is_new])])
