"""Reasons for which a cage is refused: implausible values, extents, equal bars, too many triangles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataset_builder.scene.assemblies.bar_meshes import estimated_triangles, with_ribs_chosen
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import MAX_BARS
from rebar_depth_bench.errors import MeshError, Problem

MIN_DIAMETER_M, MAX_DIAMETER_M = 0.0005, 0.2
"""Bounds of a bar's diameter: thin binding wire, and far more than the thickest bar made.

Beyond them the unit is wrong.
"""

MIN_EXTENT_M = 0.001
MAX_EXTENT_M = 100.0
"""Exclusive bounds of the largest side of a cage, metres; beyond them its unit is wrong."""

MAX_TRIANGLES = 20_000_000
"""Largest estimated number of triangles of a cage."""

_SAME_AXIS_M = 1e-6
"""Grid spacing to which axes are rounded for the comparison of bars, metres."""


def check_values(bars: Sequence[CageBar], where: str) -> None:
    """Raise ``MeshError`` for no bar or too many, and for coordinates that are not finite."""
    if not 1 <= len(bars) <= MAX_BARS:
        raise MeshError(f"{where}: {len(bars)} bars found, expected 1 to {MAX_BARS}")
    unbounded = [bar for bar in bars if not np.isfinite(bar.points_m).all()]
    problems = [Problem("invalid", bar.label, "a coordinate is not finite", "finite numbers") for bar in unbounded]
    raise_problems(problems, where)


def cage_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return the reasons to refuse bars in the world frame, whose coordinates are finite.

    They are implausible diameters, bars far from the origin, an implausible size of the whole, bars with the same
    axis, and too many triangles.
    """
    problems = [problem for bar in bars for problem in _bar_problems(bar)]
    if not problems:
        problems = [*_extent_problems(bars), *_duplicate_axis_problems(bars)]
    return problems or _size_problems(bars)


def raise_problems(problems: Sequence[Problem], where: str) -> None:
    """Raise ``MeshError`` with all ``problems`` of the file ``where``, if there are any."""
    if problems:
        raise MeshError.from_problems(where, problems)


def _bar_problems(bar: CageBar) -> list[Problem]:
    """Return what is wrong with one bar: its diameter, or points too far away."""
    diameter_m, farthest_m = bar.bar.diameter_m, float(np.abs(bar.points_m).max())
    problems = []
    if bar.bar.has_axis and not MIN_DIAMETER_M <= diameter_m <= MAX_DIAMETER_M:  # Also catches NaN.
        expected = f"{MIN_DIAMETER_M:g} to {MAX_DIAMETER_M:g} m: is the unit right?"
        problems.append(Problem("invalid", bar.label, f"the diameter is {diameter_m:.6g} m", expected))
    if farthest_m > MAX_EXTENT_M:
        found = f"extends {farthest_m:.6g} m from the world's origin"
        expected = f"at most {MAX_EXTENT_M:g} m: is the unit right, and is the cage at the origin?"
        problems.append(Problem("invalid", bar.label, found, expected))
    return problems


def _extent_problems(bars: Sequence[CageBar]) -> list[Problem]:
    """Return a problem if the largest side of the cage is implausible, else an empty list."""
    points_m = np.concatenate([bar.points_m for bar in bars])
    extent_m = float(np.ptp(points_m, axis=0).max())
    if MIN_EXTENT_M < extent_m < MAX_EXTENT_M:
        return []
    expected = f"{MIN_EXTENT_M:g} to {MAX_EXTENT_M:g} m: is the unit right?"
    return [Problem("invalid", "", f"the cage is {extent_m:.6g} m long", expected)]


def _size_problems(bars: Sequence[CageBar]) -> list[Problem]:
    triangles = sum(map(estimated_triangles, with_ribs_chosen(bars)))
    if triangles <= MAX_TRIANGLES:
        return []
    expected = f"at most {MAX_TRIANGLES}: choose a part of the model with [[select]] tables in a scene TOML file"
    return [Problem("invalid", "", f"the bars make {triangles} triangles", expected)]


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
