"""Schema and reader of scene TOML files. Files named by ``mesh`` and ``ifc`` are not opened here.

```toml
name = "my-beam"              # default: the file name; lower-case letters, digits and hyphens
unit = "mm"                   # of every length: m, cm, mm, in, ft; default with ifc: m
environment = "laboratory"    # or "outdoors", "hall", "deck"
board = 6                     # markers on the A3 sheet: 6, 12, or false for no sheet

[rig]                         # default: ideal pinholes 0.12 m apart, 1280 x 720 pixels, fx = fy = 700
camera = "Intel RealSense D455"    # or a calibration or numbers, see below

[cameras]                     # default: a dome around the assembly, or a survey beyond 1 m
kind = "dome"                 # or "ring" with radius, elevation_deg, azimuths;
                              # or "survey" with, if wanted, distances, views_per_distance, seed;
                              # or "poses" with positions, targets (as many, or one), up (default [0, 0, 1])
radii = [300, 400]
elevations_deg = [15, 45]
azimuths = 12

[[bar]]                       # or, above the tables: mesh = "cage.stl", or ifc = "cage.ifc"
diameter = 10
points = [[-150, 0, 5], [150, 0, 5], [150, 0, 80]]   # corners of the path; world, z up, board at z = 0
count = 4                     # of equal bars in a row, each [x, y, z] after the one before it; default 1
step = [0, 50, 0]
role = "main"                 # default "bar"
id = 7                        # of the first one, the others follow; default: the lowest free ids
bend_diameter = 40            # of the mandrel; default EN 1992-1-1: 4 d up to 16 mm, 7 d above
ribs = true                   # default
```

Keys about the file that ``mesh`` or ``ifc`` names: selected objects and placement.

```toml
ifc = "building.ifc"          # or mesh = "cage.stl", a file beside this one
up = "z"                      # vertical axis of the file, the default, or "y"
origin = "centre"             # above the world's origin and on the ground, the default for mesh and ifc; or "keep"
rotate_deg = 30               # about the vertical axis, after centring
translate = [0.5, 0, 0]       # at last; in this file's unit
trust = "geometry"            # if an IFC object declares another diameter than it has; default "declared": refuse

[[select]]                    # an object is taken if all keys of any table match
class = "IfcBuildingElementProxy"    # default: IfcReinforcingBar, IfcReinforcingMesh, IfcTendon
name = "Rebar*"               # and so global_id, host, storey, layer; of a mesh file: only name and box
box = [[0, 0, 0], [5e3, 5e3, 3e3]]   # two corners, in the frame and unit of the file; objects wholly inside it
```

Forms beside the bars of any of these files.

```toml
[[form]]                      # a sheet of plywood, 21 mm thick, behind its face
point = [0, 60, 100]          # the middle of the face; world
normal = [0, -1, 0]           # towards the steel
size = [500, 200]             # sides of the face: along, and across it
along = [1, 0, 0]             # default: horizontal, the x axis for a horizontal face
name = "side"                 # default: form-1, form-2, ...
```
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import asdict, dataclass
from operator import mul
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, Strict, ValidationInfo, field_validator

from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.scene.model import MAX_BARS, METRE_DECIMALS, to_metres
from dataset_builder.scene.variants.registry import VARIANTS
from dataset_builder.specs.config_specs import DomeSpec, FormSpec, PosesSpec, RingSpec, SurveySpec
from dataset_builder.specs.file_specs import KEYS, Origin, PlacementSpec, Selection, Trust, Up
from dataset_builder.user_files.rig_file import RigTable
from rebar_depth_bench.base.errors import InputError, Problem
from rebar_depth_bench.base.reading import is_below, parse_toml
from rebar_depth_bench.base.validation import (
    UNITS_M,
    Expected,
    Flag,
    StrictModel,
    Triple,
    check_unique,
    field_error,
    number,
    one_of,
    short_repr,
    text,
    three_numbers,
    validate_table,
    whole_number,
)
from rebar_depth_bench.data.schema import trajectory_of

MAX_VIEWS = 10_000
"""Maximum number of views of a config: the index in a view id has four digits."""
_MAX_AZIMUTHS = 3600
_MAX_SELECTIONS = 100
_MAX_FORMS = 100
_MAX_COSINE = 1 - 1e-6
"""Largest cosine of the angle between the normal of a form and its first side."""
_MESH_KEYS = ("name", "box")
"""Keys of ``[[select]]`` for a mesh file, whose parts have no other names."""


@dataclass(frozen=True)
class _Context:
    """Context of the validation of a file: its unit in metres, and the names that its scene may not have."""

    unit_m: float
    reserved: Collection[str]


_VARIANT_ENDINGS = tuple(f"-{variant}" for variant in VARIANTS)
SCENE_NAME = Expected(
    "a name of at most 63 lower-case letters, digits and hyphens that starts with a letter or digit and does not "
    "end in a variant's name",
    lambda name: bool(re.fullmatch(r"[a-z0-9][a-z0-9-]{0,62}", name)) and not name.endswith(_VARIANT_ENDINGS),
)
"""Description of scene names, which are also the names of configs."""


def _length_in_metres(length: float, info: ValidationInfo[_Context]) -> float:
    return to_metres(length, info.context.unit_m)


def _point_in_metres(point: Triple, info: ValidationInfo[_Context]) -> Triple:
    x, y, z = (to_metres(value, info.context.unit_m) for value in point)
    return x, y, z


def _list_of(expected: str, min_length: int = 1) -> Expected:
    """Return the description of lists of ``min_length`` to 10,000 elements."""
    return Expected(expected, lambda values: min_length <= len(values) <= 10_000)


def _tables(key: str, most: int) -> BeforeValidator:
    """Return the check that a value is a list of 1 to ``most`` tables, each under the heading of ``key``."""

    def check(tables: object) -> object:
        if not isinstance(tables, list) or not 1 <= len(tables) <= most:
            raise field_error(f"got {short_repr(tables)}", f"1 to {most} tables, each under [[{key}]]")
        return tables

    return BeforeValidator(check)


_PLANES_OF_BUILDER = ("deck", "formwork", "falsework")
"""First words of the names of planes of formwork that environments and variants have."""
_UNIT = one_of(*UNITS_M)
_ROLE = Expected(
    "a name of up to 60 printable characters, without spaces at its ends",
    lambda role: role == role.strip() and text(60).accept(role),
)
_FORM_NAME = Expected(
    f"at most 40 lower-case letters, digits and hyphens, after a letter, and not {', '.join(_PLANES_OF_BUILDER)}",
    lambda name: bool(re.fullmatch(rf"(?!{'|'.join(_PLANES_OF_BUILDER)})[a-z][a-z0-9-]{{0,39}}", name)),
)
_File = Annotated[str, Expected("the path of a file in the folder of this file, or below it", is_below)]
_Length = Annotated[
    float,
    number(0, expected="a length above 0, up to 1e9, in the file's unit"),
    AfterValidator(_length_in_metres),
]
_Point = Annotated[
    Triple, three_numbers(-1e9, 1e9, "three numbers from -1e9 to 1e9, [x, y, z]"), AfterValidator(_point_in_metres)
]
_Direction = Annotated[
    Triple, Expected("a direction of numbers up to 1e9, not zero", lambda axis: 1e-9 < math.hypot(*axis) <= 1e9)
]
_FormSize = Annotated[
    tuple[_Length, _Length],
    Strict(False),
    Expected("two sides of 10 mm or more, [along, across]", lambda size_m: min(size_m) >= 0.01),
]
_Step = Annotated[_Point, Expected("a step that is not zero, [x, y, z]", any)]
_Points = Annotated[tuple[_Point, ...], Strict(False), _list_of("a list of points, [[x, y, z], ...]")]
_Distances = Annotated[tuple[_Length, ...], Strict(False), _list_of("a list of distances")]
_Elevation = Annotated[float, number(0, 89, "degrees above 0, up to 89")]
_Azimuths = Annotated[int, whole_number(1, _MAX_AZIMUTHS)]
_Pattern = Annotated[str, text(200, 'a name or a glob pattern such as "Level 1*"')]
_Corner = Annotated[Triple, three_numbers(-1e12, 1e12, "three numbers from -1e12 to 1e12, [x, y, z]")]
_Box = Annotated[
    tuple[_Corner, _Corner], Strict(False), Expected("two corners, [[x, y, z], [x, y, z]], in any order")
]


class TomlBar(StrictModel):
    """One ``[[bar]]`` table in metres; ``corners_m`` are the corners of its path in the world frame.

    The table makes ``count`` equal bars, each ``step_m`` after the one before it. ``bar_id`` is that of the first;
    0 stands for the lowest free ids. ``mandrel_m`` is the mandrel diameter; None selects the minimum of
    EN 1992-1-1.
    """

    diameter_m: _Length = Field(alias="diameter")
    corners_m: Annotated[
        tuple[_Point, ...], Strict(False), _list_of("two or more points, [[x, y, z], ...]", 2)
    ] = Field(alias="points")
    count: Annotated[int, whole_number(1, MAX_BARS)] = 1
    step_m: _Step = Field(default=(0.0, 0.0, 0.0), alias="step")
    role: Annotated[str, _ROLE] = "bar"
    bar_id: Annotated[int, whole_number(1, MAX_BARS)] = Field(default=0, alias="id")
    mandrel_m: _Length | None = Field(default=None, alias="bend_diameter")
    ribs: Flag = True

    @field_validator("mandrel_m")
    @classmethod
    def _check_mandrel(cls, mandrel_m: float, info: ValidationInfo[_Context]) -> float:
        diameter_m = info.data.get("diameter_m", 0.0)
        if mandrel_m < diameter_m:
            found, least = (length_m / info.context.unit_m for length_m in (mandrel_m, diameter_m))
            raise field_error(f"got {found:g}", f"at least the bar's diameter, {least:g}", "conflict")
        return mandrel_m


class CamerasTable(StrictModel, extra="ignore"):
    """Keys of the table ``[cameras]`` for all kinds; the fields of a kind are those of its spec, in metres."""

    kind: Annotated[str, one_of("dome", "ring", "survey", "poses")]


class DomeTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a dome."""

    azimuths: _Azimuths
    radii_m: _Distances = Field(alias="radii")
    elevations_deg: Annotated[tuple[_Elevation, ...], Strict(False), _list_of("a list of elevations in degrees")]


class RingTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a ring."""

    azimuths: _Azimuths
    radius_m: _Length = Field(alias="radius")
    elevation_deg: _Elevation


class SurveyTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of a survey."""

    distances_m: _Distances = Field(default=SurveySpec.distances_m, alias="distances")
    views_per_distance: Annotated[int, whole_number(1, MAX_VIEWS)] = SurveySpec.views_per_distance
    seed: Annotated[int, whole_number(0, 2**31 - 1)] = SurveySpec.seed


class PosesTable(CamerasTable, extra="forbid"):
    """Table ``[cameras]`` of given poses; a single target is that of all positions."""

    positions_m: _Points = Field(alias="positions")
    up: Annotated[Triple, three_numbers(-1e9, 1e9, "a direction, [x, y, z]")] = PosesSpec.up
    targets_m: _Points = Field(alias="targets")

    @field_validator("targets_m")
    @classmethod
    def _check_sights(cls, targets_m: tuple[Triple, ...], info: ValidationInfo[_Context]) -> tuple[Triple, ...]:
        if not {"positions_m", "up"} <= info.data.keys():  # One of them is invalid.
            return targets_m
        positions_m, up = info.data["positions_m"], info.data["up"]
        if len(targets_m) not in (1, len(positions_m)):
            expected = f"as many as positions, {len(positions_m)}, or one"
            raise field_error(f"got {len(targets_m)} targets", expected, "conflict")
        sights_m = np.subtract(targets_m, positions_m)
        across = np.linalg.norm(np.cross(sights_m, up), axis=1)
        parallel = across <= 1e-5 * np.linalg.norm(sights_m, axis=1) * np.linalg.norm(up)
        if parallel.any():
            found = f"the line of sight of position {parallel.argmax() + 1} is parallel to up = {list(up)}"
            raise field_error(found, "another target, or another up, such as [0, 1, 0]", "conflict")
        return targets_m


_Trajectory = DomeSpec | RingSpec | SurveySpec | PosesSpec
_KINDS: Mapping[str, tuple[type[CamerasTable], Callable[..., _Trajectory]]] = {
    "dome": (DomeTable, DomeSpec),
    "ring": (RingTable, RingSpec),
    "survey": (SurveyTable, SurveySpec),
    "poses": (PosesTable, PosesSpec),
}
"""Table and spec of each kind of cameras."""


class SelectTable(StrictModel):
    """Table ``[[select]]``: patterns of the names of objects, and a box in the frame and unit of their file."""

    class_name: _Pattern | None = Field(default=None, alias="class")
    global_id: _Pattern | None = None
    name: _Pattern | None = None
    host: _Pattern | None = None
    storey: _Pattern | None = None
    layer: _Pattern | None = None
    box: _Box | None = None

    def selection(self) -> Selection:
        """Return the table as a selection, with the lower corner of its box first."""
        values = self.model_dump(by_alias=True)
        patterns = tuple((key, values[key]) for key in KEYS if values[key] is not None)
        if self.box is None:
            return Selection(patterns)
        (x0, x1), (y0, y1), (z0, z1) = (sorted(pair) for pair in zip(*self.box, strict=True))
        return Selection(patterns, ((x0, y0, z0), (x1, y1, z1)))


class FormTable(StrictModel):
    """Table ``[[form]]``: face of a sheet of formwork with its middle ``point_m``, world frame, metres."""

    name: Annotated[str, _FORM_NAME] = ""
    point_m: _Point = Field(alias="point")
    normal: _Direction
    size_m: _FormSize = Field(alias="size")
    along: _Direction | None = None

    @field_validator("along")
    @classmethod
    def _check_along(cls, along: Triple, info: ValidationInfo[_Context]) -> Triple:
        normal = info.data.get("normal")
        if normal is not None and abs(sum(map(mul, _unit(normal), _unit(along)))) > _MAX_COSINE:
            raise field_error(f"got {list(along)}", "a direction that is not that of normal", "conflict")
        return along

    def spec(self, number: int) -> FormSpec:
        """Return the form; ``number`` is that of its table, which names it by default."""
        x, y, z = normal = _unit(self.normal)
        along = _unit(self.along or ((-y, x, 0.0) if abs(z) < _MAX_COSINE else (1.0, 0.0, 0.0)))
        off = sum(map(mul, normal, along))
        in_face = _unit((along[0] - off * x, along[1] - off * y, along[2] - off * z))
        return FormSpec(self.name or f"form-{number}", self.point_m, normal, in_face, self.size_m)


def _unit(direction: Triple) -> Triple:
    x, y, z = (round(value / math.hypot(*direction), METRE_DECIMALS) + 0.0 for value in direction)
    return x, y, z


class SceneToml(StrictModel):
    """Content of a scene TOML file, lengths in metres; None marks keys left to their defaults.

    ``board`` is the number of markers (0 or false: no board); a survey in ``cameras`` has no stations.
    """

    name: Annotated[str, SCENE_NAME] | None = None
    unit: Annotated[str, _UNIT] | None = None
    bar: Annotated[tuple[TomlBar, ...], Strict(False), _tables("bar", MAX_BARS)] = ()
    mesh: _File | None = None
    ifc: _File | None = None
    environment: Annotated[str, one_of(*SURROUNDINGS)] | None = None
    board: Annotated[int | bool, Expected("6, 12 or false", lambda markers: markers in (0, 6, 12))] | None = None
    cameras: _Trajectory | None = None
    rig: RigTable | None = None
    up: Annotated[Up, one_of("z", "y")] = "z"
    origin: Annotated[Origin, one_of("centre", "keep")] | None = None
    rotate_deg: Annotated[float, number(-360, 360, "degrees from -360 to 360")] = 0.0
    translate_m: _Point = Field(default=(0.0, 0.0, 0.0), alias="translate")
    select: Annotated[tuple[SelectTable, ...], Strict(False), _tables("select", _MAX_SELECTIONS)] = ()
    trust: Annotated[Trust, one_of("declared", "geometry")] = "declared"
    form: Annotated[tuple[FormTable, ...], Strict(False), _tables("form", _MAX_FORMS)] = ()

    @property
    def unit_m(self) -> float:
        """One file unit in metres; 1.0 if an IFC scene has no unit."""
        return _unit_m(self.unit)

    @property
    def placement(self) -> PlacementSpec:
        """Placement in metres."""
        origin: Origin = self.origin or ("keep" if self.bar else "centre")
        return PlacementSpec(self.up, origin, self.rotate_deg, self.translate_m)

    @property
    def selections(self) -> tuple[Selection, ...]:
        """Tables ``[[select]]`` in file order."""
        return tuple(table.selection() for table in self.select)

    @property
    def forms(self) -> tuple[FormSpec, ...]:
        """Forms in file order."""
        return tuple(table.spec(number) for number, table in enumerate(self.form, start=1))

    @field_validator("form")
    @classmethod
    def _check_forms(cls, tables: tuple[FormTable, ...]) -> tuple[FormTable, ...]:
        check_unique([table.spec(number).name for number, table in enumerate(tables, start=1)], "form")
        return tables

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str, info: ValidationInfo[_Context]) -> str:
        """Check that the name is not reserved."""
        if name in info.context.reserved:
            raise field_error(f"got {name!r}", f"none of the names {', '.join(info.context.reserved)}", "conflict")
        return name


def read_scene_toml(content: bytes, where: str, reserved: Collection[str] = ()) -> SceneToml:
    """Return the parsed content of a scene TOML file.

    ``where`` names the file in errors; ``reserved`` are names the scene may not have. Raises ``InputError`` that
    lists all problems: content that is not TOML, or keys that are missing, unknown, invalid or in conflict.
    """
    values, problems = parse_toml(content)
    if not problems:
        problems += _conflicts(values)
        context = _Context(_unit_m(values.get("unit")), reserved)
        if "cameras" in values:
            values["cameras"] = _read_cameras(values["cameras"], context, problems)
        scene = validate_table(SceneToml, values, problems, context=context)
        if scene is not None and not problems:
            return scene
    raise InputError.from_problems(where, problems)


def _unit_m(unit: object) -> float:
    return UNITS_M[unit] if isinstance(unit, str) and unit in UNITS_M else 1.0


def _read_cameras(values: object, context: _Context, problems: list[Problem]) -> _Trajectory | None:
    """Return the trajectory of the table ``[cameras]``, or None after adding its problems to ``problems``."""
    match values:
        case {"kind": str(kind)} if kind in _KINDS:
            model, spec = _KINDS[kind]
            table = validate_table(model, values, problems, "cameras", context)
            trajectory = None if table is None else spec(**table.model_dump())
            if trajectory is not None and (views := trajectory_of(asdict(trajectory)).views) > MAX_VIEWS:
                problems.append(Problem("conflict", "cameras", f"{views} views requested", f"at most {MAX_VIEWS}"))
            return trajectory
    validate_table(CamerasTable, values, problems, "cameras")
    return None


def _conflicts(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield the problems that concern several keys; values that are invalid alone are ignored."""
    if "unit" not in values and "ifc" not in values:
        yield Problem("missing", "unit", "missing", _UNIT.text)
    sources = [key for key in ("bar", "mesh", "ifc") if key in values]
    if len(sources) != 1:
        found = f"found {' and '.join(sources) or 'no bars'}"
        expected = "exactly one of [[bar]] tables, mesh and ifc"
        yield Problem("conflict" if sources else "missing", "", found, expected)
    if "trust" in values and "ifc" not in values:
        yield Problem("conflict", "trust", "only IFC files declare diameters", "ifc, or no trust")
    if "form" in values and values.get("board"):
        yield Problem("conflict", "board", "found beside [[form]] tables, which may hide it", "board = false")
    if "bar" in values and "select" in values:
        yield Problem("conflict", "select", "found beside [[bar]] tables", "mesh or ifc, or no [[select]] tables")
    for table_number, table in _numbered_tables(values, "select"):
        only_ifc = [key for key in table if key in KEYS and key not in _MESH_KEYS]
        where = f"select {table_number}"
        if not table:
            yield Problem("missing", where, "no key", f"one or more of {', '.join((*KEYS, 'box'))}")
        if "mesh" in values and only_ifc:
            found = f"{', '.join(only_ifc)} with a mesh"
            expected = f"{' or '.join(_MESH_KEYS)}: parts of a mesh have no other names"
            yield Problem("conflict", where, found, expected)
    yield from _row_conflicts(values)


def _row_conflicts(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield the problems of rows of bars: too many bars, keys without each other, and ids of several bars."""
    row_of_id, bars = dict[int, str](), 0
    for table_number, table in _numbered_tables(values, "bar"):
        where, first_id, in_row = f"bar {table_number}", table.get("id"), table.get("count")
        if not isinstance(in_row, int) or not 1 <= in_row <= MAX_BARS:
            in_row = 1
        bars += in_row
        if bars > MAX_BARS:
            yield Problem("conflict", where, f"{bars} bars with those before it", f"at most {MAX_BARS}")
            return
        for key in {"count", "step"} - table.keys() if in_row > 1 or "step" in table else ():  # One at most.
            yield Problem("missing", f"{where}: {key}", "missing", "count and step = [x, y, z] of a row")
        if type(first_id) is int and 1 <= first_id <= MAX_BARS:
            ids = range(first_id, first_id + in_row)
            if ids[-1] > MAX_BARS:
                yield Problem("conflict", f"{where}: id", f"the ids end at {ids[-1]}", f"at most {MAX_BARS}")
            for taken in sorted(row_of_id.keys() & ids)[:1]:
                found = f"{taken} is the id of {row_of_id[taken]}"
                yield Problem("duplicate", f"{where}: id", found, "a unique id")
            row_of_id |= {bar_id: where for bar_id in ids if bar_id not in row_of_id}


def _numbered_tables(values: Mapping[str, Any], key: str) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Yield the tables under the heading of ``key`` with their numbers in the file."""
    tables = values.get(key)
    for table_number, table in enumerate(tables if isinstance(tables, list) else (), start=1):
        if isinstance(table, dict):
            yield table_number, table
