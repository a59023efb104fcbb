"""Assemblies from the bars of a cage file: validation, choice of ribbed or plain bars, and meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.assemblies.mesh_import import MAX_EXTENT_M, MIN_EXTENT_M
from dataset_builder.scene.assemblies.surface_bar import axis_notes
from dataset_builder.scene.model import MAX_BARS, Assembly, Mesh
from dataset_builder.scene.shapes.bar_mesh import RibPattern, plain_bar_mesh, ribbed_bar_mesh
from rebar_depth_bench.errors import MeshError, Problem

MIN_DIAMETER_M, MAX_DIAMETER_M = 0.0005, 0.2
"""Bounds of a bar's diameter: thin binding wire, and far more than the thickest bar made.

Beyond them the unit is wrong.
"""

MAX_RIBS_PER_ROW = 400
"""Largest number of ribs in one row of a ribbed bar; a longer bar (272 diameters or more) gets a plain surface.

When such a bar is wholly in view, it is about two pixels wide and its ribs project by a tenth of a pixel.
"""

MAX_RIBS_PER_CAGE = 12_000
"""Largest number of ribs of a cage; with more, all its bars get plain surfaces.

One rib with the space to the next takes 416 triangles, so this number takes five million.
"""

MAX_TRIANGLES = 20_000_000
"""Largest estimated number of triangles of a cage."""

_PLAIN_BAR_SEGMENTS = 24
"""Segments round the circumference of a plain bar."""

_SAME_AXIS_M = 1e-6
"""Grid spacing to which axes are rounded for the comparison of bars, metres."""

_BEND_MARGIN_DIAMETERS = 1.0
"""Distance from a bend's end, in diameters, at which the cross-section is perpendicular to the axis again."""


def cage_assembly(bars: Sequence[CageBar], where: str) -> Assembly:
    """Return the assembly of a cage file's bars, in their order (world frame, metres).

    A bar is ribbed unless its ``ribs`` is false or it would have more than ``MAX_RIBS_PER_ROW`` ribs in a row.
    If the ribbed bars have more than ``MAX_RIBS_PER_CAGE`` ribs altogether, no bar is ribbed.

    Raises ``MeshError`` with all problems at once, each with file, bar, actual and expected value: no bar or too
    many, non-finite or implausible values, two bars with the same axis, too many triangles.
    """
    if not 1 <= len(bars) <= MAX_BARS:
        raise MeshError(f"{where}: {len(bars)} bars found, expected 1 to {MAX_BARS}")
    raise_problems([problem for bar in bars for problem in _bar_problems(bar)], where)
    raise_problems([*_extent_problems(bars), *_duplicate_axis_problems(bars)], where)
    final_bars = _decide_ribs(bars)
    triangles = sum(_estimated_triangles(bar) for bar in final_bars)
    if triangles > MAX_TRIANGLES:
        raise MeshError(f"{where}: the bars make {triangles} triangles, expected at most {MAX_TRIANGLES}")
    meshes, problems = [], []
    for bar in final_bars:
        try:
            meshes.append((bar.bar, _bar_mesh(bar)))
        except ValueError as error:
            problems.append(Problem("invalid", bar.label, str(error)))
    raise_problems(problems, where)
    without_axis = [bar.label for bar in bars if not bar.bar.has_axis]
    notes = tuple(dict.fromkeys(note for bar in bars for note in bar.notes))
    return Assembly.from_meshes(meshes, (*notes, *axis_notes(where, without_axis, len(bars))))


def raise_problems(problems: Sequence[Problem], where: str) -> None:
    """Raise ``MeshError`` with all ``problems`` of the file ``where``, if there are any."""
    if problems:
        raise MeshError.from_problems(where, problems)


def _bar_problems(bar: CageBar) -> list[Problem]:
    """Return what is wrong with one bar: its diameter, non-finite coordinates, or points too far away."""
    diameter_m = bar.bar.diameter_m
    problems = []
    if bar.bar.has_axis and not MIN_DIAMETER_M <= diameter_m <= MAX_DIAMETER_M:  # Also catches NaN.
        expected = f"{MIN_DIAMETER_M:g} to {MAX_DIAMETER_M:g} m: is the unit right?"
        problems.append(Problem("invalid", bar.label, f"the diameter is {diameter_m:.6g} m", expected))
    points_m = _points_m(bar)
    if not np.isfinite(points_m).all():
        problems.append(Problem("invalid", bar.label, "a coordinate is not finite", "finite numbers"))
    elif np.abs(points_m).max() > MAX_EXTENT_M:
        found = f"extends {np.abs(points_m).max():.6g} m from the world's origin"
        expected = f"at most {MAX_EXTENT_M:g} m: is the unit right, and is the cage at the origin?"
        problems.append(Problem("invalid", bar.label, found, expected))
    return problems


def _points_m(bar: CageBar) -> Float64[ndarray, "n 3"]:
    """Return the points of a bar's axis and mesh, as far as it has them."""
    axis_m = np.array(bar.bar.axis_m, dtype=np.float64).reshape(-1, 3)
    return axis_m if bar.mesh is None else np.concatenate([axis_m, bar.mesh.vertices_m])


def _extent_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return a problem if the largest side of the cage is implausible, else an empty list."""
    points_m = np.concatenate([_points_m(bar) for bar in bars])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if MIN_EXTENT_M < extent_m < MAX_EXTENT_M:
        return []
    expected = f"{MIN_EXTENT_M:g} to {MAX_EXTENT_M:g} m: is the unit right?"
    return [Problem("invalid", "", f"the cage is {extent_m:.6g} m long", expected)]


def _duplicate_axis_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return a problem for each bar whose axis equals an earlier one, in either direction, to the micrometre.

    The pixels of such bars would be ambiguous.
    """
    first_label: dict[object, str] = {}
    problems = []
    for bar in bars:
        if not bar.bar.has_axis:
            continue
        points = [
            tuple(point) for point in np.round(np.array(bar.bar.axis_m) / _SAME_AXIS_M).astype(np.int64).tolist()
        ]
        key = min(tuple(points), tuple(reversed(points)))
        if key in first_label:
            found = f"has the same axis as {first_label[key]}"
            problems.append(Problem("duplicate", bar.label, found, "distinct axes"))
        first_label.setdefault(key, bar.label)
    return problems


def _decide_ribs(bars: Sequence[CageBar]) -> list[CageBar]:
    """Return the bars with ``ribs`` set by the limits per row and per cage."""
    ribs = [_ribs_per_row(bar) if bar.ribs and bar.mesh is None else 0.0 for bar in bars]
    is_ribbed = [0 < count <= MAX_RIBS_PER_ROW for count in ribs]
    too_many = sum(count for count, ribbed in zip(ribs, is_ribbed, strict=True) if ribbed) > MAX_RIBS_PER_CAGE
    return [replace(bar, ribs=ribbed and not too_many) for bar, ribbed in zip(bars, is_ribbed, strict=True)]


def _ribs_per_row(bar: CageBar) -> float:
    """Return the number of ribs in one row along the bar."""
    length_m = np.linalg.norm(np.diff(np.array(bar.bar.axis_m), axis=0), axis=1).sum()
    return float(length_m / bar.bar.diameter_m / RibPattern.spacing)


def _estimated_triangles(bar: CageBar) -> int:
    """Return an upper estimate of the number of triangles of a bar's mesh."""
    if bar.mesh is not None:
        return len(bar.mesh.faces)
    if bar.ribs:  # A bar has two rows of ribs, with four mesh rings per rib.
        ring = 2 * (RibPattern.segments_per_row + 3)
        return int((8 * _ribs_per_row(bar) + 24) * 2 * ring)
    return (3 * len(bar.bar.axis_m) + 2) * 2 * _PLAIN_BAR_SEGMENTS


def _bar_mesh(bar: CageBar) -> Mesh:
    """Return the bar's own mesh, or one swept along its axis (world, metres)."""
    if bar.mesh is not None:
        return bar.mesh
    line_m = _with_points_near_bends(np.array(bar.bar.axis_m), bar.bar.diameter_m)
    if bar.ribs:
        return ribbed_bar_mesh(line_m, bar.bar.diameter_m)
    return plain_bar_mesh(line_m, bar.bar.diameter_m, _PLAIN_BAR_SEGMENTS)


def _with_points_near_bends(line_m: Float64[ndarray, "n 3"], diameter_m: float) -> Float64[ndarray, "k 3"]:
    """Return the line with extra points on its long legs, one diameter from each inner end.

    A mesh is swept with the mean direction at each point, interpolated in between. The extra points confine
    the rotation of the cross-section at a bend's end or a sharp corner to one diameter, so that the rest of
    the leg is straight.
    """
    pieces = [line_m[:1]]
    last = len(line_m) - 2
    for leg, (a, b) in enumerate(pairwise(line_m)):
        length_m = float(np.linalg.norm(b - a))
        if length_m > 4 * _BEND_MARGIN_DIAMETERS * diameter_m:
            step = (b - a) / length_m * _BEND_MARGIN_DIAMETERS * diameter_m
            pieces += [(a + step)[None]] if leg > 0 else []
            pieces += [(b - step)[None]] if leg < last else []
        pieces.append(b[None])
    return np.concatenate(pieces)
