"""The pile: overlapping-hook stirrups as they came to rest in a heap on the board.

The poses are stored with the package, because a simulation gives other last digits on another machine;
``dataset_builder.assemblies.settling`` made them and makes them again.
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

from dataset_builder.assemblies.stirrup import stirrup_centreline_m
from dataset_builder.model import STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.shapes.bar_mesh import RibPattern, outer_radius_m, ribbed_bar_mesh
from dataset_builder.specs import PileSpec
from rebar_depth_bench.errors import MeshError

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
