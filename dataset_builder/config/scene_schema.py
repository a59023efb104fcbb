"""Schema and reader of scene TOML files. Files named by ``mesh`` and ``ifc`` are not opened here.

```toml
name = "my-beam"              # default: the file name; lower-case letters, digits and hyphens
unit = "mm"                   # of every length: m, cm, mm, in, ft; default with ifc: m
environment = "laboratory"    # or "outdoors", "hall", "deck"
board = 6                     # markers on the A3 sheet: 6, 12, or false for no sheet

[cameras]                     # default: a dome around the assembly, or a survey of large steel
kind = "dome"                 # or "ring" with radius, elevation_deg, azimuths;
                              # or "survey" with, if wanted, distances, views_per_distance, seed
radii = [300, 400]
elevations_deg = [15, 45]
azimuths = 12

[[bar]]                       # or, above the tables: mesh = "cage.stl", or ifc = "cage.ifc" (``source_tables``)
diameter = 10
points = [[-150, 0, 5], [150, 0, 5], [150, 0, 80]]   # corners of the path; world, z up, board at z = 0
role = "main"                 # default "bar"
id = 7                        # default: the lowest free id
bend_diameter = 40            # of the mandrel; default EN 1992-1-1: 4 d up to 16 mm, 7 d above
ribs = true                   # default
```
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import count
from typing import Annotated, Any

from pydantic import Strict, ValidationInfo, field_validator

from dataset_builder.config.camera_tables import AnyCamerasTable, camera_conflicts, list_of, read_cameras
from dataset_builder.config.file_specs import Origin, PlacementSpec
from dataset_builder.config.source_tables import (
    MAX_SELECTIONS,
    OriginKey,
    RotationKey,
    SelectTable,
    TranslationKey,
    TrustKey,
    UpKey,
    selection_conflicts,
)
from dataset_builder.config.specs import TrajectorySpec
from dataset_builder.config.surroundings import SURROUNDINGS
from dataset_builder.scene.model import MAX_BARS, to_metres
from dataset_builder.scene.selection import Selection
from dataset_builder.scene.variants import VARIANTS
from rebar_depth_bench.errors import InputError, Problem
from rebar_depth_bench.paths import is_below
from rebar_depth_bench.reading import parse_toml
from rebar_depth_bench.validation import (
    UNITS_M,
    Expected,
    Flag,
    StrictModel,
    Triple,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    three_numbers,
    validate_table,
    whole_number,
)

SOURCES = ("bar", "mesh", "ifc")


def _is_scene_name(name: str) -> bool:
    """Return whether a name is well-formed and does not end in the suffix of a variant, as config variants do."""
    is_variant = any(name.endswith(f"-{variant}") for variant in VARIANTS)
    return bool(re.fullmatch(r"[a-z0-9][a-z0-9-]{0,62}", name)) and not is_variant


SCENE_NAME = Expected(
    "a name of at most 63 lower-case letters, digits and hyphens that starts with a letter or digit and does not "
    "end in a variant's name",
    _is_scene_name,
)
"""Description of scene names, which are also the names of configs."""


_UNIT = one_of(*UNITS_M)
_ROLE = Expected(
    "a name of up to 60 printable characters, without spaces at its ends",
    lambda role: role == role.strip() and text(60).accept(role),
)
_File = Annotated[str, Expected("the path of a file in the folder of this file, or below it", is_below)]
_Length = Annotated[float, number(0, expected="a length above 0, up to 1e9, in the file's unit")]
_Point = Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers from -1e9 to 1e9, [x, y, z]")]


@dataclass(frozen=True)
class TomlBar:
    """One bar of a scene TOML file; ``corners_m`` are the corners of its path in the world frame, metres.

    ``mandrel_m`` is the mandrel diameter; None selects the minimum of EN 1992-1-1.
    """

    bar_id: int
    role: str
    diameter_m: float
    corners_m: tuple[Triple, ...]
    mandrel_m: float | None
    ribs: bool


class BarTable(StrictModel):
    """One ``[[bar]]`` table; lengths are in the file's unit."""

    diameter: _Length
    points: Annotated[tuple[_Point, ...], Strict(False), list_of("two or more points, [[x, y, z], ...]", 2)]
    role: Annotated[str, _ROLE] = "bar"
    id: Annotated[int, whole_number(1, MAX_BARS)] | None = None
    bend_diameter: _Length | None = None
    ribs: Flag = True

    @field_validator("bend_diameter")
    @classmethod
    def _check_bend_diameter(cls, mandrel: float, info: ValidationInfo) -> float:
        diameter = info.data.get("diameter", 0.0)
        if mandrel < diameter:
            raise field_error(f"got {mandrel:g}", f"at least the bar's diameter, {diameter:g}", "conflict")
        return mandrel

    def in_metres(self, bar_id: int, unit_m: float) -> TomlBar:
        """Return the bar with its id and its lengths in metres; ``unit_m`` is the file's unit."""
        corners_m = tuple(
            (to_metres(x, unit_m), to_metres(y, unit_m), to_metres(z, unit_m)) for x, y, z in self.points
        )
        mandrel_m = None if self.bend_diameter is None else to_metres(self.bend_diameter, unit_m)
        return TomlBar(bar_id, self.role, to_metres(self.diameter, unit_m), corners_m, mandrel_m, self.ribs)


class SceneToml(StrictModel):
    """Content of a scene TOML file, lengths in its unit; None marks keys left to their defaults.

    ``board`` is the number of markers (0 or false: no board).
    """

    name: Annotated[str, SCENE_NAME] | None = None
    unit: Annotated[str, _UNIT] | None = None
    bar: Annotated[tuple[BarTable, ...], Strict(False)] = ()
    mesh: _File | None = None
    ifc: _File | None = None
    environment: Annotated[str, one_of(*SURROUNDINGS)] | None = None
    board: Annotated[int | bool, Expected("6, 12 or false", lambda markers: markers in (0, 6, 12))] | None = None
    cameras: AnyCamerasTable | None = None
    up: UpKey = "z"
    origin: OriginKey | None = None
    rotate_deg: RotationKey = 0.0
    translate: TranslationKey = (0.0, 0.0, 0.0)
    select: Annotated[tuple[SelectTable, ...], Strict(False)] = ()
    trust: TrustKey = "declared"

    @property
    def unit_m(self) -> float:
        """One file unit in metres; 1.0 if an IFC scene has no unit."""
        return _unit_m(self.unit)

    @property
    def placement(self) -> PlacementSpec:
        """Placement in metres."""
        x, y, z = (to_metres(value, self.unit_m) for value in self.translate)
        origin: Origin = self.origin or ("keep" if self.bar else "centre")
        return PlacementSpec(self.up, origin, self.rotate_deg, (x, y, z))

    @property
    def selections(self) -> tuple[Selection, ...]:
        """Tables ``[[select]]`` in file order."""
        return tuple(table.selection() for table in self.select)

    @property
    def trajectory(self) -> TrajectorySpec | None:
        """Camera trajectory in metres, a survey without its stations, or None for the default."""
        return None if self.cameras is None else self.cameras.trajectory(self.unit_m)

    @property
    def bars(self) -> tuple[TomlBar, ...]:
        """Bars in file order, metres; those without an id get the lowest free ids."""
        used_ids = {bar.id for bar in self.bar}
        free_ids = (bar_id for bar_id in count(1) if bar_id not in used_ids)
        return tuple(bar.in_metres(next(free_ids) if bar.id is None else bar.id, self.unit_m) for bar in self.bar)

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str, info: ValidationInfo[Collection[str]]) -> str:
        """Check that the name is not reserved; ``info.context`` are the reserved names."""
        if name in (info.context or ()):
            raise field_error(f"got {name!r}", f"none of the names {', '.join(info.context)}", "conflict")
        return name

    @field_validator("select", mode="before")
    @classmethod
    def _check_select_list(cls, tables: object) -> object:
        if not isinstance(tables, list) or not 1 <= len(tables) <= MAX_SELECTIONS:
            raise field_error(f"got {short_repr(tables)}", f"1 to {MAX_SELECTIONS} tables, each under [[select]]")
        return tables

    @field_validator("bar", mode="before")
    @classmethod
    def _check_bar_list(cls, tables: object) -> object:
        if not isinstance(tables, list) or not 1 <= len(tables) <= MAX_BARS:
            raise field_error(f"got {short_repr(tables)}", f"1 to {MAX_BARS} tables, each under [[bar]]")
        return tables


def read_scene_toml(content: bytes, where: str, reserved: Collection[str] = ()) -> SceneToml:
    """Return the parsed content of a scene TOML file.

    ``where`` names the file in errors; ``reserved`` are names the scene may not have. Raises ``InputError`` that
    lists all problems: content that is not TOML, or keys that are missing, unknown, invalid or in conflict.
    """
    values, problems = parse_toml(content)
    if not problems:
        problems += _conflicts(values)
        if "cameras" in values:
            values["cameras"] = read_cameras(values["cameras"], _unit_m(values.get("unit")), problems)
        scene = validate_table(SceneToml, values, problems, context=reserved)
        if scene is not None and not problems:
            return scene
    raise InputError.from_problems(where, problems)


def _unit_m(unit: object) -> float:
    return UNITS_M[unit] if isinstance(unit, str) and unit in UNITS_M else 1.0


def _conflicts(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield the problems that concern several keys; values that are invalid alone are ignored."""
    yield from selection_conflicts(values)
    if "unit" not in values and "ifc" not in values:
        yield Problem("missing", "unit", "missing", _UNIT.text)
    sources = [key for key in SOURCES if key in values]
    if len(sources) != 1:
        found = f"found {' and '.join(sources) or 'no bars'}"
        expected = "exactly one of [[bar]] tables, mesh and ifc"
        yield Problem("conflict" if sources else "missing", "", found, expected)
    yield from camera_conflicts(values.get("cameras"))
    number_of_id: dict[int, int] = {}
    tables = values.get("bar")
    for bar_number, table in enumerate(tables if isinstance(tables, list) else (), start=1):
        bar_id = table.get("id") if isinstance(table, dict) else None
        if type(bar_id) is int and 1 <= bar_id <= MAX_BARS:
            first = number_of_id.setdefault(bar_id, bar_number)
            if first != bar_number:
                found = f"{bar_id} is the id of bar {first}"
                yield Problem("duplicate", f"bar {bar_number}: id", found, "a unique id")
