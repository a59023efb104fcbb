"""Laboratory environment: the room round the board with bench, walls and furniture, all surfaces with depth.

World frame, metres; the bench top lies just under the sheet at z = 0. No object resembles steel reinforcement,
and none is within the dome of cameras (0.5 m round the origin). The room is open above the walls: no view of
the dome reaches that high, and light that leaves the room costs no further bounces.
"""

from __future__ import annotations

from dataset_builder.scene.model import Mesh, Part, surface
from dataset_builder.scene.shapes.solids import Point, box, cylinder, rotated_box

SHEET_THICKNESS_M = 0.0003
BENCH_TOP_M = -SHEET_THICKNESS_M - 0.0001
FLOOR_M = -0.78
WALL_TOP_M = 1.6
WEST_M, EAST_M, SOUTH_M, NORTH_M = -2.3, 2.5, -2.1, 2.3
WALL_THICKNESS_M = 0.1
WALLS = ("wall", "cabinet", "worktop", "shelf", "crate", "pinboard", "radiator", "door", "locker")
"""First words of the names of the walls and of the furniture along them."""


def laboratory() -> tuple[Part, ...]:
    """Return all surfaces of the room; none is steel."""
    return (*_floor_and_walls(), *_bench(), *_furniture(), *_bench_items())


def _floor_and_walls() -> tuple[Part, ...]:
    """Return floor and four walls, as slabs that lie outside of the room and do not overlap."""
    t = WALL_THICKNESS_M
    low, high = FLOOR_M, WALL_TOP_M
    return (
        surface("floor", box((WEST_M, SOUTH_M, low - t), (EAST_M, NORTH_M, low)), "floor"),
        surface("wall-west", box((WEST_M - t, SOUTH_M, low), (WEST_M, NORTH_M, high)), "plaster"),
        surface("wall-east", box((EAST_M, SOUTH_M, low), (EAST_M + t, NORTH_M, high)), "plaster"),
        surface("wall-south", box((WEST_M, SOUTH_M - t, low), (EAST_M, SOUTH_M, high)), "plaster"),
        surface("wall-north", box((WEST_M, NORTH_M, low), (EAST_M, NORTH_M + t, high)), "plaster"),
    )


def _bench() -> tuple[Part, ...]:
    """Return a laboratory bench: a wooden top on four legs of painted metal."""
    x, y, thickness = 0.95, 0.70, 0.036
    under = BENCH_TOP_M - thickness
    legs = [
        surface(f"bench-leg-{k}", _leg(sx * (x - 0.08), sy * (y - 0.08), under), "painted metal")
        for k, (sx, sy) in enumerate([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    ]
    return (surface("bench-top", box((-x, -y, under), (x, y, BENCH_TOP_M)), "wood"), *legs)


def _leg(x_m: float, y_m: float, top_m: float) -> Mesh:
    half_m, gap_m = 0.03, 0.0005
    return box((x_m - half_m, y_m - half_m, FLOOR_M + gap_m), (x_m + half_m, y_m + half_m, top_m - gap_m))


def _furniture() -> tuple[Part, ...]:
    """Return the furniture along the walls, which low cameras see behind the bench."""
    foot = FLOOR_M + 0.001
    north, east, west, south = NORTH_M - 0.002, EAST_M - 0.002, WEST_M + 0.002, SOUTH_M + 0.002
    cabinets = [
        surface(f"cabinet-{k}", box((x, north - 0.5, foot), (x + 0.594, north, 0.12)), "cabinet")
        for k, x in enumerate([-1.9, -1.3, -0.7, -0.1, 0.5])
    ]
    shelf_boards = [
        surface(f"shelf-{k}", box((east - 0.35, -1.2, z), (east, 1.0, z + 0.025)), "wood")
        for k, z in enumerate([-0.42, 0.0, 0.42, 0.84])
    ]
    return (
        *cabinets,
        surface("worktop", box((-1.92, north - 0.53, 0.121), (1.12, north, 0.155)), "dark laminate"),
        *shelf_boards,
        *(surface(f"crate-{k}", mesh, colour) for k, (mesh, colour) in enumerate(_crates(east))),
        surface("pinboard", box((-1.3, north - 0.02, 0.42), (0.3, north, 1.25)), "cork"),
        surface("radiator", box((west, -0.9, -0.66), (west + 0.09, 0.9, -0.1)), "painted metal"),
        surface("door", box((-0.2, south, foot), (0.72, south + 0.04, 1.28)), "door"),
        surface("locker", box((-1.75, south, foot), (-0.85, south + 0.45, 1.05)), "cabinet"),
    )


def _crates(east_m: float) -> list[tuple[Mesh, str]]:
    """Return mesh and material of the storage boxes on the shelf, each half a millimetre above its board."""
    rows = {-0.3945: "blue plastic", 0.0255: "cardboard", 0.4455: "grey plastic"}
    widths = [0.34, 0.42, 0.30, 0.46]
    crates = []
    for row, (z, colour) in enumerate(rows.items()):
        y = -1.12 + 0.07 * row
        for width in widths:
            mesh = box((east_m - 0.33, y, z), (east_m - 0.03, y + width, z + 0.24 - 0.03 * row))
            crates.append((mesh, colour))
            y += width + 0.06
    return crates


def _bench_items() -> tuple[Part, ...]:
    """Return the objects on the bench, outside of the dome of cameras."""
    z = BENCH_TOP_M + 0.0005

    def standing(x: float, y: float, size: Point, turn: float) -> Mesh:
        return rotated_box((x, y, z + size[2] / 2), size, turn)

    return (
        surface("cube-a", standing(-0.70, 0.50, (0.10, 0.10, 0.10), 14), "concrete"),
        surface("cube-b", standing(-0.55, 0.58, (0.10, 0.10, 0.10), -8), "concrete"),
        surface("cylinder", cylinder((-0.80, 0.36, z), 0.05, 0.20), "concrete"),
        surface("toolbox", standing(0.70, 0.54, (0.34, 0.17, 0.14), -12), "red paint"),
        surface("toolbox-lid", rotated_box((0.70, 0.54, z + 0.1555), (0.35, 0.18, 0.03), -12), "dark laminate"),
        surface("notebook", standing(-0.72, -0.45, (0.21, 0.15, 0.014), 24), "blue plastic"),
        surface("carton", standing(0.76, -0.48, (0.20, 0.15, 0.11), 31), "cardboard"),
        surface("mug", cylinder((0.80, 0.10, z), 0.041, 0.095), "white glaze"),
    )
