"""Pile assembly: overlapping-hook stirrups in the poses in which they came to rest on the board.

A stirrup is a closed hoop whose two ends both bend round one corner. In the stirrup's own frame (metres) its
plane is approximately z = 0, the long side runs along x, the hooks are in the corner at -x, +y, and the
centroid of the centreline is the origin.

The poses are stored with the package, because a simulation gives different last digits on another machine.
``dataset_builder.scene.assemblies.pile_simulation`` computed them and can compute them again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.config.specs import PileSpec
from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import RibPattern, outer_radius_m, ribbed_bar_mesh
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m
from rebar_depth_bench.data.bars import Bar
from rebar_depth_bench.errors import MeshError

HOOK_DEG = 135.0
"""Bend angle of each end round its corner, into the core: the seismic hook of ACI 318-19, section 25.3.4 (from a
secondary source)."""

SELF_GAP_M = 3e-4
"""Clear distance of the two ends where they pass each other at the hooks' corner, metres."""

BEND_STEP_DEG = 5.0
"""Largest angle between sampled points of a bend: chords of a 25 mm radius lie within 0.024 mm of its arc."""


def hook_extension_m(diameter_m: float) -> float:
    """Return the straight length beyond a seismic hook's bend: max(6 d, 75 mm), metres.

    The usual rule for seismic hooks, as in ISO and ACI standards [unverified: not checked against the standards].
    """
    return max(6 * diameter_m, 0.075)


def stirrup_centreline_m(
    size_m: tuple[float, float], diameter_m: float, outer_radius_m: float
) -> Float64[ndarray, "n 3"]:
    """Return the centreline of a stirrup of outside ``size_m`` (along x, along y; nominal diameter), metres.

    Bends have the smallest mandrel of EN 1992-1-1. The line rises along z at a constant slope from tip to tip,
    like one turn of a coil, so that its ends pass each other with ``SELF_GAP_M`` between surfaces at
    ``outer_radius_m`` from the axis. Raises ``ValueError`` if the bar has no thickness or the hoop is too small
    for its own hooks.
    """
    if not 0 < diameter_m <= 2 * outer_radius_m:
        raise ValueError(f"a bar of {diameter_m} m cannot have an outer radius of {outer_radius_m} m")
    half_m = (np.array(size_m) - diameter_m) / 2
    radius_m = bend_radius_m(diameter_m)
    flat_m = bent_line_m(_corners_m(half_m, diameter_m, outer_radius_m), radius_m, BEND_STEP_DEG)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flat_m, axis=0), axis=1))])
    # The two ends are one turn of the hoop apart along the line where they pass each other.
    turn_m = 4 * half_m.sum() - (8 - 2 * np.pi) * radius_m
    flat_m[:, 2] = along_m * _climb_per_turn_m(outer_radius_m, turn_m) / turn_m
    return np.asarray(flat_m - _centroid_m(flat_m))


def _climb_per_turn_m(outer_radius_m: float, turn_m: float) -> float:
    """Return the rise along z of one turn, metres.

    It slightly exceeds the clear distance, because inclined lines are closer together than their vertical offset.
    """
    clear_m = 2 * outer_radius_m + SELF_GAP_M
    return float(clear_m / np.sqrt(1 - (clear_m / turn_m) ** 2))


def _corners_m(
    half_m: Float64[ndarray, " 2"], diameter_m: float, outer_radius_m: float
) -> Float64[ndarray, "7 3"]:
    """Return the tips and corners of the unbent path at z = 0: tip, hook, three hoop corners, hook, tip."""
    x_m, y_m = (float(half) for half in half_m)
    radius_m = bend_radius_m(diameter_m)
    turn = np.deg2rad(HOOK_DEG)
    tangent_m = radius_m * np.tan(turn / 2)
    # Both ends bend round the centre (radius - x, y - radius), towards the opposite corner.
    first_hook = np.array([-x_m, y_m - radius_m + tangent_m])
    last_hook = np.array([radius_m - x_m - tangent_m, y_m])
    inward = np.array([1.0, -1.0]) / np.sqrt(2)
    reach_m = tangent_m + hook_extension_m(diameter_m)
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


STATES_DIR = Path(__file__).with_name("settled")
"""Directory of stored states, ``<name>.json``; a stored state never changes, a new pile gets a new name."""

RIBS = RibPattern(segments_per_row=8)
"""The default rib pattern with two mesh segments fewer per row: 57 thousand triangles per stirrup."""

ROLE = "stirrup"
UNIT_TOLERANCE = 1e-9
"""Largest deviation of a stored quaternion's norm from 1."""


@dataclass(frozen=True)
class Pose:
    """Pose of a stirrup: its centroid (world, metres) and its rotation as a unit quaternion (w, x, y, z)."""

    position_m: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


def pile_assembly(spec: PileSpec) -> Assembly:
    """Return the stirrups of ``spec`` in their stored poses (world, metres), numbered from 1 in drop order.

    Raises ``MeshError`` if the state is unknown, incomplete or belongs to other stirrups.
    """
    line_m = spec_centreline_m(spec)
    local = ribbed_bar_mesh(line_m, spec.diameter_m, RIBS)
    return Assembly.from_meshes(
        (
            Bar(bar_id, ROLE, spec.diameter_m, axis_of(points_in_world_m(line_m, pose))),
            Mesh(points_in_world_m(local.vertices_m, pose), local.faces),
        )
        for bar_id, pose in enumerate(load_settled_poses(spec), start=1)
    )


def spec_centreline_m(spec: PileSpec) -> Float64[ndarray, "n 3"]:
    """Return the stirrup centreline of ``spec`` in the stirrup's own frame, metres.

    Meshes and the simulation both use it. Raises ``MeshError`` if the stirrup cannot be bent.
    """
    try:
        return stirrup_centreline_m(spec.size_m, spec.diameter_m, outer_radius_m(spec.diameter_m, RIBS))
    except ValueError as error:
        raise MeshError(f"no valid stirrup for {spec}: {error}") from None


def points_in_world_m(points_m: Float64[ndarray, "n 3"], pose: Pose) -> Float64[ndarray, "n 3"]:
    """Transform points from a stirrup's own frame to the world frame, metres."""
    w, x, y, z = pose.quaternion_wxyz
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray(points_m @ rotation.T + np.array(pose.position_m))


def load_settled_poses(spec: PileSpec) -> tuple[Pose, ...]:
    """Return the poses stored as ``spec.state``.

    Raises ``MeshError`` if the state is unknown, cannot be read or does not fit ``spec``.
    """
    path = STATES_DIR / f"{spec.state}.json"
    known = sorted(stored.stem for stored in STATES_DIR.glob("*.json"))
    if spec.state not in known:
        raise MeshError(f"no settled state {spec.state!r}, expected one of {', '.join(known)}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        _check_stored_stirrups(spec, content["pile"])
        poses = tuple(_parse_pose(number, stored) for number, stored in enumerate(content["stirrups"], start=1))
        if len(poses) != spec.stirrups:
            raise ValueError(f"{len(poses)} poses, expected {spec.stirrups}")
    except (ValueError, KeyError, TypeError) as error:
        raise MeshError(f"settled state {spec.state!r} ({path.name}) cannot be read: {error!r}") from None
    return poses


def _check_stored_stirrups(spec: PileSpec, stored: Mapping[str, Any]) -> None:
    """Raise ``MeshError`` unless a stored state belongs to the stirrups of ``spec``.

    Poses are valid only for the stirrups that were simulated; others would float or intersect.
    """
    requested = {"stirrups": spec.stirrups, "diameter_m": spec.diameter_m, "size_m": list(spec.size_m)}
    differing = [
        f"{name} {requested[name]}, stored {stored[name]}" for name in requested if stored[name] != requested[name]
    ]
    if differing:
        raise MeshError(
            f"settled state {spec.state!r} does not match the requested stirrups: {'; '.join(differing)}"
        )


def _parse_pose(number: int, stored: Mapping[str, Any]) -> Pose:
    """Return a pose from its JSON object; raise ``ValueError`` unless it is finite with a unit quaternion."""
    x, y, z = (float(value) for value in stored["position_m"])
    quaternion = tuple(float(value) for value in stored["quaternion_wxyz"])
    # The negated comparison also rejects NaN.
    if len(quaternion) != 4 or not abs(float(np.linalg.norm(quaternion)) - 1) < UNIT_TOLERANCE:
        raise ValueError(f"stirrup {number} has the quaternion {quaternion}, expected four numbers of norm 1")
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"stirrup {number} is at {(x, y, z)}, expected finite metres")
    return Pose((x, y, z), quaternion)
