"""Schema and reader of scene TOML files. Files named by ``mesh`` and ``ifc`` are not opened here.

```toml
name = "my-beam"              # default: the file name; lower-case letters, digits and hyphens
unit = "mm"                   # of every length: m, cm, mm, in, ft
environment = "laboratory"    # or "outdoors"
board = 6                     # markers on the A3 sheet: 6, 12, or false for no sheet

[cameras]                     # default: a dome around the assembly
kind = "dome"                 # or "ring" with radius, elevation_deg, azimuths
radii = [300, 400]
elevations_deg = [15, 45]
azimuths = 12

[[bar]]                       # or, above the tables: mesh = "cage.stl", or ifc = "cage.ifc"
diameter = 10
points = [[-150, 0, 5], [150, 0, 5], [150, 0, 80]]   # corners of the path; world, z up, board at z = 0
role = "main"                 # default "bar"
id = 7                        # default: the lowest free id
bend_diameter = 40            # of the mandrel; default EN 1992-1-1: 4 d up to 16 mm, 7 d above
ribs = true                   # default
```

The module also defines the field types of lengths, angles, points and lists, and the supported units of length.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from dataset_builder.config.specs import DomeSpec, RigSpec, RingSpec
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS
from dataset_builder.scene.variants import VARIANTS
from rebar_depth_bench.errors import InputError, problem_summary
from rebar_depth_bench.validation_old import (
    FLAG,
    POSITIVE,
    TABLE,
    FieldType,
    T,
    TableReader,
    describe_value,
    finite,
    number,
    one_of,
    string_matching,
    whole_number,
)

Point = tuple[float, float, float]


def list_of(
    field_type: FieldType[T], element_name: str, expected: str, min_length: int = 1, max_length: int = 10_000
) -> FieldType[tuple[T, ...]]:
    """Return the field type of lists of ``min_length`` to ``max_length`` values of type ``field_type``.

    The list is converted to a tuple. ``element_name`` is the noun for one element in problem messages.
    """

    def convert(values: object) -> tuple[T, ...]:
        if not isinstance(values, list):
            raise ValueError
        if not min_length <= len(values) <= max_length:
            raise ValueError(f"got a list of {len(values)}")
        converted = []
        for position, value in enumerate(values, start=1):
            try:
                converted.append(field_type.convert(value))
            except ValueError as error:
                raise ValueError(f"{element_name} {position}: {describe_value(error, value)}") from None
        return tuple(converted)

    return FieldType(expected, convert)


def _point(value: object) -> Point:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError
    x, y, z = (finite(coordinate) for coordinate in value)
    return x, y, z


LENGTH: FieldType[float] = FieldType("a length above 0, in the file's unit", POSITIVE.convert)
DISTANCE: FieldType[float] = FieldType("a distance above 0", POSITIVE.convert)
ELEVATION: FieldType[float] = FieldType("degrees above 0, up to 89", number(0, 89).convert)
POINT: FieldType[Point] = FieldType("three numbers", _point)


UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length of one unit in metres, by unit name."""


ENVIRONMENTS = ("laboratory", "outdoors")
SOURCES = ("bar", "mesh", "ifc")
MAX_VIEWS = 10_000
"""Maximum number of views of a config: the index in a view id has four digits."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")


@dataclass(frozen=True)
class TomlBar:
    """One ``[[bar]]`` table; ``corners_m`` are the corners of its path in the world frame, metres.

    ``mandrel_m`` is the mandrel diameter; None selects the minimum of EN 1992-1-1.
    """

    bar_id: int
    role: str
    diameter_m: float
    corners_m: tuple[Point, ...]
    mandrel_m: float | None
    ribs: bool


@dataclass(frozen=True)
class SceneToml:
    """Content of a scene TOML file; None marks keys left to their defaults.

    ``unit_m`` is one file unit in metres, ``board`` the number of markers (0: no board).
    """

    name: str | None
    unit_m: float
    bars: tuple[TomlBar, ...]
    mesh: str | None
    ifc: str | None
    environment: str | None
    board: int | None
    trajectory: DomeSpec | RingSpec | None


def scene_name_type(reserved: Collection[str]) -> FieldType[str]:
    """Return the field type of scene names: none of ``reserved``, not ending in the name of a variant."""
    expected = "a name of lower-case letters, digits and hyphens that starts with a letter or digit"
    if reserved:
        expected += f", is not one of {', '.join(reserved)} and does not end in a variant's name"
    return string_matching(
        expected, lambda name: bool(_NAME.fullmatch(name)) and name not in reserved and not _is_variant(name)
    )


def _is_variant(name: str) -> bool:
    """Return whether the name ends in the suffix of a variant and could thus be that of a config variant."""
    return any(name.endswith(f"-{variant}") for variant in VARIANTS)


def read_scene_toml(content: bytes, where: str, reserved: Collection[str] = ()) -> SceneToml:
    """Parse the content of a scene TOML file; lengths are converted to metres (whole picometres).

    ``where`` names the file in errors; ``reserved`` are names the scene may not have. Raises ``InputError`` if the
    content is not TOML, and one listing every missing, unknown or invalid key.
    """
    problems: list[str] = []
    table = TableReader(_parse_toml(content, where), "", problems)
    table.reject_unknown(("name", "unit", *SOURCES, "environment", "board", "cameras"))
    name = table.optional("name", scene_name_type(reserved))
    unit_m = _read_unit_m(table)
    sources = {key: table.optional(key, field_type) for key, field_type in _SOURCE_KINDS.items()}
    source_keys = [key for key in SOURCES if key in table.values]
    if len(source_keys) != 1:
        given_keys = " and ".join(source_keys) or "none of them"
        problems.append(f"found {given_keys}, expected exactly one of [[bar]] tables, mesh and ifc")
    environment = table.optional("environment", one_of(*ENVIRONMENTS))
    board = table.optional("board", FieldType("6, 12 or false", _marker_count))
    cameras = table.optional("cameras", TABLE)
    trajectory = None if cameras is None else _read_trajectory(TableReader(cameras, "cameras.", problems), unit_m)
    bars = _read_bars(sources["bar"] or (), unit_m, problems)
    if problems:
        raise InputError(f"{where}: {problem_summary(problems)}")
    return SceneToml(name, unit_m, bars, sources["mesh"], sources["ifc"], environment, board, trajectory)


def _parse_toml(content: bytes, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: not UTF-8: byte {error.start} is invalid, expected a TOML file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not a TOML file: {error}") from error


def _read_unit_m(table: TableReader) -> float:
    """Return metres per file unit; ``unit`` is optional if the file has no lengths (``ifc``, no ``cameras``)."""
    needed = "ifc" not in table.values or "cameras" in table.values
    unit = (table.required if needed else table.optional)("unit", one_of(*UNITS_M))
    return UNITS_M[unit] if unit else 1.0


def _marker_count(value: object) -> int:
    if value is False or (isinstance(value, int) and value is not True and value in (0, 6, 12)):
        return int(value)
    raise ValueError


_FILE = string_matching("a path, relative to this file", lambda path: bool(path) and path.isprintable())
_SOURCE_KINDS: Mapping[str, FieldType[Any]] = {
    "bar": list_of(TABLE, "bar", f"1 to {MAX_BARS} tables, each under [[bar]]", max_length=MAX_BARS),
    "mesh": _FILE,
    "ifc": _FILE,
}
_AZIMUTHS = whole_number(1, 3600)
_TRAJECTORY_KEYS: Mapping[str, tuple[str, ...]] = {
    "dome": ("kind", "radii", "elevations_deg", "azimuths"),
    "ring": ("kind", "radius", "elevation_deg", "azimuths"),
}


def _read_trajectory(table: TableReader, unit_m: float) -> DomeSpec | RingSpec | None:
    """Return the trajectory of the ``[cameras]`` table, or None if the table is invalid."""
    kind = table.required("kind", one_of(*_TRAJECTORY_KEYS))
    if kind is not None:
        table.reject_unknown(_TRAJECTORY_KEYS[kind])
    trajectory: DomeSpec | RingSpec | None = None
    if kind == "dome":
        radii = table.required("radii", list_of(DISTANCE, "radius", "a list of distances above 0"))
        rings = list_of(ELEVATION, "elevation", "a list of degrees above 0, up to 89")
        elevations_deg = table.required("elevations_deg", rings)
        azimuths = table.required("azimuths", _AZIMUTHS)
        if radii and elevations_deg and azimuths:
            trajectory = DomeSpec(tuple(_to_metres(r, unit_m) for r in radii), elevations_deg, azimuths)
            _check_cameras(table, min(trajectory.radii_m), len(radii) * len(elevations_deg) * azimuths)
    elif kind == "ring":
        radius = table.required("radius", DISTANCE)
        elevation_deg = table.required("elevation_deg", ELEVATION)
        azimuths = table.required("azimuths", _AZIMUTHS)
        if radius and elevation_deg and azimuths:
            trajectory = RingSpec(_to_metres(radius, unit_m), elevation_deg, azimuths)
            _check_cameras(table, trajectory.radius_m, azimuths)
    return trajectory


def _check_cameras(table: TableReader, nearest_m: float, views: int) -> None:
    if nearest_m < RigSpec.baseline_m:
        table.problems.append(
            f"{table.where[:-1]}: the nearest cameras are {nearest_m:.4g} m from the aim point, expected at least "
            f"the rig's baseline, {RigSpec.baseline_m} m: is the unit right?"
        )
    if views > MAX_VIEWS:
        table.problems.append(f"{table.where[:-1]}: {views} views requested, expected at most {MAX_VIEWS}")


_ROLE = string_matching(
    "a name of up to 60 letters", lambda role: role == role.strip() != "" and _is_role_name(role)
)
_POINTS = list_of(POINT, "point", "two or more points of three finite numbers each, [x, y, z]", min_length=2)


def _is_role_name(role: str) -> bool:
    return len(role) <= 60 and role.isprintable()


def _read_bars(tables: tuple[Mapping[str, Any], ...], unit_m: float, problems: list[str]) -> tuple[TomlBar, ...]:
    """Return the bars in file order.

    Explicit ids are assigned first; the other bars get the lowest free ids. Returns an empty tuple if there are
    problems.
    """
    rows = [
        _read_bar_table(values, f"[[bar]] {bar_number}: ", problems)
        for bar_number, values in enumerate(tables, start=1)
    ]
    number_of_id: dict[int, int] = {}
    for bar_number, row in enumerate(rows, start=1):
        bar_id = row["id"]
        if bar_id in number_of_id:
            problems.append(
                f"[[bar]] {bar_number}: id {bar_id} is already used by [[bar]] {number_of_id[bar_id]}, "
                "expected a unique id"
            )
        elif bar_id is not None:
            number_of_id[bar_id] = bar_number
    if problems:
        return ()
    free = (bar_id for bar_id in range(1, MAX_BARS + 1) if bar_id not in number_of_id)
    return tuple(_make_bar(row, next(free) if row["id"] is None else row["id"], unit_m) for row in rows)


def _read_bar_table(values: Mapping[str, Any], where: str, problems: list[str]) -> dict[str, Any]:
    table = TableReader(values, where, problems)
    table.reject_unknown(("diameter", "points", "role", "id", "bend_diameter", "ribs"))
    row = {
        "diameter": table.required("diameter", LENGTH),
        "points": table.required("points", _POINTS),
        "role": table.optional("role", _ROLE),
        "id": table.optional("id", whole_number(1, MAX_BARS)),
        "bend_diameter": table.optional("bend_diameter", LENGTH),
        "ribs": table.optional("ribs", FLAG),
    }
    mandrel, diameter = row["bend_diameter"], row["diameter"]
    if isinstance(mandrel, float) and isinstance(diameter, float) and mandrel < diameter:
        problems.append(
            f"{where}bend_diameter: got {mandrel:g}, expected at least the bar's diameter, {diameter:g}"
        )
    return row


def _make_bar(row: Mapping[str, Any], bar_id: int, unit_m: float) -> TomlBar:
    mandrel = row["bend_diameter"]
    return TomlBar(
        bar_id=bar_id,
        role=row["role"] or "bar",
        diameter_m=_to_metres(row["diameter"], unit_m),
        corners_m=tuple(
            (_to_metres(x, unit_m), _to_metres(y, unit_m), _to_metres(z, unit_m)) for x, y, z in row["points"]
        ),
        mandrel_m=None if mandrel is None else _to_metres(mandrel, unit_m),
        ribs=row["ribs"] is not False,
    )


def _to_metres(length: float, unit_m: float) -> float:
    """Return a length in metres, rounded to the picometre.

    The rounding removes the floating-point error of the conversion: 9 mm is exactly 0.009 m, 16 mm exactly 0.016.
    """
    return round(length * unit_m, METRE_DECIMALS)
