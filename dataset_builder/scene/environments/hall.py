"""Hall environment: a structures laboratory of 30 x 24 m, 8 m high, with a strong floor for life-size cages.

World frame, metres; the strong floor is z = 0. Nothing is within ``CLEAR_M`` of the origin in plan below
``CLEAR_HEIGHT_M``, and no object resembles steel reinforcement. Walls and roof enclose the hall, so that every ray
hits a surface; the roof and its lamps let the light of sky and lamp through.
"""

from __future__ import annotations

import numpy as np

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import box, cylinder, merge_meshes, rotated_box

CLEAR_M = 10.4
"""Least distance in plan of objects on the floor from the origin."""
CLEAR_HEIGHT_M = 7.0
"""Least height of objects above the clear part of the floor."""

EAST_M, NORTH_M, ROOF_M = 15.0, 12.0, 8.0
"""Half the length (x) and width (y) of the hall, and its height, inside."""
WALL_THICKNESS_M = 0.2
GAP_M = 0.002
"""Distance between objects that touch, so that no surfaces coincide."""

WALLS = ("wall", "plinth", "columns", "windows", "runways", "crane", "gate", "door", "rack", "crate", "reaction")
"""First words of the names of the walls and of the tall objects along them."""
ROOF = ("roof", "lamps")
"""First words of the names of surfaces above the light of the hall."""

_AXES_X_M = (-12.0, -6.0, 0.0, 6.0, 12.0)
"""Places of the roof beams and of the columns under them."""
_PLINTH_M = 0.12
_BEAM_FOOT_M = 7.2


def hall() -> tuple[Part, ...]:
    """Return all surfaces of the hall; none is steel reinforcement."""
    return (
        *_shell(),
        *_structure(),
        *_wall_fittings(),
        *_crane(),
        *_racks(),
        *_equipment(),
        surface("marking", _marking(), "yellow paint"),
    )


def _shell() -> tuple[Part, ...]:
    """Return floor, roof, four walls and the concrete plinths in front of these; they do not overlap."""
    x, y, h, t, g, p = EAST_M, NORTH_M, ROOF_M, WALL_THICKNESS_M, GAP_M, _PLINTH_M
    walls = {
        "west": box((-x - t, -y, 0.0), (-x, y, h)),
        "east": box((x, -y, 0.0), (x + t, y, h)),
        "south": box((-x, -y - t, 0.0), (x, -y, h)),
        "north": box((-x, y, 0.0), (x, y + t, h)),
    }
    inner_m = x - 2 * g - p
    plinths = [box((s * (x - g), -y + g, g), (s * (x - g - p), y - g, 2.2)) for s in (-1, 1)]
    plinths += [box((-inner_m, s * (y - g), g), (inner_m, s * (y - g - p), 2.2)) for s in (-1, 1)]
    return (
        surface("floor", box((-x, -y, -0.4), (x, y, 0.0)), "strong floor"),
        *(surface(f"wall-{name}", mesh, "cladding") for name, mesh in walls.items()),
        surface("plinth", merge_meshes(plinths), "concrete"),
        surface("roof", box((-x, -y, h), (x, y, h + t)), "cladding"),
    )


def _structure() -> tuple[Part, ...]:
    """Return the roof beams, the columns below their ends, and the lamps under them."""
    face_m = NORTH_M - _PLINTH_M - 2 * GAP_M
    beams = [
        box((x - 0.14, -NORTH_M + GAP_M, _BEAM_FOOT_M), (x + 0.14, NORTH_M - GAP_M, ROOF_M - GAP_M))
        for x in _AXES_X_M
    ]
    columns = [
        box((x - 0.18, s * face_m, GAP_M), (x + 0.18, s * (face_m - 0.34), _BEAM_FOOT_M - GAP_M))
        for x in _AXES_X_M
        for s in (-1, 1)
    ]
    lamps = [
        box((x - 0.17, y - 0.75, _BEAM_FOOT_M - 0.1), (x + 0.17, y + 0.75, _BEAM_FOOT_M - GAP_M))
        for x in _AXES_X_M
        for y in (-8.4, -5.0, -1.7, 1.7, 5.0, 8.4)
    ]
    return (
        surface("roof-beams", merge_meshes(beams), "glued timber"),
        surface("columns", merge_meshes(columns), "concrete"),
        surface("lamps", merge_meshes(lamps), "lamp"),
    )


def _wall_fittings() -> tuple[Part, ...]:
    """Return windows above the plinths, the gate in the north, a door, and the reaction wall in the west."""
    y, g = NORTH_M - GAP_M, GAP_M
    windows = [box((x + 0.5, s * y, 3.3), (x + 5.5, s * (y - 0.05), 5.2)) for x in _AXES_X_M[:-1] for s in (-1, 1)]
    front_m = NORTH_M - _PLINTH_M - 2 * g
    slats = [box((0.35, front_m, 0.01 + 0.6 * k), (5.65, front_m - 0.07, 0.6 * (k + 1))) for k in range(8)]
    inner_m = EAST_M - _PLINTH_M - 2 * g
    wall = box((-inner_m, -5.5, g), (-inner_m + 1.2, 5.5, 5.6))
    return (
        surface("windows", merge_meshes(windows), "window"),
        surface("gate", merge_meshes(slats), "gate"),
        surface("door", box((inner_m, 5.2, g), (inner_m - 0.05, 6.3, 2.15)), "door"),
        surface("reaction-wall", wall, "reaction wall"),
    )


def _crane() -> tuple[Part, ...]:
    """Return the overhead crane, parked in the east, on its runways along the columns."""
    side_m = NORTH_M - _PLINTH_M - 3 * GAP_M - 0.34
    runways = [box((-14.6, s * side_m, 5.6), (14.6, s * (side_m - 0.3), 6.1)) for s in (-1, 1)]
    bridge = box((12.6, -side_m + 0.02, 6.11), (13.3, side_m - 0.02, 6.9))
    hoist = merge_meshes([box((12.45, 2.0, 5.4), (13.45, 3.1, 6.1)), cylinder((12.95, 2.55, 4.7), 0.16, 0.5, 24)])
    return (
        surface("runways", merge_meshes(runways), "painted metal"),
        surface("crane-bridge", bridge, "yellow paint"),
        surface("crane-hoist", hoist, "grey plastic"),
    )


def _racks() -> tuple[Part, ...]:
    """Return a row of racks along the south wall, with crates and cartons on three levels."""
    random = np.random.default_rng(29)
    back_m, front_m = -NORTH_M + 0.56, -NORTH_M + 1.45
    bays = [-13.4 + 2.8 * k for k in range(8)]
    levels = (0.12, 1.65, 3.15)
    posts = [
        box((x - 0.05, y - 0.04, GAP_M), (x + 0.05, y + 0.04, 4.6))
        for x in [*bays, bays[-1] + 2.8]
        for y in (back_m, front_m)
    ]
    shelves = [
        box((x + 0.06, back_m + 0.05, z - 0.11), (x + 2.74, front_m - 0.05, z)) for x in bays for z in levels
    ]
    colours = ("cardboard", "blue plastic", "grey plastic", "timber", "cabinet")
    crates: dict[str, list[Mesh]] = {colour: [] for colour in colours}
    for x in bays:
        for z in levels:
            at_m = x + 0.15
            while (width_m := float(random.uniform(0.45, 1.0))) < x + 2.65 - at_m:
                height_m = float(random.uniform(0.35, 1.05))
                low, high = (at_m, back_m + 0.1, z + GAP_M), (at_m + width_m, front_m - 0.08, z + height_m)
                if random.random() > 0.12:
                    crates[colours[int(random.integers(len(colours)))]].append(box(low, high))
                at_m += width_m + 0.08
    return (
        surface("rack-posts", merge_meshes(posts), "container blue"),
        surface("rack-shelves", merge_meshes(shelves), "orange plastic"),
        *(surface(f"crate-{name.split()[0]}", merge_meshes(meshes), name) for name, meshes in crates.items()),
    )


def _equipment() -> tuple[Part, ...]:
    """Return the objects along the other walls: control cabin, specimens, pallets, a stack of timber, benches."""
    g = GAP_M
    specimens = [rotated_box((12.6, -6.0 + 0.9 * k, 0.36), (2.6, 0.4, 0.5), 2.0 * (-1) ** k) for k in range(4)]
    bearers = [box((x - 0.06, -6.5, g), (x + 0.06, -2.8, 0.105)) for x in (11.7, 13.5)]
    cubes = [
        rotated_box((-11.9 + 0.42 * k, 10.9 - 0.42 * j, 0.152), (0.3, 0.3, 0.3), 7.0 * (k - j))
        for k in range(5)
        for j in range(2)
    ]
    timber = [
        box(
            (6.6, 10.85 + 0.21 * k, 0.1 + 0.1 * row),
            (11.0 - 0.1 * ((k + row) % 3), 11.04 + 0.21 * k, 0.195 + 0.1 * row),
        )
        for k in range(3)
        for row in range(5)
    ]
    pallets = [box((x, y, g), (x + 1.2, y + 0.8, 0.144)) for x, y in ((-6.2, 10.6), (-4.6, 10.6), (12.2, -10.2))]
    cartons = [
        box((x + 0.05, y + 0.05, 0.146), (x + 1.15, y + 0.75, 1.1)) for x, y in ((-6.2, 10.6), (12.2, -10.2))
    ]
    return (
        surface("cabin", box((11.6, 7.4, g), (14.8, 11.4, 2.75)), "cabinet"),
        surface("cabin-window", box((11.55, 8.0, 1.0), (11.597, 10.6, 2.1)), "dark laminate"),
        surface("specimens", merge_meshes(specimens), "concrete"),
        surface("bearers", merge_meshes(bearers), "timber"),
        surface("cubes", merge_meshes(cubes), "concrete"),
        surface("timber", merge_meshes(timber), "timber"),
        surface("pallets", merge_meshes(pallets), "timber"),
        surface("cartons", merge_meshes(cartons), "cardboard"),
        surface("bin", box((-4.5, 10.65, 0.146), (-3.5, 11.35, 0.9)), "blue plastic"),
        surface("lockers", box((-13.4, -8.6, g), (-12.9, -6.0, 1.9)), "cabinet"),
        surface("toolbox", box((-13.3, 6.4, g), (-12.7, 7.6, 1.0)), "red paint"),
    )


def _marking() -> Mesh:
    """Return the yellow line round the clear part of the floor, half a millimetre thick."""
    x, y, w, low, high = 11.2, 10.45, 0.1, 2e-4, 7e-4
    return merge_meshes(
        [box((s * x, -y - w, low), (s * (x + w), y + w, high)) for s in (-1, 1)]
        + [box((-x + 1e-3, s * y, low), (x - 1e-3, s * (y + w), high)) for s in (-1, 1)]
    )
