"""The pile: overlapping-hook stirrups as they came to rest in a heap on the board.

The poses are stored with the package, because a simulation gives other last digits on another machine;
``dataset_builder.scene.assemblies.pile_simulation`` made them and makes them again.

The centreline of an overlapping-hook stirrup: a closed hoop whose two ends both turn round one corner.

Frame: the stirrup's own, metres; its plane is about z = 0, the long side runs along x, the hooks stand in the
corner at -x, +y, and the centreline's centroid is the origin.
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
from dataset_builder.scene.model import STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import RibPattern, outer_radius_m, ribbed_bar_mesh
from dataset_builder.scene.shapes.bending import bend_radius_m, bent_line_m
from rebar_depth_bench.errors import MeshError

HOOK_DEG = 135.0
"""How far each end turns round its corner, into the core: the seismic hook of ACI 318-19, section 25.3.4 (read in
a secondary source)."""

SELF_GAP_M = 3e-4
"""Between the two ends where they pass each other at the hooks' corner."""

BEND_STEP_DEG = 5.0
"""A bend's points are this far apart at most: chords of a 25 mm radius then lie within 0.024 mm of its arc."""


def hook_extension_m(diameter_m: float) -> float:
    """Return the straight length beyond a seismic hook's bend: max(6 d, 75 mm), metres.

    The usual rule for seismic hooks, as in ISO and ACI standards [unverified: none of them was at hand].
    """
    return max(6 * diameter_m, 0.075)


def stirrup_centreline_m(
    size_m: tuple[float, float], diameter_m: float, outer_radius_m: float
) -> Float64[ndarray, "n 3"]:
    """Return the centreline of a stirrup of outside ``size_m`` (along x, along y; nominal diameter), metres.

    Bends go round the least mandrel of EN 1992-1-1. The line climbs along z evenly from tip to tip, like one turn
    of a coil, so that its ends pass each other with ``SELF_GAP_M`` between surfaces ``outer_radius_m`` off the
    axis. Raises ``ValueError`` where the bar has no thickness or the hoop is too small for its own hooks.
    """
    if not 0 < diameter_m <= 2 * outer_radius_m:
        raise ValueError(f"a bar of {diameter_m} m cannot have an outer radius of {outer_radius_m} m")
    half_m = (np.array(size_m) - diameter_m) / 2
    radius_m = bend_radius_m(diameter_m)
    flat_m = bent_line_m(_corners_m(half_m, diameter_m, outer_radius_m), radius_m, BEND_STEP_DEG)
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(flat_m, axis=0), axis=1))])
    # Where the ends pass each other, one turn of the hoop lies between them.
    turn_m = 4 * half_m.sum() - (8 - 2 * np.pi) * radius_m
    flat_m[:, 2] = along_m * _passing_offset_m(outer_radius_m, turn_m) / turn_m
    return np.asarray(flat_m - _centroid_m(flat_m))


def _passing_offset_m(outer_radius_m: float, turn_m: float) -> float:
    """Return the climb of one turn: a shade over the clear distance, as lines on a slope are closer than that."""
    clear_m = 2 * outer_radius_m + SELF_GAP_M
    return float(clear_m / np.sqrt(1 - (clear_m / turn_m) ** 2))


def _corners_m(
    half_m: Float64[ndarray, " 2"], diameter_m: float, outer_radius_m: float
) -> Float64[ndarray, "7 3"]:
    """Return the path's tips and corners on the plane: tip, hook, three corners of the hoop, hook, tip."""
    x_m, y_m = (float(half) for half in half_m)
    radius_m = bend_radius_m(diameter_m)
    turn = np.deg2rad(HOOK_DEG)
    taken_m = radius_m * np.tan(turn / 2)
    # Both ends bend round the middle (radius - x, y - radius), towards the opposite corner.
    first_hook = np.array([-x_m, y_m - radius_m + taken_m])
    last_hook = np.array([radius_m - x_m - taken_m, y_m])
    inward = np.array([1.0, -1.0]) / np.sqrt(2)
    reach_m = taken_m + hook_extension_m(diameter_m)
    first_tip, last_tip = first_hook + reach_m * inward, last_hook + reach_m * inward
    room = np.array([x_m, y_m]) - 2 * outer_radius_m - SELF_GAP_M
    # Written so that a NaN fails as well.
    if not (first_tip[0] <= room[0] and -last_tip[1] <= room[1]):
        raise ValueError(
            f"a hoop of {2 * x_m + diameter_m:.4g} x {2 * y_m + diameter_m:.4g} m has no room for hooks of a "
            f"{diameter_m} m bar: their tips reach x = {first_tip[0]:.4g}, y = {last_tip[1]:.4g} m from its middle"
        )
    corners = [first_tip, first_hook, [-x_m, -y_m], [x_m, -y_m], [x_m, y_m], last_hook, last_tip]
    return np.column_stack([np.array(corners), np.zeros(len(corners))])


def _centroid_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " 3"]:
    """Return the middle of a line's length."""
    lengths_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    return np.asarray(np.average((line_m[:-1] + line_m[1:]) / 2, axis=0, weights=lengths_m))


STATES = Path(__file__).with_name("settled")
"""Stored states, ``<name>.json``; what stands under a name never changes, a new heap gets a new name."""

RIBS = RibPattern(segments_per_row=8)
"""The usual ribs with two mesh segments less per row: 57 thousand triangles a stirrup."""

ROLE = "stirrup"
UNIT_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Pose:
    """Where a stirrup lies: its centroid in the world, metres, and its turn, a unit quaternion w x y z."""

    position_m: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


def pile_assembly(spec: PileSpec) -> Assembly:
    """Return the stirrups of ``spec`` in their stored poses, numbered from 1 as they fell; world, metres.

    Raises ``MeshError`` where the state is unknown or not whole, or belongs to other stirrups.
    """
    line_m = stirrup_line_m(spec)
    local = ribbed_bar_mesh(line_m, spec.diameter_m, RIBS)
    bars, parts = [], []
    for bar_id, pose in enumerate(settled_poses(spec), start=1):
        axis_m = tuple((float(x), float(y), float(z)) for x, y, z in placed_m(line_m, pose))
        bars.append(Bar(bar_id, ROLE, spec.diameter_m, axis_m))
        mesh = Mesh(placed_m(local.vertices_m, pose), local.faces)
        parts.append(Part(f"{ROLE}-{bar_id:03d}", mesh, bar_id, STEEL))
    return Assembly(tuple(bars), tuple(parts))


def stirrup_line_m(spec: PileSpec) -> Float64[ndarray, "n 3"]:
    """Return the centreline that meshes and physics share, in the stirrup's own frame, metres.

    Raises ``MeshError`` for a stirrup that cannot be bent.
    """
    try:
        return stirrup_centreline_m(spec.size_m, spec.diameter_m, outer_radius_m(spec.diameter_m, RIBS))
    except ValueError as error:
        raise MeshError(f"no stirrup can be made of {spec}: {error}") from None


def placed_m(points_m: Float64[ndarray, "n 3"], pose: Pose) -> Float64[ndarray, "n 3"]:
    """Return points of a stirrup's own frame in the world, metres."""
    w, x, y, z = pose.quaternion_wxyz
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.asarray(points_m @ rotation.T + np.array(pose.position_m))


def settled_poses(spec: PileSpec) -> tuple[Pose, ...]:
    """Return the poses stored as ``spec.state``; raise ``MeshError`` where they are missing or not of ``spec``."""
    path = STATES / f"{spec.state}.json"
    known = sorted(stored.stem for stored in STATES.glob("*.json"))
    if spec.state not in known:
        raise MeshError(f"no settled state {spec.state!r}, expected one of {', '.join(known)}")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        _check_same_stirrups(spec, content["pile"])
        poses = tuple(_pose(number, stored) for number, stored in enumerate(content["stirrups"], start=1))
        if len(poses) != spec.stirrups:
            raise ValueError(f"{len(poses)} poses, expected {spec.stirrups}")
    except (ValueError, KeyError, TypeError) as error:
        raise MeshError(f"settled state {spec.state!r} ({path.name}) cannot be read: {error!r}") from None
    return poses


def _check_same_stirrups(spec: PileSpec, stored: Mapping[str, Any]) -> None:
    """Poses hold for the stirrups that were dropped: others would float or run into each other."""
    asked = {"stirrups": spec.stirrups, "diameter_m": spec.diameter_m, "size_m": list(spec.size_m)}
    differing = [f"{name} {asked[name]}, stored {stored[name]}" for name in asked if stored[name] != asked[name]]
    if differing:
        raise MeshError(
            f"settled state {spec.state!r} is of other stirrups than asked for: {'; '.join(differing)}"
        )


def _pose(number: int, stored: Mapping[str, Any]) -> Pose:
    x, y, z = (float(value) for value in stored["position_m"])
    quaternion = tuple(float(value) for value in stored["quaternion_wxyz"])
    # Written so that a NaN fails as well.
    if len(quaternion) != 4 or not abs(float(np.linalg.norm(quaternion)) - 1) < UNIT_TOLERANCE:
        raise ValueError(f"stirrup {number} has the quaternion {quaternion}, expected four numbers of norm 1")
    if not np.isfinite([x, y, z]).all():
        raise ValueError(f"stirrup {number} lies at {(x, y, z)}, expected finite metres")
    return Pose((x, y, z), quaternion)
