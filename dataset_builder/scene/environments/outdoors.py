"""Outdoor environment: the building site round a pier with footing slab, ground and objects beyond the cameras.

World frame, metres. The slab's top is z = 0 and the ground lies below it. The steel stands on the origin and the
pier's cameras are up to 20.4 m from it in plan. Except for slab and ground, all objects are at least ``CLEAR_M``
from the origin in plan, and none is steel reinforcement. A ring of trees encloses the site; the sky above is not a
surface.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import (
    Point,
    box,
    merge_meshes,
    ring_faces,
    rotated_box,
    rotation_about_z,
    transformed,
)

CLEAR_M = 21.0
"""Least distance in plan of objects from the origin."""

_CORRUGATION_PITCH_M = 0.28

SLAB_HALF_M = 3.2
GROUND_M = -0.12
"""Height of the ground."""

GROUND_HALF_M = 100.0
TREES_M = (72.0, 84.0)
"""Inner and outer radius of the ring of trees."""

_PROP_BASE_M = GROUND_M + 0.002
"""Height of the lower sides of objects on the ground, so that they do not coincide with it."""


def outdoors() -> tuple[Part, ...]:
    """Return all surfaces of the site; none is steel."""
    return (*_footing(), *site())


def site() -> tuple[Part, ...]:
    """Return the surfaces of the site without the footing slab: the ground, objects beyond ``CLEAR_M``, trees."""
    g = GROUND_HALF_M
    ground = surface("ground", box((-g, -g, GROUND_M - 1.0), (g, g, GROUND_M)), "gravel")
    return (ground, *_containers(), *_hoarding(), *_stacks(), _spoil_heap(), _trees())


def placed(name: str, mesh: Mesh, at_m: Point, turn_deg: float, material: str) -> Part:
    """Return the part whose mesh is rotated about the vertical by ``turn_deg`` and moved to ``at_m``."""
    return surface(name, transformed(mesh, rotation_about_z(turn_deg), at_m), material)


def _footing() -> tuple[Part, ...]:
    """Return the footing slab on its blinding; both extend into the ground."""
    s, b = SLAB_HALF_M, SLAB_HALF_M + 0.35
    return (
        surface("slab", box((-s, -s, -0.6), (s, s, 0.0)), "site concrete"),
        surface("blinding", box((-b, -b, -0.5), (b, b, -0.075)), "blinding"),
    )


def _containers() -> tuple[Part, ...]:
    """Return two site containers with corrugated long sides, frames and doors."""
    places = {"blue": ((-17.0, 21.0), 12.0), "sand": ((-8.5, 25.0), -6.0)}
    door = box((3.035, -1.0, 0.2), (3.06, 1.0, 2.35))
    return tuple(
        placed(f"container-{name}-{piece}", mesh, (x, y, _PROP_BASE_M), turn_deg, material)
        for name, ((x, y), turn_deg) in places.items()
        for piece, mesh, material in (
            ("body", _corrugated(5.9, 2.3, 2.45), f"container {name}"),
            ("frame", _frame(), f"container {name}"),
            ("door", door, "painted metal"),
        )
    )


def _corrugated(length_m: float, width_m: float, height_m: float) -> Mesh:
    """Return a box along x, its base at z = 0.08, with trapezoidal corrugation on its long sides."""
    folds = round(length_m / _CORRUGATION_PITCH_M)
    x = np.append((np.arange(folds)[:, None] + [0.0, 0.3, 0.5, 0.8]).ravel(), folds) * length_m / folds
    inset = np.append(np.tile([0.0, 0.0, 0.045, 0.045], folds), 0.0)
    half = width_m / 2 - inset
    low, count = 0.08, len(x)
    corners = [
        np.stack([x - length_m / 2, side * half, np.full(count, z)], axis=1)
        for side in (-1, 1)
        for z in (low, low + height_m)
    ]
    here = np.arange(count - 1)
    faces = [*_strip(here, 0, 1, count), *_strip(here, 1, 3, count), *_strip(here, 3, 2, count)]
    faces += _strip(here, 2, 0, count)
    ends = [[0, 2 * count, 3 * count], [0, 3 * count, count]]
    ends += [[corner + count - 1 for corner in face[::-1]] for face in ends]
    return Mesh(np.concatenate(corners), np.concatenate([*faces, ends])[:, ::-1].astype(np.int32))


def _strip(here: ndarray, row: int, other: int, count: int) -> list[ndarray]:
    """Return the triangles between the vertex rows ``row`` and ``other`` of ``count`` vertices each."""
    a, b = row * count + here, other * count + here
    return [np.stack([a, b, b + 1], axis=1), np.stack([a, b + 1, a + 1], axis=1)]


def _frame() -> Mesh:
    """Return a container's corner posts and rails, which enclose the ends of the corrugated body."""
    x, y, t, h = 3.03, 1.22, 0.16, 2.6
    posts = [box((sx * x, sy * y, 0.0), (sx * (x - t), sy * (y - t), h)) for sx in (-1, 1) for sy in (-1, 1)]
    inner = x - t - 0.001
    rails = [box((-inner, s * y, z), (inner, s * (y - 0.12), z + 0.15)) for s in (-1, 1) for z in (0.01, h - 0.16)]
    ends = [
        box((s * x, -y + t + 0.001, z), (s * (x - 0.12), y - t - 0.001, z + 0.15))
        for s in (-1, 1)
        for z in (0.01, h - 0.16)
    ]
    return merge_meshes([*posts, *rails, *ends])


def _hoarding() -> tuple[Part, ...]:
    """Return two rows of closed panels, 60 mm apart, each panel on a concrete foot."""
    runs = (((31.0, -16.0), 97.0, 14), ((-24.0, -29.0), 4.0, 18))  # The east and the south run.
    sheets: dict[str, list[Mesh]] = {"hoarding white": [], "hoarding blue": []}
    feet = []
    for (x, y), turn_deg, panels in runs:
        along = rotation_about_z(turn_deg)[:, 0]
        for k in range(panels):
            at = np.array([x, y, _PROP_BASE_M]) + 2.46 * k * along
            colour = "hoarding blue" if k % 5 == 3 else "hoarding white"
            sheets[colour].append(rotated_box((at[0], at[1], at[2] + 1.2), (2.4, 0.04, 2.0), turn_deg))
            feet.append(rotated_box((at[0], at[1], at[2] + 0.09), (0.7, 0.25, 0.18), turn_deg))
    panels_of = tuple(
        surface(f"hoarding-{colour[9:]}", merge_meshes(meshes), colour) for colour, meshes in sheets.items()
    )
    return (*panels_of, surface("hoarding-feet", merge_meshes(feet), "site concrete"))


def _stacks() -> tuple[Part, ...]:
    """Return a stack of timber on bearers, and two layers of concrete blocks."""
    timber = []
    for layer in range(6):
        for k in range(5):
            at = (0.0, (k - 2) * 0.27, 0.12 + 0.145 * layer)
            timber.append(rotated_box(at, (4.2 + 0.07 * ((3 * k + layer) % 4), 0.24, 0.12), 0.0))
    bearers = [rotated_box((x, 0.0, 0.025), (0.1, 1.5, 0.05), 0.0) for x in (-1.4, 1.4)]
    blocks = [
        rotated_box(((k - 1.5) * 1.66, 0.0, 0.4 + 0.81 * row), (1.6, 0.8, 0.8), 0.0)
        for row in range(2)
        for k in range(4 - row)
    ]
    timber_at_m = (22.5, 7.5, _PROP_BASE_M)
    return (
        placed("timber", merge_meshes(timber), timber_at_m, 35.0, "timber"),
        placed("bearers", merge_meshes(bearers), timber_at_m, 35.0, "timber"),
        placed("blocks", merge_meshes(blocks), (-25.0, -6.5, _PROP_BASE_M), -64.0, "site concrete"),
    )


def _spoil_heap() -> Part:
    """Return a low mound of soil whose base is below the ground."""
    random = np.random.default_rng(11)
    heap = _mound(rings=9, columns=36, radius_m=7.0, height_m=3.1, random=random)
    return surface("spoil-heap", transformed(heap, np.diag([1.35, 1.0, 1.0]), (12.0, 31.5, GROUND_M)), "soil")


def _mound(rings: int, columns: int, radius_m: float, height_m: float, random: np.random.Generator) -> Mesh:
    """Return a closed mound: rings of vertices from the buried base to the top, with a fan above and below."""
    share = np.linspace(1.0, 0.06, rings)[:, None]
    angle = np.arange(columns) * 2 * np.pi / columns
    radius = radius_m * share * (1 + 0.10 * np.sin(3 * angle + 1.0) + random.normal(0, 0.03, (rings, columns)))
    height = height_m * (1 - share) ** 0.8 * (1 + random.normal(0, 0.05, (rings, columns)))
    height[0] = -0.3
    sides = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([sides, [[0.0, 0.0, height_m], [0.0, 0.0, -0.3]]])
    rim = np.arange(columns)
    following, top, last = (rim + 1) % columns, rings * columns, (rings - 1) * columns
    faces = np.concatenate(
        [
            ring_faces(rings, columns),
            np.stack([last + rim, last + following, np.full(columns, top)], 1),
            np.stack([following, rim, np.full(columns, top + 1)], 1),
        ]
    )
    return Mesh(vertices, faces.astype(np.int32))


def _trees() -> Part:
    """Return a closed ring with an irregular crest, which represents the edge of a wood."""
    columns = 420
    random = np.random.default_rng(7)
    angle = np.arange(columns) * 2 * np.pi / columns
    crest_m = 6.2 + 1.5 * np.sin(2 * angle + 0.7) + 1.0 * np.sin(5 * angle) + random.uniform(-1.3, 1.3, columns)
    inner_m, outer_m = TREES_M[0] + random.uniform(-1.0, 1.0, columns), np.full(columns, TREES_M[1])
    top_m = inner_m + random.uniform(3.0, 6.0, columns)
    foot_m = np.full(columns, GROUND_M - 0.5)
    outline = [
        (inner_m, foot_m),
        (outer_m, foot_m),
        (outer_m, foot_m + 1.0),
        (top_m, crest_m),
        (inner_m, 0.5 * crest_m),
    ]
    return surface("trees", ring(outline, angle), "trees")


def ring(
    outline: list[tuple[Float64[ndarray, " c"], Float64[ndarray, " c"]]], angle: Float64[ndarray, " c"]
) -> Mesh:
    """Return a closed ring about z from an outline of (radius, height), metres, given for each angle (radians)."""
    vertices = np.concatenate([np.stack([r * np.cos(angle), r * np.sin(angle), h], axis=1) for r, h in outline])
    return Mesh(vertices, ring_faces(len(outline), len(angle), closed=True))
