"""Comparison of a bar's geometry with the nominal diameter and length that its IFC object or type declares.

The geometry is always what is built. Some programs model the outer diameter of the ribs (some 10 % more), so
diameters may differ; beyond a quarter, one of the two values is wrong. Lengths are compared for information: some
programs write them in another unit, or for a whole row of bars.
"""

from __future__ import annotations

from collections.abc import Sequence

from dataset_builder.config.file_specs import Trust
from dataset_builder.scene.assemblies.cage import CageBar
from dataset_builder.scene.model import Note
from rebar_depth_bench.errors import Problem

_NOTED, _REFUSED = 0.05, 0.25
"""Differences, relative to the declared value, above which there is a note, and above which a bar is refused."""


def compare_declared(
    bar: CageBar, name: str, diameters_m: Sequence[float], length_m: float | None, trust: Trust
) -> tuple[list[Note], Problem | None]:
    """Return notes (with ``name`` as source) on a bar, and the reason to refuse it or None.

    The declared ``diameters_m`` may be none, one, or two for a mesh, of which the nearest counts; ``length_m`` is
    the declared length of the centreline or None. A bar without axis and diameter is not compared.
    """
    if not bar.bar.has_axis:
        return [], None
    notes: list[Note] = []
    found_m = bar.bar.diameter_m
    if diameters_m:
        nearest_m = min(diameters_m, key=lambda declared_m: abs(declared_m - found_m))
        difference = abs(found_m - nearest_m) / nearest_m
        values = f"the diameter is {found_m * 1000:.4g} mm in the geometry, {nearest_m * 1000:.4g} mm as declared"
        if difference > _REFUSED and trust != "geometry":
            return [], Problem("invalid", bar.label, values, f"at most {_REFUSED:.0%} difference")
        if difference > _NOTED:
            notes.append(Note(name, "diameter", values))
    if length_m and abs(bar.bar.length_m - length_m) > _NOTED * length_m:
        values = f"the length is {bar.bar.length_m:.4g} m in the geometry, {length_m:.4g} m as declared"
        notes.append(Note(name, "length", values))
    return notes, None
