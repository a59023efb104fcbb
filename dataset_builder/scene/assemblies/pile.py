"""Pile assembly: overlapping-hook stirrups in the poses in which they came to rest on the board.

A stirrup is a closed hoop whose two ends both bend round one corner. In the stirrup's own frame (metres) its
plane is approximately z = 0, the long side runs along x, the hooks are in the corner at -x, +y, and the
centroid of the centreline is the origin.

The poses are stored with the package, because a simulation gives different last digits on another machine.
``scripts/simulate_pile.py`` of the repository computed them and can compute them again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Assembly, Mesh, axis_of
from dataset_builder.scene.shapes.bar_mesh import RibPattern, outer_radius_m, ribbed_bar_mesh
from dataset_builder.scene.shapes.links import stirrup_centreline_m
from dataset_builder.specs.config_specs import PileSpec
from rebar_depth_bench.data.bars import Bar

STATES_DIR = Path(__file__).with_name("settled")
"""Directory of stored states, ``<name>.json``; a stored state never changes, a new pile gets a new name."""

RIBS = RibPattern(segments_per_row=8)
"""The default rib pattern with two mesh segments fewer per row: 57 thousand triangles per stirrup."""

ROLE = "stirrup"


@dataclass(frozen=True)
class Pose:
    """Pose of a stirrup: its centroid (world, metres) and its rotation as a unit quaternion (w, x, y, z)."""

    position_m: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float]


def pile_assembly(spec: PileSpec) -> Assembly:
    """Return the stirrups of ``spec`` in their stored poses (world, metres), numbered from 1 in drop order."""
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

    Meshes and the simulation both use it.
    """
    return stirrup_centreline_m(spec.size_m, spec.diameter_m, outer_radius_m(spec.diameter_m, RIBS))


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
    """Return the poses stored as ``spec.state``, those of the stirrups of ``spec``."""
    content = json.loads((STATES_DIR / f"{spec.state}.json").read_text(encoding="utf-8"))
    return tuple(
        Pose(tuple(stored["position_m"]), tuple(stored["quaternion_wxyz"])) for stored in content["stirrups"]
    )
