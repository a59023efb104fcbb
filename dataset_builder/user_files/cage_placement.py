"""Placement of a cage in the world: which way is up, centring, rotation about the z axis, and translation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, bar_reach_m, with_ribs_chosen
from dataset_builder.scene.assemblies.cage import Cage, CageBar
from dataset_builder.scene.model import METRE_DECIMALS, Mesh, Note, axis_of
from dataset_builder.scene.shapes.solids import rotation_about_z
from dataset_builder.specs.file_specs import PlacementSpec

_Z_FROM_UP = {"z": np.eye(3), "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}
"""Rotation from the axes of a file to the axes of the world, by the file's vertical axis."""

_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_STEPS_PER_METRE = 1000
"""A cage is centred by whole millimetres."""

_SAME_SHAPE_DECIMALS = 6
"""Rounding of the coordinates by which bars of the same shape are recognised, metres: to the micrometre."""


def placed(cage: Cage, placement: PlacementSpec, where: str) -> Cage:
    """Return the cage of the file ``where`` in the world frame, with a note if centring moves it.

    The bars of ``cage`` are in the file's frame, in metres, and its ``world_from_source`` is the scale of the
    file's unit. A cage that is centred has its box in the middle above the world's origin, to whole millimetres,
    and its lowest point at z = 0 to 1 mm. Coordinates of 1e6 m keep a micrometre: the cage is moved near the
    origin before it is turned.
    """
    up = _Z_FROM_UP[placement.up]
    rotation = _about_z(placement.rotate_deg) @ up
    origin_m = _origin_m(cage.bars, up, rotation) if placement.origin == "centre" else np.zeros(3)
    motion = _Motion(rotation, origin_m, np.array(placement.translate_m))
    matrix = motion.matrix
    bars = cage.bars if (matrix == np.eye(4)).all() else tuple(map(motion.moved, cage.bars))
    notes: tuple[Note, ...] = ()
    if origin_m.any():
        x, y, z = (0.0 - up @ origin_m).tolist()
        text = (
            f"the steel is moved by x {x:.3f}, y {y:.3f}, z {z:.3f} m, to the middle and onto the ground, before "
            'rotate_deg and translate: cover below it is lost unless they restore it; origin = "keep" in a scene '
            "TOML file keeps the place that the file gives it"
        )
        notes = (Note(where, "moved", text),)
    return replace(cage, bars=bars, world_from_source=matrix @ cage.world_from_source, placement_notes=notes)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Rotation about ``origin_m``, which comes to ``target_m``; metres."""

    rotation: Float64[ndarray, "3 3"]
    origin_m: Float64[ndarray, " 3"]
    target_m: Float64[ndarray, " 3"]

    @property
    def matrix(self) -> Float64[ndarray, "4 4"]:
        """Return the motion as a matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation
        matrix[:3, 3] = self.target_m - self.rotation @ self.origin_m + 0.0  # Adding 0.0 turns -0.0 into 0.0.
        return matrix

    def points_m(self, points_m: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        """Return moved points."""
        return np.asarray((points_m - self.origin_m) @ self.rotation.T + self.target_m)

    def moved(self, bar: CageBar) -> CageBar:
        """Return a bar with its axis and mesh moved."""
        axis_m = bar.bar.axis_m
        if axis_m:
            axis_m = axis_of(np.round(self.points_m(np.array(axis_m)), METRE_DECIMALS) + 0.0)
        mesh = None if bar.mesh is None else Mesh(self.points_m(bar.mesh.vertices_m), bar.mesh.faces)
        return replace(bar, bar=replace(bar.bar, axis_m=axis_m), mesh=mesh)


def _about_z(angle_deg: float) -> Float64[ndarray, "3 3"]:
    """Return the rotation about the z axis; exact for multiples of 90 degrees."""
    quarter_turns, rest_deg = divmod(angle_deg, 90.0)
    return np.asarray(rotation_about_z(rest_deg) @ np.linalg.matrix_power(_QUARTER_TURN, int(quarter_turns) % 4))


def _origin_m(
    bars: Sequence[CageBar], up: Float64[ndarray, "3 3"], rotation: Float64[ndarray, "3 3"]
) -> Float64[ndarray, " 3"]:
    """Return the point of the file's frame, in metres, that comes to the world's origin when a cage is centred.

    The middle of the box is taken of the upright cage before it is turned; ``rotation`` includes ``up``.
    """
    corners_m = np.array([(bar.points_m.min(axis=0), bar.points_m.max(axis=0)) for bar in bars])
    near_m = np.round((corners_m.min(axis=(0, 1)) + corners_m.max(axis=(0, 1))) / 2)
    ribbed = with_ribs_chosen(bars)
    upright, turned = (_Motion(matrix, near_m, np.zeros(3)) for matrix in (up, rotation))
    sides_m = [(-_greatest_m(ribbed, upright, axis, -1), _greatest_m(ribbed, upright, axis)) for axis in (0, 1)]
    lowest_m = -_greatest_m(ribbed, turned, 2, -1)
    # Rounding to the nanometre keeps a cage in place that already stands on the ground.
    ground = np.floor(np.round(lowest_m * _STEPS_PER_METRE, 6))
    middle = [np.round((lower_m + upper_m) / 2 * _STEPS_PER_METRE) for lower_m, upper_m in sides_m]
    steps = np.array([*middle, ground])
    return np.asarray(near_m + up.T @ steps / _STEPS_PER_METRE)


def _greatest_m(bars: Sequence[CageBar], motion: _Motion, axis: int, sign: int = 1) -> float:
    """Return the greatest coordinate, times ``sign``, along an axis of the meshes of moved bars.

    Only meshes that may reach it are made: those of bars whose axes are near enough, one of each shape.
    """
    row = sign * motion.rotation[axis]
    bounds_m = [float(((bar.points_m - motion.origin_m) @ row).max()) + bar_reach_m(bar) for bar in bars]
    greatest_m = -np.inf
    seen: set[object] = set()
    for index in sorted(range(len(bars)), key=lambda number: -bounds_m[number]):
        if bounds_m[index] <= greatest_m:
            break
        key = (round(bounds_m[index], _SAME_SHAPE_DECIMALS), _shape_key(bars[index]))
        if key not in seen:
            seen.add(key)
            vertices_m = _vertices_m(motion.moved(bars[index]))
            greatest_m = max(greatest_m, float((sign * vertices_m[:, axis]).max()))
    return greatest_m


def _vertices_m(bar: CageBar) -> Float64[ndarray, "v 3"]:
    """Return the vertices of a bar's mesh, or the points of its axis if no mesh can be made of it."""
    try:
        return bar_mesh(bar).vertices_m
    except ValueError:  # ``cage_assembly`` refuses such a bar.
        return bar.points_m


def _shape_key(bar: CageBar) -> object:
    """Return a key that is equal for bars whose meshes differ by a translation only."""
    if bar.mesh is not None:
        return id(bar.mesh)
    shape_m = np.round(bar.points_m - bar.points_m[0], _SAME_SHAPE_DECIMALS) + 0.0
    return bar.bar.diameter_m, bar.ribs, shape_m.tobytes()
