"""Pile simulation: drops stirrups with MuJoCo and stores the poses in which they come to rest.

Usage: ``python -m dataset_builder.scene.assemblies.pile_simulation --seed S --out FILE``

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

from dataset_builder.config.specs import PileSpec
from dataset_builder.scene.assemblies.pile import RIBS, Pose, points_in_world_m, spec_centreline_m
from dataset_builder.scene.assemblies.pile_checks import (
    DropSpec,
    centre_pile,
    drop_poses,
    free_markers,
    height_m,
    reach_m,
    tilts_deg,
)
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.console import run_command
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.aruco_board import BoardSpec


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


def _seed_argument(text: str) -> int:
    """Return a seed from the command line; raise ``ArgumentTypeError`` unless it is a whole number from 0 on."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is not a valid seed, expected a whole number of 0 or more")
    return int(text)


def main() -> int:
    """Find an acceptable pile, write it and return the exit code (``run_command``)."""
    parser = argparse.ArgumentParser(
        prog="python -m dataset_builder.scene.assemblies.pile_simulation", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--seed", type=_seed_argument, default=0, help="first seed to try")
    parser.add_argument("--out", type=Path, required=True, help="output file of the settled state (JSON)")
    arguments = parser.parse_args()

    def settle_and_write() -> None:
        seed, settled_pile = first_good_seed(PILE, arguments.seed)
        write_text(arguments.out, json.dumps(pile_state(PILE, seed, settled_pile), indent=1) + "\n")

    return run_command(settle_and_write)


if __name__ == "__main__":
    sys.exit(main())
