"""From the bars of a cage file to an assembly: what is refused, which bars get ribs, and their meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.mesh_import import MAX_EXTENT_M, MIN_EXTENT_M
from dataset_builder.scene.model import MAX_BARS, STEEL, Assembly, Bar, Mesh, Part
from dataset_builder.scene.shapes.bar_mesh import RibPattern, plain_bar_mesh, ribbed_bar_mesh
from rebar_depth_bench.errors import MeshError, problem_summary

MIN_DIAMETER_M, MAX_DIAMETER_M = 0.0005, 0.2
"""From thin binding wire to far beyond the thickest bar made; outside, the unit is wrong."""

MAX_RIBS = 400
"""A bar with more ribs in a row (272 diameters and longer) is made plain: where the whole of it is in view, it is
some two pixels wide and its ribs stand out by a tenth of one."""

MAX_ALL_RIBS = 12_000
"""A cage with more ribs is made plain: a rib and its space take 416 triangles, so that these are five million."""

MAX_TRIANGLES = 20_000_000
_SEGMENTS = 24
_CLOSE_M = 1e-6
_SHOULDER = 1.0
"""Diameters from a bend's end at which the cross-section stands square to the axis again."""


@dataclass(frozen=True, eq=False)
class CageBar:
    """A bar of a cage file and what messages call it; ``mesh`` (world, metres) only where no axis is known."""

    label: str
    bar: Bar
    ribs: bool = True
    mesh: Mesh | None = None


def cage_assembly(bars: Sequence[CageBar], where: str) -> Assembly:
    """Return the assembly of a cage file's bars, in their order, world metres.

    A bar is ribbed unless it asks for none, has more than ``MAX_RIBS`` ribs in a row, or the ribbed bars of the
    cage come to more than ``MAX_ALL_RIBS``: then none of them is.

    Raises ``MeshError`` that names file, bar, what was found and what was expected, all problems at once: no bar
    or too many, what is not finite or of absurd size, two bars in one place, too many triangles.
    """
    if not 1 <= len(bars) <= MAX_BARS:
        raise MeshError(f"{where}: {len(bars)} bars found, expected 1 to {MAX_BARS}")
    refuse([problem for bar in bars for problem in _bar_problems(bar)], where)
    refuse([*_extent_problems(bars), *_twin_problems(bars)], where)
    chosen = _with_ribs_chosen(bars)
    triangles = sum(_triangles(bar) for bar in chosen)
    if triangles > MAX_TRIANGLES:
        raise MeshError(f"{where}: the bars make {triangles} triangles, expected at most {MAX_TRIANGLES}")
    meshes, problems = [], []
    for bar in chosen:
        try:
            meshes.append(_mesh(bar))
        except ValueError as error:
            problems.append(f"{bar.label}: {error}")
    refuse(problems, where)
    parts = (
        Part(f"{bar.bar.role}-{bar.bar.bar_id:03d}", mesh, bar.bar.bar_id, STEEL)
        for bar, mesh in zip(chosen, meshes, strict=True)
    )
    return Assembly(tuple(bar.bar for bar in chosen), tuple(parts))


def refuse(problems: Sequence[str], where: str) -> None:
    """Raise ``MeshError`` with all ``problems`` of the file ``where``, if there are any."""
    if problems:
        words = problems[0] if len(problems) == 1 else problem_summary(problems)
        raise MeshError(f"{where}: {words}")


def _bar_problems(bar: CageBar) -> list[str]:
    axis_m = np.array(bar.bar.axis_m)
    problems = []
    if not MIN_DIAMETER_M <= bar.bar.diameter_m <= MAX_DIAMETER_M:  # also what is not a number
        problems.append(
            f"{bar.label}: the diameter is {bar.bar.diameter_m:.6g} m, expected {MIN_DIAMETER_M:g} to "
            f"{MAX_DIAMETER_M:g} m: is the unit right?"
        )
    points_m = axis_m if bar.mesh is None else np.concatenate([axis_m, bar.mesh.vertices_m])
    if not np.isfinite(points_m).all():
        problems.append(f"{bar.label}: a coordinate is not finite, expected numbers")
    elif np.abs(points_m).max() > MAX_EXTENT_M:
        problems.append(
            f"{bar.label}: reaches {np.abs(points_m).max():.6g} m from the world's origin, expected at most "
            f"{MAX_EXTENT_M:g} m: is the unit right, and does the cage stand at the origin?"
        )
    return problems


def _extent_problems(bars: Sequence[CageBar]) -> list[str]:
    points_m = np.concatenate([np.array(bar.bar.axis_m) for bar in bars])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if MIN_EXTENT_M < extent_m < MAX_EXTENT_M:
        return []
    expected = f"{MIN_EXTENT_M:g} to {MAX_EXTENT_M:g} m"
    return [f"the cage is {extent_m:.6g} m long, expected {expected}: is the unit right?"]


def _twin_problems(bars: Sequence[CageBar]) -> list[str]:
    """Name bars whose axes are the same to the micrometre, in either direction: their pixels would be anyone's."""
    first: dict[object, str] = {}
    problems = []
    for bar in bars:
        points = [
            tuple(point) for point in np.round(np.array(bar.bar.axis_m) / _CLOSE_M).astype(np.int64).tolist()
        ]
        key = min(tuple(points), tuple(reversed(points)))
        if key in first:
            problems.append(f"{bar.label}: lies in the very place of {first[key]}, expected one bar there")
        first.setdefault(key, bar.label)
    return problems


def _with_ribs_chosen(bars: Sequence[CageBar]) -> list[CageBar]:
    ribs = [_ribs_in_a_row(bar) if bar.ribs and bar.mesh is None else 0.0 for bar in bars]
    wanted = [0 < count <= MAX_RIBS for count in ribs]
    too_many = sum(count for count, is_wanted in zip(ribs, wanted, strict=True) if is_wanted) > MAX_ALL_RIBS
    return [replace(bar, ribs=is_wanted and not too_many) for bar, is_wanted in zip(bars, wanted, strict=True)]


def _ribs_in_a_row(bar: CageBar) -> float:
    length_m = np.linalg.norm(np.diff(np.array(bar.bar.axis_m), axis=0), axis=1).sum()
    return float(length_m / bar.bar.diameter_m / RibPattern.spacing)


def _triangles(bar: CageBar) -> int:
    """Return about how many triangles a bar will have, from above."""
    if bar.mesh is not None:
        return len(bar.mesh.faces)
    if bar.ribs:  # two rows of ribs, four rings a rib
        ring = 2 * (RibPattern.segments_per_row + 3)
        return int((8 * _ribs_in_a_row(bar) + 24) * 2 * ring)
    return (3 * len(bar.bar.axis_m) + 2) * 2 * _SEGMENTS


def _mesh(bar: CageBar) -> Mesh:
    if bar.mesh is not None:
        return bar.mesh
    line_m = _with_shoulders(np.array(bar.bar.axis_m), bar.bar.diameter_m)
    if bar.ribs:
        return ribbed_bar_mesh(line_m, bar.bar.diameter_m)
    return plain_bar_mesh(line_m, bar.bar.diameter_m, _SEGMENTS)


def _with_shoulders(line_m: Float64[ndarray, "n 3"], diameter_m: float) -> Float64[ndarray, "k 3"]:
    """Return the line with a point more on its long legs, a diameter from either inner end.

    A mesh is swept with the mean direction at each point, and turns evenly in between: so the turn at a bend's
    end, or at a sharp corner, is done with in a diameter and the straight leg is straight.
    """
    pieces = [line_m[:1]]
    last = len(line_m) - 2
    for leg, (a, b) in enumerate(pairwise(line_m)):
        length_m = float(np.linalg.norm(b - a))
        if length_m > 4 * _SHOULDER * diameter_m:
            step = (b - a) / length_m * _SHOULDER * diameter_m
            pieces += [(a + step)[None]] if leg > 0 else []
            pieces += [(b - step)[None]] if leg < last else []
        pieces.append(b[None])
    return np.concatenate(pieces)
