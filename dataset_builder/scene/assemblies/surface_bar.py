"""Bars that are known by their surface only: role, fitted axis and diameter, and notes on those without.

Each part of a file, and each connected surface of a file or object without parts, is one bar. A part of several
separate surfaces stays one part, as its file says; no tube fits it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dataset_builder.scene.model import ESTIMATED_ROLE, Mesh, Note, axis_of
from dataset_builder.scene.shapes.tube_fit import NoTubeError, fit_tube
from rebar_depth_bench.data.bars import Bar

AXIS_NOTE = "axis"
"""Code of the note on bars without an axis."""

_MAX_NAMED = 10
"""Largest number of bars that a note names."""


def fitted_bar(bar_id: int, mesh: Mesh) -> Bar:
    """Return the bar of a surface (world, metres), with role ``imported``; without axis if no tube fits.

    Raises ``ValueError`` if every triangle has zero area.
    """
    a_m, b_m, c_m = mesh.vertices_m[mesh.faces].transpose(1, 0, 2)
    if not np.cross(b_m - a_m, c_m - a_m).any():
        raise ValueError("every triangle has zero area")
    try:
        tube = fit_tube(mesh.vertices_m, mesh.faces)
    except NoTubeError:
        return Bar.without_axis(bar_id, ESTIMATED_ROLE)
    return Bar(bar_id, ESTIMATED_ROLE, tube.diameter_m, axis_of(tube.axis_m))


def axis_notes(source: str, labels: Sequence[str], bars: int) -> tuple[Note, ...]:
    """Return the note that names the bars without an axis (``labels``) of all ``bars`` of a file, or none."""
    if not labels:
        return ()
    named = ", ".join(labels[:_MAX_NAMED])
    more = f" and {len(labels) - _MAX_NAMED} more" if len(labels) > _MAX_NAMED else ""
    text = (
        f"{len(labels)} of {bars} bars are not the surface of one round bar and have neither axis nor diameter; "
        f"measures of bars leave them out: {named}{more}"
    )
    return (Note(source, AXIS_NOTE, text),)
