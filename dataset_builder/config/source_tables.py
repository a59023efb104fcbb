"""Keys of a scene TOML file about the file that it names: selected objects and placement.

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
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import Field, Strict

from dataset_builder.config.file_specs import Origin, Trust, Up
from dataset_builder.scene.selection import KEYS, Selection
from rebar_depth_bench.errors import Problem
from rebar_depth_bench.validation import Expected, StrictModel, Triple, number, one_of, text, three_numbers

MAX_SELECTIONS = 100
_MESH_KEYS = ("name", "box")
_Pattern = Annotated[str, text(200, 'a name or a glob pattern such as "Level 1*"')]
_Corner = Annotated[Triple, three_numbers(-1e12, 1e12, "three numbers from -1e12 to 1e12, [x, y, z]")]

UpKey = Annotated[Up, one_of("z", "y")]
OriginKey = Annotated[Origin, one_of("centre", "keep")]
TrustKey = Annotated[Trust, one_of("declared", "geometry")]
RotationKey = Annotated[float, number(-360, 360, "degrees from -360 to 360")]
TranslationKey = Annotated[Triple, three_numbers(-1e9, 1e9, "three numbers from -1e9 to 1e9, [x, y, z]")]


class SelectTable(StrictModel):
    """Table ``[[select]]``: patterns of the names of objects, and a box in the frame and unit of their file."""

    class_name: _Pattern | None = Field(None, alias="class")
    global_id: _Pattern | None = None
    name: _Pattern | None = None
    host: _Pattern | None = None
    storey: _Pattern | None = None
    layer: _Pattern | None = None
    box: (
        Annotated[
            tuple[_Corner, _Corner], Strict(False), Expected("two corners, [[x, y, z], [x, y, z]], in any order")
        ]
        | None
    ) = None

    def selection(self) -> Selection:
        """Return the table as a selection, with the lower corner of its box first."""
        values = self.model_dump(by_alias=True)
        patterns = tuple((key, values[key]) for key in KEYS if values[key] is not None)
        if self.box is None:
            return Selection(patterns)
        (x0, y0, z0), (x1, y1, z1) = self.box
        return Selection(
            patterns, ((min(x0, x1), min(y0, y1), min(z0, z1)), (max(x0, x1), max(y0, y1), max(z0, z1)))
        )


def selection_conflicts(values: Mapping[str, Any]) -> Iterator[Problem]:
    """Yield the problems of the keys ``select`` and ``trust`` of a scene file together with its other keys."""
    if "trust" in values and "ifc" not in values:
        yield Problem("conflict", "trust", "only IFC files declare diameters", "ifc, or no trust")
    tables = values.get("select")
    if "bar" in values and tables is not None:
        yield Problem("conflict", "select", "found beside [[bar]] tables", "mesh or ifc, or no [[select]] tables")
    for table_number, table in enumerate(tables if isinstance(tables, list) else (), start=1):
        keys = table if isinstance(table, dict) else {"name": ""}
        where = f"select {table_number}"
        if not keys:
            yield Problem("missing", where, "no key", f"one or more of {', '.join((*KEYS, 'box'))}")
        only_ifc = [key for key in keys if key in KEYS and key not in _MESH_KEYS]
        if "mesh" in values and only_ifc:
            found = f"{', '.join(only_ifc)} with a mesh"
            yield Problem(
                "conflict", where, found, f"{' or '.join(_MESH_KEYS)}: parts of a mesh have no other names"
            )
