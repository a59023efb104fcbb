"""The keys of a scene's TOML file, and what they must be. The whole file is read here, nothing beside it.

```toml
name = "my-beam"              # default: the file's name; small letters, digits and hyphens
unit = "mm"                   # of every length: m, cm, mm, in, ft
environment = "laboratory"    # or "outdoors"
board = 6                     # markers on the A3 sheet: 6, 12, or false for no sheet

[cameras]                     # default: a dome round the assembly
kind = "dome"                 # or "ring" with radius, elevation_deg, azimuths
radii = [300, 400]
elevations_deg = [15, 45]
azimuths = 12

[[bar]]                       # or, above the tables: mesh = "cage.stl", or ifc = "cage.ifc"
diameter = 10
points = [[-150, 0, 5], [150, 0, 5], [150, 0, 80]]   # corners of the path; world, z up, board at z = 0
role = "main"                 # default "bar"
id = 7                        # default: the lowest free one
bend_diameter = 40            # of the mandrel; default EN 1992-1-1: 4 d up to 16 mm, 7 d above
ribs = true                   # default
```

Kinds of values that only a scene's TOML file has: lengths, angles, points and lists.

The units of length that users' files may be in.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from dataset_builder.config.specs import DomeSpec, RigSpec, RingSpec
from dataset_builder.scene.model import MAX_BARS
from dataset_builder.scene.variants import VARIANTS
from rebar_depth_bench.errors import InputError, problem_summary
from rebar_depth_bench.validation import (
    FLAG,
    POSITIVE,
    TABLE,
    Keys,
    Kind,
    T,
    finite,
    found_words,
    number,
    text_that,
    whole_number,
    words,
)

Point = tuple[float, float, float]


def list_of(kind: Kind[T], what: str, expected: str, least: int = 1, most: int = 10_000) -> Kind[tuple[T, ...]]:
    """Return the kind of lists of ``least`` to ``most`` values of ``kind``; problems call one of them ``what``."""

    def convert(values: object) -> tuple[T, ...]:
        if not isinstance(values, list):
            raise ValueError
        if not least <= len(values) <= most:
            raise ValueError(f"got a list of {len(values)}")
        found = []
        for place, value in enumerate(values, start=1):
            try:
                found.append(kind.convert(value))
            except ValueError as error:
                raise ValueError(f"{what} {place}: {found_words(error, value)}") from None
        return tuple(found)

    return Kind(expected, convert)


def _point(value: object) -> Point:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError
    x, y, z = (finite(coordinate) for coordinate in value)
    return x, y, z


LENGTH: Kind[float] = Kind("a length above 0, in the file's unit", POSITIVE.convert)
DISTANCE: Kind[float] = Kind("a distance above 0", POSITIVE.convert)
ELEVATION: Kind[float] = Kind("degrees above 0, up to 89", number(0, 89).convert)
POINT: Kind[Point] = Kind("three numbers", _point)


UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Metres in one of each named unit."""


ENVIRONMENTS = ("laboratory", "outdoors")
SOURCES = ("bar", "mesh", "ifc")
MAX_VIEWS = 10_000
"""The number in a view's id has four digits."""
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,62}")
_PICOMETRES = 12


@dataclass(frozen=True)
class TomlBar:
    """One ``[[bar]]``: the corners of its path, world, metres; ``mandrel_m`` None is the standard's least."""

    bar_id: int
    role: str
    diameter_m: float
    corners_m: tuple[Point, ...]
    mandrel_m: float | None
    ribs: bool


@dataclass(frozen=True)
class SceneToml:
    """A scene's TOML file; None is what it leaves to the defaults, and ``board`` is 0 for no sheet."""

    name: str | None
    unit_m: float
    bars: tuple[TomlBar, ...]
    mesh: str | None
    ifc: str | None
    environment: str | None
    board: int | None
    protocol: DomeSpec | RingSpec | None


def name_kind(taken: Collection[str]) -> Kind[str]:
    """Return the kind of names a scene may have: none of those ``taken``."""
    expected = "a name of small letters, digits and hyphens that starts with a letter or digit"
    if taken:
        expected += f", is none of {', '.join(taken)} and ends in no variant's name"
    return text_that(
        expected, lambda name: bool(_NAME.fullmatch(name)) and name not in taken and not _is_variant(name)
    )


def _is_variant(name: str) -> bool:
    """Tell whether a config and one of its variants could have this name."""
    return any(name.endswith(f"-{variant}") for variant in VARIANTS)


def read_scene_toml(content: bytes, where: str, taken: Collection[str] = ()) -> SceneToml:
    """Return what a scene's TOML file says, lengths in metres (whole picometres).

    Raises ``InputError`` with every problem at once where it is no TOML, or any key is missing, unknown or wrong.
    """
    problems: list[str] = []
    table = Keys(_parsed(content, where), "", problems)
    table.only(("name", "unit", *SOURCES, "environment", "board", "cameras"))
    name = table.optional("name", name_kind(taken))
    unit_m = _unit_m(table)
    sources = {key: table.optional(key, kind) for key, kind in _SOURCE_KINDS.items()}
    given = [key for key in SOURCES if key in table.values]
    if len(given) != 1:
        found = " and ".join(given) or "none of them"
        problems.append(f"{found} given, expected exactly one of [[bar]] tables, mesh and ifc")
    environment = table.optional("environment", words(*ENVIRONMENTS))
    board = table.optional("board", Kind("6, 12 or false", _markers))
    cameras = table.optional("cameras", TABLE)
    protocol = None if cameras is None else _protocol(Keys(cameras, "cameras.", problems), unit_m)
    bars = _bars(sources["bar"] or (), unit_m, problems)
    if problems:
        raise InputError(f"{where}: {problem_summary(problems)}")
    return SceneToml(name, unit_m, bars, sources["mesh"], sources["ifc"], environment, board, protocol)


def _parsed(content: bytes, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{where}: byte {error.start} is no UTF-8 text, expected a TOML file") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: not a TOML file: {error}") from error


def _unit_m(table: Keys) -> float:
    """Return metres per file unit; only a file that has no length of its own may leave the unit out."""
    needed = "ifc" not in table.values or "cameras" in table.values
    unit = (table.required if needed else table.optional)("unit", words(*UNITS_M))
    return UNITS_M[unit] if unit else 1.0


def _markers(value: object) -> int:
    if value is False or (isinstance(value, int) and value is not True and value in (0, 6, 12)):
        return int(value)
    raise ValueError


_FILE = text_that("a path, relative to this file", lambda path: bool(path) and path.isprintable())
_SOURCE_KINDS: Mapping[str, Kind[Any]] = {
    "bar": list_of(TABLE, "bar", f"1 to {MAX_BARS} tables, each under [[bar]]", most=MAX_BARS),
    "mesh": _FILE,
    "ifc": _FILE,
}
_AZIMUTHS = whole_number(1, 3600)
_PROTOCOL_KEYS: Mapping[str, tuple[str, ...]] = {
    "dome": ("kind", "radii", "elevations_deg", "azimuths"),
    "ring": ("kind", "radius", "elevation_deg", "azimuths"),
}


def _protocol(table: Keys, unit_m: float) -> DomeSpec | RingSpec | None:
    """Return the camera protocol of ``[cameras]``, or None where it has problems."""
    kind = table.required("kind", words(*_PROTOCOL_KEYS))
    if kind is not None:
        table.only(_PROTOCOL_KEYS[kind])
    protocol: DomeSpec | RingSpec | None = None
    if kind == "dome":
        radii = table.required("radii", list_of(DISTANCE, "radius", "a list of distances above 0"))
        rings = list_of(ELEVATION, "elevation", "a list of degrees above 0, up to 89")
        elevations_deg = table.required("elevations_deg", rings)
        azimuths = table.required("azimuths", _AZIMUTHS)
        if radii and elevations_deg and azimuths:
            protocol = DomeSpec(tuple(_metres(r, unit_m) for r in radii), elevations_deg, azimuths)
            _check_cameras(table, min(protocol.radii_m), len(radii) * len(elevations_deg) * azimuths)
    elif kind == "ring":
        radius = table.required("radius", DISTANCE)
        elevation_deg = table.required("elevation_deg", ELEVATION)
        azimuths = table.required("azimuths", _AZIMUTHS)
        if radius and elevation_deg and azimuths:
            protocol = RingSpec(_metres(radius, unit_m), elevation_deg, azimuths)
            _check_cameras(table, protocol.radius_m, azimuths)
    return protocol


def _check_cameras(table: Keys, nearest_m: float, views: int) -> None:
    if nearest_m < RigSpec.baseline_m:
        table.problems.append(
            f"{table.where[:-1]}: the nearest stand {nearest_m:.4g} m from the aim point, expected at least the "
            f"rig's baseline, {RigSpec.baseline_m} m: is the unit right?"
        )
    if views > MAX_VIEWS:
        table.problems.append(f"{table.where[:-1]}: {views} views asked for, expected at most {MAX_VIEWS}")


_ROLE = text_that("a name of up to 60 letters", lambda role: role == role.strip() != "" and _is_name(role))
_POINTS = list_of(POINT, "point", "two or more points of three finite numbers each, [x, y, z]", least=2)


def _is_name(role: str) -> bool:
    return len(role) <= 60 and role.isprintable()


def _bars(tables: tuple[Mapping[str, Any], ...], unit_m: float, problems: list[str]) -> tuple[TomlBar, ...]:
    """Return the bars; ids that the file gives are taken first, the others are the lowest free, in file order."""
    rows = [_bar_values(values, f"[[bar]] {place}: ", problems) for place, values in enumerate(tables, start=1)]
    owner: dict[int, int] = {}
    for place, row in enumerate(rows, start=1):
        bar_id = row["id"]
        if bar_id in owner:
            problems.append(f"[[bar]] {place}: id {bar_id} is that of [[bar]] {owner[bar_id]}, expected another")
        elif bar_id is not None:
            owner[bar_id] = place
    if problems:
        return ()
    free = (bar_id for bar_id in range(1, MAX_BARS + 1) if bar_id not in owner)
    return tuple(_bar(row, next(free) if row["id"] is None else row["id"], unit_m) for row in rows)


def _bar_values(values: Mapping[str, Any], where: str, problems: list[str]) -> dict[str, Any]:
    table = Keys(values, where, problems)
    table.only(("diameter", "points", "role", "id", "bend_diameter", "ribs"))
    found = {
        "diameter": table.required("diameter", LENGTH),
        "points": table.required("points", _POINTS),
        "role": table.optional("role", _ROLE),
        "id": table.optional("id", whole_number(1, MAX_BARS)),
        "bend_diameter": table.optional("bend_diameter", LENGTH),
        "ribs": table.optional("ribs", FLAG),
    }
    mandrel, diameter = found["bend_diameter"], found["diameter"]
    if isinstance(mandrel, float) and isinstance(diameter, float) and mandrel < diameter:
        problems.append(
            f"{where}bend_diameter: got {mandrel:g}, expected at least the bar's diameter, {diameter:g}"
        )
    return found


def _bar(row: Mapping[str, Any], bar_id: int, unit_m: float) -> TomlBar:
    mandrel = row["bend_diameter"]
    return TomlBar(
        bar_id=bar_id,
        role=row["role"] or "bar",
        diameter_m=_metres(row["diameter"], unit_m),
        corners_m=tuple((_metres(x, unit_m), _metres(y, unit_m), _metres(z, unit_m)) for x, y, z in row["points"]),
        mandrel_m=None if mandrel is None else _metres(mandrel, unit_m),
        ribs=row["ribs"] is not False,
    )


def _metres(length: float, unit_m: float) -> float:
    """Return a length in metres to the picometre, so that 9 mm is 0.009 m and 16 mm not a hair more than 0.016."""
    return round(length * unit_m, _PICOMETRES)
