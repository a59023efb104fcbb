"""Centrelines of links: closed stirrups with hooks, ties, rings and spirals. Local frame, metres.

The plane of a link is approximately z = 0. Where the two ends of a link pass each other, the line rises along z,
so that a link never touches itself.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m

HOOK_DEG = 135.0
"""Bend angle of each end round its corner, into the core: the seismic hook of ACI 318-19, section 25.3.4 (from a
secondary source)."""

SQUARE_HOOK_DEG = 90.0
"""Bend angle of the second hook of a tie, which is closed on the site."""

SELF_GAP_M = 3e-4
"""Clear distance of the two ends of a link where they pass each other, metres."""

BEND_STEP_DEG = 5.0
"""Largest angle between sampled points of a bend: chords of a 25 mm radius lie within 0.024 mm of its arc."""


def hook_extension_m(diameter_m: float) -> float:
    """Return the straight length beyond a seismic hook's bend: max(6 d, 75 mm), metres.

    The usual rule for seismic hooks, as in ISO and ACI standards [unverified: not checked against the standards].
    """
    return max(6 * diameter_m, 0.075)


def stirrup_centreline_m(
    size_m: tuple[float, float],
    diameter_m: float,
    outer_radius_m: float,
    radius_m: float | None = None,
    extension_m: float | None = None,
) -> Float64[ndarray, "n 3"]:
    """Return the centreline of a stirrup of outside ``size_m`` (along x, along y; nominal diameter), metres.

    It is a closed hoop whose two ends both bend round the corner at -x, +y; its centroid is the origin. The line
    rises along z at a constant slope from tip to tip, like one turn of a coil, so that its ends pass each other
    with ``SELF_GAP_M`` between surfaces at ``outer_radius_m`` from the axis. ``radius_m`` is that of the bends
    (default: the smallest of EN 1992-1-1), ``extension_m`` the straight length beyond a hook (default:
    ``hook_extension_m``). Raises ``ValueError`` if the bar has no thickness, or no room for its hooks.
    """
    if not 0 < diameter_m <= 2 * outer_radius_m:
        raise ValueError(f"a bar of {diameter_m} m cannot have an outer radius of {outer_radius_m} m")
    half_m = (np.array(size_m) - diameter_m) / 2
    radius_m = bend_radius_m(diameter_m) if radius_m is None else radius_m
    extension_m = hook_extension_m(diameter_m) if extension_m is None else extension_m
    corners_m = _corners_m(half_m, diameter_m, outer_radius_m, radius_m, extension_m)
    flat_m = bent_line_m(corners_m, radius_m, BEND_STEP_DEG)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flat_m, axis=0), axis=1))])
    # The two ends are one turn of the hoop apart along the line where they pass each other.
    turn_m = 4 * half_m.sum() - (8 - 2 * np.pi) * radius_m
    flat_m[:, 2] = along_m * climb_per_turn_m(outer_radius_m, turn_m) / turn_m
    return np.asarray(flat_m - _centroid_m(flat_m))


def tie_centreline_m(
    half_length_m: float,
    radius_m: float,
    extension_m: float,
    second_deg: float = SQUARE_HOOK_DEG,
    first_deg: float = HOOK_DEG,
    step_deg: float = BEND_STEP_DEG,
) -> Float64[ndarray, "n 3"]:
    """Return the centreline of a tie along x that holds two bars at x = -/+ ``half_length_m``, y = 0; metres.

    Its hooks bend round the two bars with ``radius_m``, the first by ``first_deg`` and the second by
    ``second_deg``, with straight ends of ``extension_m``; its leg is at y = -``radius_m``, and all of it is
    at z = 0. Bends are sampled as by ``bent_line_m``, which also raises ``ValueError``.
    """
    first, second = (
        hook_m((side * half_length_m, -radius_m), (side, 0.0), (0.0, 1.0), turn_deg, radius_m, extension_m)
        for side, turn_deg in ((-1, first_deg), (1, second_deg))
    )
    corners_m = np.concatenate([first[::-1], second])
    return bent_line_m(np.column_stack([corners_m, np.zeros(4)]), radius_m, step_deg)


def hook_m(
    start_m: tuple[float, float],
    ahead: tuple[float, float],
    inward: tuple[float, float],
    turn_deg: float,
    radius_m: float,
    extension_m: float,
) -> Float64[ndarray, "2 2"]:
    """Return corner and tip of a hook whose bend begins at ``start_m`` on a leg in direction ``ahead``, metres.

    It turns towards ``inward`` by ``turn_deg``; its straight end has the length ``extension_m``.
    """
    turn = np.deg2rad(turn_deg)
    tangent_m = radius_m * np.tan(turn / 2)
    corner_m = np.array(start_m) + tangent_m * np.array(ahead)
    back = np.cos(turn) * np.array(ahead) + np.sin(turn) * np.array(inward)
    return np.stack([corner_m, corner_m + (tangent_m + extension_m) * back])


def helix_m(radius_m: float, rise_m: float, turns: float, start_deg: float = 0.0) -> Float64[ndarray, "n 3"]:
    """Return a helix round the z axis that starts at z = 0 and rises by ``rise_m`` per turn, metres.

    The middles of its chords are at ``radius_m`` from the axis, so that a bar of the line touches nothing inside.
    """
    steps = max(8, int(np.ceil(turns * 360.0 / BEND_STEP_DEG)))
    angle = np.deg2rad(start_deg) + np.linspace(0.0, turns * 2 * np.pi, steps + 1)
    circumscribed_m = radius_m / np.cos((angle[1] - angle[0]) / 2)
    rise = (angle - angle[0]) / (2 * np.pi) * rise_m
    return np.stack([circumscribed_m * np.cos(angle), circumscribed_m * np.sin(angle), rise], axis=1)


def ring_m(
    radius_m: float, outer_radius_m: float, lap_m: float, start_deg: float = 0.0
) -> Float64[ndarray, "n 3"]:
    """Return a ring round the z axis whose ends lap by ``lap_m``, one on the other; metres."""
    turn_m = 2 * np.pi * radius_m
    return helix_m(radius_m, climb_per_turn_m(outer_radius_m, turn_m), 1 + lap_m / turn_m, start_deg)


def climb_per_turn_m(outer_radius_m: float, turn_m: float) -> float:
    """Return the rise along z of a turn of length ``turn_m`` that passes its start with ``SELF_GAP_M``, metres.

    It slightly exceeds the clear distance, because inclined lines are closer together than their vertical offset.
    """
    clear_m = 2 * outer_radius_m + SELF_GAP_M
    return float(clear_m / np.sqrt(1 - (clear_m / turn_m) ** 2))


def _corners_m(
    half_m: Float64[ndarray, " 2"], diameter_m: float, outer_radius_m: float, radius_m: float, extension_m: float
) -> Float64[ndarray, "7 3"]:
    """Return the tips and corners of the unbent path at z = 0: tip, hook, three hoop corners, hook, tip."""
    x_m, y_m = (float(half) for half in half_m)
    turn = np.deg2rad(HOOK_DEG)
    tangent_m = radius_m * np.tan(turn / 2)
    # Both ends bend round the centre (radius - x, y - radius), towards the opposite corner.
    first_hook = np.array([-x_m, y_m - radius_m + tangent_m])
    last_hook = np.array([radius_m - x_m - tangent_m, y_m])
    inward = np.array([1.0, -1.0]) / np.sqrt(2)
    reach_m = tangent_m + extension_m
    first_tip, last_tip = first_hook + reach_m * inward, last_hook + reach_m * inward
    max_tip_m = np.array([x_m, y_m]) - 2 * outer_radius_m - SELF_GAP_M
    # The negated comparison also rejects NaN.
    if not (first_tip[0] <= max_tip_m[0] and -last_tip[1] <= max_tip_m[1]):
        raise ValueError(
            f"a hoop of {2 * x_m + diameter_m:.4g} x {2 * y_m + diameter_m:.4g} m has no room for hooks of a "
            f"{diameter_m} m bar: their tips reach x = {first_tip[0]:.4g}, y = {last_tip[1]:.4g} m from its middle"
        )
    corners = [first_tip, first_hook, [-x_m, -y_m], [x_m, -y_m], [x_m, y_m], last_hook, last_tip]
    return np.column_stack([np.array(corners), np.zeros(len(corners))])


def _centroid_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " 3"]:
    """Return the centroid of a polyline, weighted by length."""
    lengths_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    return np.asarray(np.average((line_m[:-1] + line_m[1:]) / 2, axis=0, weights=lengths_m))
