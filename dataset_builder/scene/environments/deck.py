"""Deck environment: the formwork of a slab, a storey above the building site, with edge boards and guard rails.

World frame, metres; the plywood is z = 0 and 17.5 m wide. Nothing is on it within ``CLEAR_M`` of the origin in
plan, and no object resembles steel reinforcement. The site is that of ``outdoors``, lowered by ``STOREY_M``.
Wooded hills beyond its trees are higher than the cameras, so that every ray below the horizon hits a surface.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dataset_builder.scene.environments.outdoors import GROUND_HALF_M, GROUND_M, placed, ring, site
from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import box, merge_meshes, rotated_box, transformed

STOREY_M = 3.2
HALF_M = 8.75
"""Half the width of the plywood: seven panels in x and fourteen in y."""
CLEAR_M = 8.4
"""Least distance in plan of objects on the deck from the origin."""

PANEL_M = (2.5, 1.25, 0.021)
JOINT_M = 0.003
HILLS_M = (98.0, 130.0)
"""Inner and outer radius of the hills; their foot is below the ground, whose edge they cover."""
HILLS_CREST_M = 17.0
"""Mean height of the hills above the ground."""

_GAP_M = 0.002
_RIM_M = HALF_M + 0.06
"""Distance of the edge boards from the middle of the deck."""


def deck() -> tuple[Part, ...]:
    """Return all surfaces of the deck and of the site below; none is steel reinforcement."""
    return (*_panels(), *_body(), *_rim(), *_stacks(), *_core(), *_site())


def _site() -> tuple[Part, ...]:
    """Return the building site below the deck, and the hills round it."""
    return tuple(
        replace(part, mesh=transformed(part.mesh, np.eye(3), (0.0, 0.0, -STOREY_M)))
        for part in (*site(), _hills())
    )


def _hills() -> Part:
    columns = 180
    angle = np.arange(columns) * 2 * np.pi / columns
    random = np.random.default_rng(31)
    wave = 2.5 * np.sin(2 * angle + 2.0) + 1.6 * np.sin(7 * angle) + random.uniform(-0.5, 0.5, columns)
    foot_m = np.full(columns, GROUND_M - 1.5)
    inner_m, outer_m = np.full(columns, HILLS_M[0]), np.full(columns, HILLS_M[1])
    crest_m = HILLS_CREST_M + wave
    assert HILLS_M[0] < GROUND_HALF_M
    outline = [(inner_m, foot_m), (outer_m, foot_m), (outer_m, crest_m), (outer_m - 4.0, crest_m)]
    return surface("hills", ring(outline, angle), "hills")


def _panels() -> tuple[Part, ...]:
    """Return the plywood panels in three shades, with open joints."""
    random = np.random.default_rng(17)
    length, width, thickness = PANEL_M
    shades: dict[str, list[Mesh]] = {"fresh": [], "used": [], "worn": []}
    for x in np.arange(-HALF_M, HALF_M - 0.1, length):
        for y in np.arange(-HALF_M, HALF_M - 0.1, width):
            j = JOINT_M / 2
            panel = box((x + j, y + j, -thickness), (x + length - j, y + width - j, 0.0))
            shades[list(shades)[int(random.integers(len(shades)))]].append(panel)
    return tuple(
        surface(f"panels-{shade}", merge_meshes(meshes), f"deck panel, {shade}")
        for shade, meshes in shades.items()
    )


def _body() -> tuple[Part, ...]:
    """Return the joists, closed to one body so that no ray passes the joints, and the storey below."""
    top, h, inset = -PANEL_M[2] - _GAP_M, HALF_M, HALF_M - 0.5
    return (
        surface("joists", box((-h, -h, top - 0.3), (h, h, top)), "timber"),
        surface(
            "storey",
            box((-inset, -inset, GROUND_M - STOREY_M - 0.3), (inset, inset, top - 0.3 - _GAP_M)),
            "site concrete",
        ),
    )


def _rim() -> tuple[Part, ...]:
    """Return edge boards round the deck with their blocks, and guard rails of painted boards on posts."""
    r, end = _RIM_M, HALF_M + 0.05
    edge = [box((r, -end, -0.28), (r + 0.027, end, 0.22))]
    at_m = np.linspace(-HALF_M + 0.1, HALF_M - 0.1, 9)
    posts = [box((r + 0.03, y - 0.045, -0.32), (r + 0.12, y + 0.045, 1.14)) for y in at_m]
    rails = [box((r + 0.005, -end, z), (r + 0.028, end, z + 0.15)) for z in (0.3, 0.62, 0.97)]
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    turns = [np.linalg.matrix_power(quarter, turn) for turn in range(4)]
    pieces = (("edge", edge, "plywood"), ("posts", posts, "timber"), ("rails", rails, "yellow paint"))
    return tuple(
        surface(name, merge_meshes([transformed(merge_meshes(side), turn, (0, 0, 0)) for turn in turns]), material)
        for name, side, material in pieces
    )


def _stacks() -> tuple[Part, ...]:
    """Return material in the corners of the deck: panels, joists, bins and a bundle of boards."""
    panels = merge_meshes(
        [rotated_box((0, 0, 0.1 + 0.0225 * k), (2.2, 1.1, 0.021), 0.7 * (-1) ** k) for k in range(16)]
    )
    joists = merge_meshes(
        [
            rotated_box((0.04 * ((k + row) % 3), 0.1 * (k - 3.5), 0.14 + 0.205 * row), (2.4, 0.08, 0.2), 0)
            for k in range(8)
            for row in range(3)
        ]
    )
    bearers = merge_meshes([box((x - 0.05, -0.5, _GAP_M), (x + 0.05, 0.5, 0.035)) for x in (-0.8, 0.8)])
    bin_walls = [box((-0.6, s * 0.4, 0.1), (0.6, s * 0.38, 0.75)) for s in (-1, 1)]
    bin_walls += [box((s * 0.6, -0.378, 0.1), (s * 0.58, 0.378, 0.75)) for s in (-1, 1)]
    bin_walls += [box((-0.6, -0.4, 0.01), (0.6, 0.4, 0.098))]
    c = 6.95
    return (
        placed("stack-panels", panels, (c, c, 0.0), -45.0, "deck panel, fresh"),
        placed("stack-panels-bearers", bearers, (c, c, 0.0), -45.0, "timber"),
        placed("stack-joists", joists, (-c, c, 0.0), 45.0, "yellow timber"),
        placed("stack-joists-bearers", bearers, (-c, c, 0.0), 45.0, "timber"),
        placed("stack-bin", merge_meshes(bin_walls), (-c - 0.1, -c - 0.1, 0.0), -40.0, "container blue"),
        placed("stack-cartons", box((-0.5, -0.35, _GAP_M), (0.5, 0.35, 0.7)), (c, -c, 0.0), 30.0, "cardboard"),
    )


def _core() -> tuple[Part, ...]:
    """Return the concrete core of stairs and lift, one storey higher; in the east it shades no light variant."""
    foot, high, x = GROUND_M - STOREY_M - 0.3, 3.4, HALF_M + 0.7
    return (
        surface("core", box((x, -3.4, foot), (x + 5.0, 2.6, high)), "cast wall"),
        surface("core-opening", box((x - 0.004, -0.9, 0.0), (x - 0.002, 0.15, 2.15)), "dark laminate"),
        surface("core-joint", box((x - 0.012, -3.38, 2.62), (x - 0.002, 2.58, 2.65)), "dark laminate"),
    )
