"""Lets stirrups fall in a heap, with MuJoCo, and stores where they come to rest.

python -m dataset_builder.scene.assemblies.pile_simulation --seed S --out FILE

Tries the seeds from ``S`` on, in order, and writes the first heap that ``faults`` finds nothing against. A
stirrup is a rigid chain of capsules along the centreline of its mesh, as thick as the ribs reach. Contacts keep
a hair's breadth of air, so that no two meshes meet. World frame, metres; the board is the plane z = 0.
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
from dataset_builder.scene.assemblies.pile import RIBS, Pose, placed_m, stirrup_line_m
from dataset_builder.scene.assemblies.pile_checks import (
    DropSpec,
    centred,
    drop_poses,
    free_markers,
    height_m,
    reach_m,
    tilts_deg,
)
from dataset_builder.scene.shapes.bar_mesh import outer_radius_m
from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.cli.console import run_command
from rebar_depth_bench.errors import BuildError
from rebar_depth_bench.geometry.aruco_board import BoardSpec


@dataclass(frozen=True)
class PhysicsSpec:
    """Steel on steel and paper, and when it counts as at rest.

    ``air_m`` is kept free round each stirrup; MuJoCo adds up the two of a contact. A hundred ``noslip_iterations``
    stop the creep of soft friction: with 20 a heap kept creeping by micrometres a second.
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
class HeapWishes:
    """What a heap must be like to be kept; ``tilt_deg`` is that of its most tilted stirrup at the least."""

    overlap_m: float = 1e-4
    reach_m: float = 0.170
    free_markers: int = 4
    height_m: float = 0.030
    tilt_deg: float = 9.0


@dataclass(frozen=True)
class Settled:
    """A heap after ``seconds``: poses, speeds (m/s) and spins (rad/s) by stirrup.

    ``gap_m`` is the least distance of two surfaces (below zero: an overlap), ``deepest_m`` the deepest overlap
    there was on the way down.
    """

    poses: tuple[Pose, ...]
    speeds: tuple[float, ...]
    spins: tuple[float, ...]
    gap_m: float
    deepest_m: float
    seconds: float


PILE, DROP, PHYSICS, WISHES, BOARD = PileSpec(), DropSpec(), PhysicsSpec(), HeapWishes(), BoardSpec()


def dropped(pile: PileSpec, seed: int) -> Settled:
    """Return the heap that the stirrups of ``pile`` make when thrown with ``seed``, at rest or out of time.

    It is moved to the middle of the board as a whole, which is the same everywhere.
    """
    line_m = stirrup_line_m(pile)
    starts = drop_poses(DROP, line_m, pile.stirrups, np.random.default_rng(seed))
    heap = settled(pile, starts, PHYSICS)
    return replace(heap, poses=centred(heap.poses, line_m))


def settled(pile: PileSpec, starts: Sequence[Pose], physics: PhysicsSpec) -> Settled:
    """Let stirrups go at ``starts`` and return where they are when all have been at rest, or time is up."""
    model = mujoco.MjModel.from_xml_string(_model_xml(pile, physics))
    data = mujoco.MjData(model)
    data.qpos[:] = np.concatenate([[*pose.position_m, *pose.quaternion_wxyz] for pose in starts])
    calm_steps, deepest_m = 0, 0.0
    while calm_steps * physics.timestep_s < physics.rest_for_s and data.time < physics.limit_s:
        mujoco.mj_step(model, data)
        calm_steps = calm_steps + 1 if np.abs(data.qvel).max() < physics.rest_speed else 0
        deepest_m = max(deepest_m, -_gap_m(data))
    mujoco.mj_forward(model, data)
    return _as_settled(data, deepest_m)


def faults(heap: Settled, pile: PileSpec, wishes: HeapWishes = WISHES) -> list[str]:
    """Return in words what speaks against a heap: motion, overlap, reach, markers, or that it is too neat."""
    line_m, radius_m = stirrup_line_m(pile), outer_radius_m(pile.diameter_m, RIBS)
    lines_m = [placed_m(line_m, pose) for pose in heap.poses]
    free = free_markers(lines_m, radius_m, BOARD)
    fastest, tilt_deg = max(*heap.speeds, *heap.spins), max(tilts_deg(heap.poses))
    checks = {
        f"still moves at {fastest:.1e}": fastest < PHYSICS.rest_speed,
        f"overlaps by {-heap.gap_m:.1e} m": heap.gap_m > -wishes.overlap_m,
        # Deeper than its radius, a bar may have come through another.
        f"overlapped by {heap.deepest_m:.1e} m on the way": heap.deepest_m < radius_m,
        f"reaches {reach_m(lines_m, radius_m):.3f} m": reach_m(lines_m, radius_m) <= wishes.reach_m,
        f"leaves only the markers {free} free": len(free) >= wishes.free_markers,
        f"is {height_m(lines_m, radius_m):.3f} m high": height_m(lines_m, radius_m) >= wishes.height_m,
        f"tilts by {tilt_deg:.1f} degrees at most": tilt_deg >= wishes.tilt_deg,
    }
    return [words for words, fulfilled in checks.items() if not fulfilled]


def first_good_seed(pile: PileSpec, first_seed: int, tries: int = 500) -> tuple[int, Settled]:
    """Try seeds in order and return the first that makes a good heap, with the heap.

    Raises ``BuildError`` where none of ``tries`` does.
    """
    for seed in range(first_seed, first_seed + tries):
        heap = dropped(pile, seed)
        found = faults(heap, pile)
        print(f"seed {seed}: {'; '.join(found) or 'good'}", file=sys.stderr, flush=True)
        if not found:
            return seed, heap
    raise BuildError(f"none of the seeds {first_seed} to {first_seed + tries - 1} makes a good heap of {pile}")


def state(pile: PileSpec, seed: int, heap: Settled) -> dict[str, Any]:
    """Return what is stored of a heap: how it was made, and each stirrup's pose to the last digit."""
    return {
        "mujoco": mujoco.__version__,
        "machine": platform.machine(),
        "seed": seed,
        "pile": asdict(pile),
        "drop": asdict(DROP),
        "physics": asdict(PHYSICS),
        "wishes": asdict(WISHES),
        "seconds": heap.seconds,
        "least_gap_m": heap.gap_m,
        "largest_overlap_m": max(0.0, -heap.gap_m),
        "deepest_overlap_on_the_way_m": heap.deepest_m,
        "stirrups": [
            asdict(pose) | {"speed_m_s": speed, "spin_rad_s": spin}
            for pose, speed, spin in zip(heap.poses, heap.speeds, heap.spins, strict=True)
        ],
    }


def _as_settled(data: mujoco.MjData, deepest_m: float) -> Settled:
    velocities = data.qvel.reshape(-1, 6)
    return Settled(
        poses=tuple(
            Pose((x, y, z), (qw, qx, qy, qz)) for x, y, z, qw, qx, qy, qz in data.qpos.reshape(-1, 7).tolist()
        ),
        speeds=tuple(np.linalg.norm(velocities[:, :3], axis=1).tolist()),
        spins=tuple(np.linalg.norm(velocities[:, 3:], axis=1).tolist()),
        gap_m=_gap_m(data),
        deepest_m=deepest_m,
        seconds=round(float(data.time), 6),
    )


def _gap_m(data: mujoco.MjData) -> float:
    """Return the least signed distance of two surfaces near each other, infinity where none are."""
    return float(data.contact.dist.min()) if data.ncon else float("inf")


def _model_xml(pile: PileSpec, physics: PhysicsSpec) -> str:
    """Return MuJoCo's description of the board and the stirrups, body by body."""
    p = physics
    option = (
        f'timestep="{p.timestep_s}" cone="elliptic" impratio="{p.friction_impedance_ratio}" '
        f'integrator="implicitfast" noslip_iterations="{p.noslip_iterations}" '
        'tolerance="1e-12" noslip_tolerance="1e-12"'
    )
    contact = (
        f'friction="{p.friction} 0.005 0.0001" margin="{p.air_m}" solref="{p.contact_time_s} 1" '
        f'solimp="{_numbers(p.impedance)}"'
    )
    body = f"<body><freejoint/>{_chain_xml(pile, physics)}</body>"
    return (
        f"<mujoco><option {option}/><default><geom {contact}/></default>"
        f'<worldbody><geom type="plane" size="0 0 1"/>{body * pile.stirrups}</worldbody></mujoco>'
    )


def _chain_xml(pile: PileSpec, physics: PhysicsSpec) -> str:
    """Return a stirrup's capsules, and its mass and inertia about its centroid: those of the nominal bar.

    Capsules overlap at their joints, so that their own masses would count steel twice.
    """
    line_m = stirrup_line_m(pile)
    radius_m = outer_radius_m(pile.diameter_m, RIBS)
    capsules = "".join(
        f'<geom type="capsule" size="{radius_m!r}" fromto="{_numbers([*start, *end])}"/>'
        for start, end in pairwise(line_m)
    )
    lengths_m = np.linalg.norm(np.diff(line_m, axis=0), axis=1)
    mass_kg = float(lengths_m.sum()) * np.pi / 4 * pile.diameter_m**2 * physics.density_kg_m3
    t = _thin_line_inertia_m2(line_m, lengths_m) * mass_kg
    full = _numbers([t[0, 0], t[1, 1], t[2, 2], t[0, 1], t[0, 2], t[1, 2]])
    return f'<inertial pos="0 0 0" mass="{mass_kg!r}" fullinertia="{full}"/>{capsules}'


def _thin_line_inertia_m2(
    line_m: Float64[ndarray, "n 3"], lengths_m: Float64[ndarray, " k"]
) -> Float64[ndarray, "3 3"]:
    """Return the inertia per mass of a bent line about the origin: sum of (r r E - r r^T), the legs exactly."""
    middles, steps = (line_m[:-1] + line_m[1:]) / 2, np.diff(line_m, axis=0)
    weights = lengths_m / lengths_m.sum()
    spread = (
        np.einsum("n,ni,nj->ij", weights, middles, middles) + np.einsum("n,ni,nj->ij", weights, steps, steps) / 12
    )
    return np.asarray(np.trace(spread) * np.eye(3) - spread)


def _numbers(values: Sequence[float] | Float64[ndarray, " n"]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _whole_from_0(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is no seed, expected a whole number from 0 on")
    return int(text)


def main() -> int:
    """Find a good heap and write it; the exit status is the contract's."""
    parser = argparse.ArgumentParser(
        prog="python -m dataset_builder.scene.assemblies.pile_simulation", description=__doc__.split("\n")[0]
    )
    parser.add_argument("--seed", type=_whole_from_0, default=0, help="the first seed to try")
    parser.add_argument("--out", type=Path, required=True, help="the state, a JSON file")
    arguments = parser.parse_args()

    def settle_and_write() -> None:
        seed, heap = first_good_seed(PILE, arguments.seed)
        write_text(arguments.out, json.dumps(state(PILE, seed, heap), indent=1) + "\n")

    return run_command(settle_and_write)


if __name__ == "__main__":
    sys.exit(main())
