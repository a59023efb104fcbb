"""Pile simulation: drops stirrups with MuJoCo and stores the poses in which they come to rest.

Usage: ``python -m scripts.simulate_pile --seed S --out FILE``

Seeds are tried in order from ``S`` on; the first pile without problems (``find_problems``) is written. A stirrup
is a rigid chain of capsules along the centreline of its mesh, with the outer radius of the ribs. Contacts keep
a small clearance (``PhysicsSpec.air_m``), so that meshes do not touch. World frame, metres; the board is the
plane z = 0.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.pile import RIBS, Pose, points_in_world_m, spec_centreline_m
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from dataset_builder.scene.shapes.bending import resample_polyline_m
from dataset_builder.specs.config_specs import PileSpec
from rebar_depth_bench.base.errors import BuildError
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.geometry.aruco_board import MARKER_MODULES, BoardSpec, marker_corners_m

_COVERAGE_STEP_M = 0.002
"""Spacing at which centrelines are sampled to find the markers they cover, metres."""


@dataclass(frozen=True)
class DropSpec:
    """Distribution of the initial poses: stirrups above each other, their hoop centres near the z axis.

    The lowest starts at the height ``first_m``, each further one ``spacing_m`` above the one before. Each has a
    random face down, a yaw of up to ``yaw_deg`` in either direction, plus 180 degrees at random, a tilt of up to
    ``tilt_deg`` in any direction, and an offset of up to ``offset_m`` along x and y. At the default spacing
    stirrups do not touch at the start, whatever their tilt.
    """

    spacing_m: float = 0.085
    first_m: float = 0.050
    yaw_deg: float = 35.0
    tilt_deg: float = 10.0
    offset_m: float = 0.010


@dataclass(frozen=True)
class PhysicsSpec:
    """Contact parameters of steel on steel and paper, and the criterion for rest.

    ``air_m`` is the clearance kept round each stirrup; MuJoCo adds the two of a contact. The stirrups are at rest
    when all speeds (m/s and rad/s) have stayed below ``rest_speed`` for ``rest_for_s``; the simulation ends after
    ``limit_s`` in any case. A hundred ``noslip_iterations`` stop the creep of soft friction: with 20 a pile kept
    creeping by micrometres per second.
    """

    timestep_s: float = 0.001
    contact_time_s: float = 0.002
    impedance: tuple[float, float, float] = (0.95, 0.99, 0.0005)
    air_m: float = 2.5e-5
    friction: float = 0.6
    density_kg_m3: float = 7850.0
    friction_impedance_ratio: float = 10.0
    noslip_iterations: int = 100
    rest_speed: float = 1e-5
    rest_for_s: float = 0.2
    limit_s: float = 5.0


@dataclass(frozen=True)
class PileRequirements:
    """Acceptance limits of a pile.

    Upper limits: ``overlap_m`` (overlap of two surfaces) and ``reach_m`` (extent from the origin along x or y).
    Lower limits: ``free_markers`` (number of uncovered markers), ``height_m`` and ``tilt_deg`` (of the most tilted
    stirrup).
    """

    overlap_m: float = 1e-4
    reach_m: float = 0.170
    free_markers: int = 4
    height_m: float = 0.030
    tilt_deg: float = 9.0


@dataclass(frozen=True)
class SettledPile:
    """State of a pile after ``seconds`` of simulated time: pose, speed (m/s) and spin (rad/s) of each stirrup.

    ``gap_m`` is the smallest distance of two surfaces (negative for an overlap), ``deepest_m`` the deepest
    overlap during the simulation.
    """

    poses: tuple[Pose, ...]
    speeds: tuple[float, ...]
    spins: tuple[float, ...]
    gap_m: float
    deepest_m: float
    seconds: float


PILE, DROP, PHYSICS, REQUIREMENTS, BOARD = PileSpec(), DropSpec(), PhysicsSpec(), PileRequirements(), BoardSpec()


def drop_pile(pile: PileSpec, seed: int) -> SettledPile:
    """Drop the stirrups of ``pile`` with the random ``seed`` and return the pile, at rest or at the time limit.

    The pile is shifted as a whole to the middle of the board; its plane is unbounded, so contacts stay the same.
    """
    line_m = spec_centreline_m(pile)
    starts = drop_poses(DROP, line_m, pile.stirrups, np.random.default_rng(seed))
    settled_pile = simulate_drop(pile, starts, PHYSICS)
    return replace(settled_pile, poses=centre_pile(settled_pile.poses, line_m))


def simulate_drop(pile: PileSpec, starts: Sequence[Pose], physics: PhysicsSpec) -> SettledPile:
    """Simulate stirrups released at ``starts`` until all are at rest or the time limit is reached."""
    model = mujoco.MjModel.from_xml_string(_model_xml(pile, physics))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([[*pose.position_m, *pose.quaternion_wxyz] for pose in starts])
    calm_steps, deepest_m = 0, 0.0
    while calm_steps * physics.timestep_s < physics.rest_for_s and data.time < physics.limit_s:
        mujoco.mj_step(model, data)
        calm_steps = calm_steps + 1 if np.abs(data.qvel).max() < physics.rest_speed else 0
        deepest_m = max(deepest_m, -_min_gap_m(data))
    mujoco.mj_forward(model, data)
    return _settled_pile(data, deepest_m)


def find_problems(settled_pile: SettledPile, pile: PileSpec) -> list[str]:
    """Return a message for each limit of ``REQUIREMENTS`` that a pile violates.

    Checked are motion, overlap, reach, number of free markers, height and tilt.
    """
    line_m, radius_m = spec_centreline_m(pile), outer_radius_m(pile.diameter_m, RIBS)
    lines_m = [points_in_world_m(line_m, pose) for pose in settled_pile.poses]
    free = free_markers(lines_m, radius_m, BOARD)
    fastest, tilt_deg = max(*settled_pile.speeds, *settled_pile.spins), max(tilts_deg(settled_pile.poses))
    checks = {
        f"still moves at {fastest:.1e}": fastest < PHYSICS.rest_speed,
        f"overlaps by {-settled_pile.gap_m:.1e} m": settled_pile.gap_m > -REQUIREMENTS.overlap_m,
        # With an overlap deeper than its radius, a bar may have passed through another one.
        f"overlapped by {settled_pile.deepest_m:.1e} m on the way": settled_pile.deepest_m < radius_m,
        f"reaches {reach_m(lines_m, radius_m):.3f} m": reach_m(lines_m, radius_m) <= REQUIREMENTS.reach_m,
        f"leaves only the markers {free} free": len(free) >= REQUIREMENTS.free_markers,
        f"is {height_m(lines_m, radius_m):.3f} m high": height_m(lines_m, radius_m) >= REQUIREMENTS.height_m,
        f"tilts by {tilt_deg:.1f} degrees at most": tilt_deg >= REQUIREMENTS.tilt_deg,
    }
    return [problem for problem, fulfilled in checks.items() if not fulfilled]


def first_good_seed(pile: PileSpec, first_seed: int, tries: int = 500) -> tuple[int, SettledPile]:
    """Return the first seed from ``first_seed`` on that gives an acceptable pile, and the pile.

    The result for each seed is printed to stderr. Raises ``BuildError`` after ``tries`` seeds without success.
    """
    for seed in range(first_seed, first_seed + tries):
        settled_pile = drop_pile(pile, seed)
        problems = find_problems(settled_pile, pile)
        print(f"seed {seed}: {'; '.join(problems) or 'good'}", file=sys.stderr, flush=True)
        if not problems:
            return seed, settled_pile
    raise BuildError(f"none of the seeds {first_seed} to {first_seed + tries - 1} gives a valid pile of {pile}")


def pile_state(pile: PileSpec, seed: int, settled_pile: SettledPile) -> dict[str, Any]:
    """Return the JSON content of a stored pile: all parameters, and each stirrup's pose at full precision."""
    return {
        "mujoco": mujoco.__version__,
        "machine": platform.machine(),
        "seed": seed,
        "pile": asdict(pile),
        "drop": asdict(DROP),
        "physics": asdict(PHYSICS),
        "wishes": asdict(REQUIREMENTS),
        "seconds": settled_pile.seconds,
        "least_gap_m": settled_pile.gap_m,
        "largest_overlap_m": max(0.0, -settled_pile.gap_m),
        "deepest_overlap_on_the_way_m": settled_pile.deepest_m,
        "stirrups": [
            asdict(pose) | {"speed_m_s": speed, "spin_rad_s": spin}
            for pose, speed, spin in zip(settled_pile.poses, settled_pile.speeds, settled_pile.spins, strict=True)
        ],
    }


def _settled_pile(data: mujoco.MjData, deepest_m: float) -> SettledPile:
    """Return the pile in MuJoCo's current state."""
    velocities = data.qvel.reshape(-1, 6)
    return SettledPile(
        poses=tuple(
            Pose((x, y, z), (qw, qx, qy, qz)) for x, y, z, qw, qx, qy, qz in data.qpos.reshape(-1, 7).tolist()
        ),
        speeds=tuple(np.linalg.norm(velocities[:, :3], axis=1).tolist()),
        spins=tuple(np.linalg.norm(velocities[:, 3:], axis=1).tolist()),
        gap_m=_min_gap_m(data),
        deepest_m=deepest_m,
        seconds=round(float(data.time), 6),
    )


def _min_gap_m(data: mujoco.MjData) -> float:
    """Return the smallest signed distance of the current contacts, metres, or infinity without contacts."""
    return float(data.contact.dist.min()) if data.ncon else float("inf")


def _model_xml(pile: PileSpec, physics: PhysicsSpec) -> str:
    """Return the MuJoCo model (MJCF XML) of the board and the stirrups."""
    p = physics
    option = (
        f'timestep="{p.timestep_s}" cone="elliptic" impratio="{p.friction_impedance_ratio}" '
        f'integrator="implicitfast" noslip_iterations="{p.noslip_iterations}" '
        'tolerance="1e-12" noslip_tolerance="1e-12"'
    )
    contact = (
        f'friction="{p.friction} 0.005 0.0001" margin="{p.air_m}" solref="{p.contact_time_s} 1" '
        f'solimp="{_format_numbers(p.impedance)}"'
    )
    body = f"<body><freejoint/>{_chain_xml(pile, physics)}</body>"
    return (
        f"<mujoco><option {option}/><default><geom {contact}/></default>"
        f'<worldbody><geom type="plane" size="0 0 1"/>{body * pile.stirrups}</worldbody></mujoco>'
    )


def _chain_xml(pile: PileSpec, physics: PhysicsSpec) -> str:
    """Return the MJCF of a stirrup: its capsules, and the mass and inertia of the nominal bar about its centroid.

    Mass and inertia are explicit because capsules overlap at their joints, which would count steel twice.
    """
    line_m = spec_centreline_m(pile)
    radius_m = outer_radius_m(pile.diameter_m, RIBS)
    capsules = "".join(
        f'<geom type="capsule" size="{radius_m!r}" fromto="{_format_numbers([*start, *end])}"/>'
        for start, end in pairwise(line_m)
    )
    lengths_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    mass_kg = float(lengths_m.sum()) * np.pi / 4 * pile.diameter_m**2 * physics.density_kg_m3
    t = _thin_line_inertia_m2(line_m, lengths_m) * mass_kg
    full = _format_numbers([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]])
    return f'<inertial pos="0 0 0" mass="{mass_kg!r}" fullinertia="{full}"/>{capsules}'


def _thin_line_inertia_m2(
    line_m: Float64[ndarray, "n 3"], lengths_m: Float64[ndarray, " k"]
) -> Float64[ndarray, "3 3"]:
    """Return the inertia per mass of a polyline about the origin, m^2: the exact integral of (r^T r E - r r^T)."""
    middles, steps = (line_m[:-1] + line_m[1:]) / 2, np.diff(line_m, axis=0)
    weights = lengths_m / lengths_m.sum()
    second_moment = (
        np.einsum("n,ni,nj->ij", weights, middles, middles) + np.einsum("n,ni,nj->ij", weights, steps, steps) / 12
    )
    return np.asarray(np.trace(second_moment) * np.eye(3) - second_moment)


def _format_numbers(values: Sequence[float] | Float64[ndarray, " n"]) -> str:
    """Return the values at full precision, separated by spaces."""
    return " ".join(repr(float(value)) for value in values)


def drop_poses(
    drop: DropSpec, line_m: Float64[ndarray, "n 3"], stirrups: int, random: np.random.Generator
) -> list[Pose]:
    """Return random initial poses of ``stirrups`` stirrups of centreline ``line_m``, the lowest first."""
    hoop_middle_m = _hoop_middle_m(line_m)
    poses = []
    for level in range(stirrups):
        quaternion = _random_rotation(drop, random)
        hoop_target_m = np.array(
            [*random.uniform(-drop.offset_m, drop.offset_m, 2), drop.first_m + drop.spacing_m * level]
        )
        rotated_middle_m = points_in_world_m(hoop_middle_m[None], Pose((0.0, 0.0, 0.0), quaternion))[0]
        x, y, z = (float(value) for value in hoop_target_m - rotated_middle_m)
        poses.append(Pose((x, y, z), quaternion))
    return poses


def centre_pile(poses: Sequence[Pose], line_m: Float64[ndarray, "n 3"]) -> tuple[Pose, ...]:
    """Return the poses shifted so that the bounding box of the pile is centred on x = y = 0."""
    points_m = np.concatenate([points_in_world_m(line_m, pose) for pose in poses])
    middle_x, middle_y, _ = ((points_m.min(axis=0) + points_m.max(axis=0)) / 2).tolist()
    return tuple(
        Pose(
            (pose.position_m[0] - middle_x, pose.position_m[1] - middle_y, pose.position_m[2]),
            pose.quaternion_wxyz,
        )
        for pose in poses
    )


def reach_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return the largest absolute x or y coordinate of the steel, metres."""
    return float(max(np.abs(line[:, :2]).max() for line in lines_m) + radius_m)


def height_m(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float) -> float:
    """Return the largest z coordinate of the steel, metres."""
    return float(max(line[:, 2].max() for line in lines_m) + radius_m)


def tilts_deg(poses: Sequence[Pose]) -> list[float]:
    """Return the angle between each hoop's plane and the horizontal, degrees."""
    z_axis = np.array([[0.0, 0.0, 1.0]])
    normals = [points_in_world_m(z_axis, Pose((0.0, 0.0, 0.0), pose.quaternion_wxyz))[0] for pose in poses]
    return [float(np.rad2deg(np.arccos(min(1.0, abs(normal[2]))))) for normal in normals]


def free_markers(lines_m: Sequence[Float64[ndarray, "n 3"]], radius_m: float, board: BoardSpec) -> tuple[int, ...]:
    """Return the ids of the markers that are clear of steel in plan, with a quiet zone of one module."""
    points_m = np.concatenate([resample_polyline_m(line, _COVERAGE_STEP_M)[:, :2] for line in lines_m])
    quiet_m = board.marker_side_m / MARKER_MODULES
    free = []
    for marker_id, corners_m in marker_corners_m(board).items():
        low_m, high_m = corners_m[:, :2].min(axis=0) - quiet_m, corners_m[:, :2].max(axis=0) + quiet_m
        outside_m = np.maximum(np.maximum(low_m - points_m, points_m - high_m), 0.0)
        if np.linalg.norm(outside_m, axis=1).min() > radius_m:
            free.append(marker_id)
    return tuple(free)


def _random_rotation(drop: DropSpec, random: np.random.Generator) -> tuple[float, float, float, float]:
    """Return a random rotation as a quaternion (w, x, y, z): the face that is down, then yaw, then tilt."""
    face = _axis_angle_quaternion((1.0, 0.0, 0.0), 180.0 * random.integers(2))
    yaw = _axis_angle_quaternion(
        (0.0, 0.0, 1.0), random.uniform(-drop.yaw_deg, drop.yaw_deg) + 180.0 * random.integers(2)
    )
    tilt_axis_rad = random.uniform(0.0, 2 * np.pi)
    tilt = _axis_angle_quaternion(
        (np.cos(tilt_axis_rad), np.sin(tilt_axis_rad), 0.0), random.uniform(0.0, drop.tilt_deg)
    )
    w, x, y, z = (float(value) for value in _quaternion_product(tilt, _quaternion_product(yaw, face)))
    return (w, x, y, z)


def _axis_angle_quaternion(axis: tuple[float, float, float], angle_deg: float) -> Float64[ndarray, " 4"]:
    """Return the quaternion (w, x, y, z) of a rotation about a unit ``axis``."""
    half = np.deg2rad(angle_deg) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


def _quaternion_product(last: Float64[ndarray, " 4"], first: Float64[ndarray, " 4"]) -> Float64[ndarray, " 4"]:
    """Return the quaternion (w, x, y, z) of the rotation ``first`` followed by ``last``."""
    scalar = last[0] * first[0] - last[1:] @ first[1:]
    vector = last[0] * first[1:] + first[0] * last[1:] + np.cross(last[1:], first[1:])
    return np.array([scalar, *vector])


def _hoop_middle_m(line_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, " 3"]:
    """Return the bounding-box centre of the hoop, which differs from the centroid because of the hooks."""
    middle: Float64[ndarray, " 3"] = (line_m.min(axis=0) + line_m.max(axis=0)) / 2
    return middle


def _seed_argument(text: str) -> int:
    """Return a seed from the command line; raise ``ArgumentTypeError`` unless it is a whole number from 0 on."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is not a valid seed, expected a whole number of 0 or more")
    return int(text)


def main() -> int:
    """Find an acceptable pile, write it and return the exit code (``run_command``)."""
    parser = argparse.ArgumentParser(prog="python -m scripts.simulate_pile", description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=_seed_argument, default=0, help="first seed to try")
    parser.add_argument("--out", type=Path, required=True, help="output file of the settled state (JSON)")
    arguments = parser.parse_args()

    def settle_and_write() -> None:
        seed, settled_pile = first_good_seed(PILE, arguments.seed)
        write_text(arguments.out, json.dumps(pile_state(PILE, seed, settled_pile), indent=1) + "\n")

    return run_command(settle_and_write)


if __name__ == "__main__":
    sys.exit(main())
