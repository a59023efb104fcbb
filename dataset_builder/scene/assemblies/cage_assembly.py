"""Assemblies from the bars of a user's file."""

from __future__ import annotations

from collections import Counter

from dataset_builder.scene.assemblies.bar_meshes import bar_mesh, with_ribs_chosen
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.assemblies.cage_checks import raise_problems
from dataset_builder.scene.assemblies.mesh_import import axis_notes
from dataset_builder.scene.model import Assembly, Note
from rebar_depth_bench.errors import Problem

_MAX_REASONS = 5
"""Largest number of reasons for leaving out objects that a note gives."""


def cage_assembly(cage: Cage, where: str) -> Assembly:
    """Return the assembly of a cage's bars, in their order (world frame, metres).

    A bar is ribbed unless its ``ribs`` is false or it would have more than ``MAX_RIBS_PER_ROW`` ribs in a row.
    If the ribbed bars have more than ``MAX_RIBS_PER_CAGE`` ribs altogether, no bar is ribbed.

    Raises ``MeshError`` with all ``problems`` of the cage, or with all bars of which no mesh can be made.
    """
    raise_problems(cage.problems, where)
    meshes, problems = [], []
    for bar in with_ribs_chosen(cage.bars):
        try:
            meshes.append((bar.bar, bar_mesh(bar)))
        except ValueError as error:
            problems.append(Problem("invalid", bar.label, str(error)))
    raise_problems(problems, where)
    without_axis = [bar.label for bar in cage.bars if not bar.bar.has_axis]
    notes = [*cage.notes, *axis_notes(where, without_axis, len(cage.bars))]
    return Assembly.from_meshes(meshes, (*notes, *_left_out_notes(cage, where)), cage.world_from_source)


def _left_out_notes(cage: Cage, where: str) -> tuple[Note, ...]:
    """Return the note that counts the objects of the file that are not in the cage, or none."""
    if not cage.left_out:
        return ()
    reasons = Counter(record.reason for record in cage.left_out).most_common(_MAX_REASONS)
    counted = ", ".join(f"{count} ({reason})" for reason, count in reasons)
    text = f"{len(cage.left_out)} objects are left out, which rebar-build inspect lists: {counted}"
    return (Note(where, "left-out", text),)
