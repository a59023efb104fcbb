"""Schema of the parts of glTF that affect surfaces, with the names of glTF."""

# ruff: noqa: N815

from __future__ import annotations

from operator import ne
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, Strict, model_validator

from rebar_depth_bench.errors import escape_text
from rebar_depth_bench.validation import Expected, StrictModel, field_error, one_of

COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
"""NumPy type of the components of an accessor, by its number in OpenGL."""

COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
"""Number of components of a value of an accessor, by its type."""

TRIANGLES = 4
"""Mode of a primitive of triangles."""

_Size = Annotated[int, Field(ge=0, le=1 << 53)]
_Index = Annotated[int, Field(ge=0)]
_Item = TypeVar("_Item")
_ListOf = Annotated[tuple[_Item, ...], Strict(False)]


class _Table(StrictModel, extra="ignore"):
    """Base class of the objects of glTF.

    Unknown keys are ignored, as its specification wants, except those that resemble a known one: a damaged
    ``mesh`` or ``byteOffset`` would leave out a part or move it.
    """

    name: str = ""
    extensions: Any = None
    extras: Any = None

    @model_validator(mode="before")
    @classmethod
    def _check_keys(cls, values: Any) -> Any:
        known = cls.model_fields.keys()
        for key in values.keys() - known if isinstance(values, dict) else ():
            similar = next((name for name in known if _differ_in_one_character(key, name)), None)
            if similar is not None:
                raise field_error(f"the key {escape_text(key)} is not known", similar, "unknown")
        return values


def _differ_in_one_character(key: str, name: str) -> bool:
    return len(key) == len(name) and sum(map(ne, key, name)) == 1


class _Asset(_Table):
    """Version of glTF."""

    version: Annotated[str, Expected('"2.0"', lambda version: version.partition(".")[0] == "2")]
    minVersion: Any = None
    copyright: Any = None
    generator: Any = None


class Buffer(_Table):
    """Buffer, whose data are in the binary chunk of a GLB file or in ``uri``."""

    byteLength: _Size
    uri: str | None = None


class _View(_Table):
    """Range of bytes of a buffer."""

    buffer: _Index
    byteLength: _Size
    byteOffset: _Size = 0
    byteStride: Annotated[int, Field(ge=1, le=252)] | None = None
    target: Any = None


class Accessor(_Table):
    """Array of values in a view."""

    componentType: Annotated[int, one_of(*COMPONENT_TYPES)]
    count: _Size
    type: Annotated[str, one_of(*COMPONENTS)]
    bufferView: _Index
    byteOffset: _Size = 0
    normalized: Any = None
    max: Any = None
    min: Any = None

    @property
    def item_bytes(self) -> int:
        """Return the size of a value."""
        return np.dtype(COMPONENT_TYPES[self.componentType]).itemsize * COMPONENTS[self.type]


class Primitive(_Table):
    """Triangles, lines or points with the accessors of their vertices."""

    attributes: dict[str, _Index]
    indices: _Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = TRIANGLES
    material: Any = None
    targets: Any = None


class _Mesh(_Table):
    """Mesh of one or more primitives."""

    primitives: _ListOf[Primitive]
    weights: Any = None


class _Node(_Table):
    """Node with a transform: a matrix, or translation, rotation and scale."""

    children: _ListOf[_Index] = ()
    mesh: _Index | None = None
    camera: _Index | None = None
    matrix: Annotated[_ListOf[float], Field(min_length=16, max_length=16)] | None = None
    translation: Annotated[_ListOf[float], Field(min_length=3, max_length=3)] | None = None
    rotation: Annotated[_ListOf[float], Field(min_length=4, max_length=4)] | None = None
    scale: Annotated[_ListOf[float], Field(min_length=3, max_length=3)] | None = None
    skin: Any = None
    weights: Any = None


class _Scene(_Table):
    """Root nodes."""

    nodes: _ListOf[_Index] = ()


class Tree(_Table):
    """Content of the JSON of a file; ``Any`` marks keys that do not affect surfaces."""

    asset: _Asset
    scene: _Index = 0
    scenes: _ListOf[_Scene] = ()
    nodes: _ListOf[_Node] = ()
    meshes: _ListOf[_Mesh] = ()
    accessors: _ListOf[Accessor] = ()
    bufferViews: _ListOf[_View] = ()
    buffers: _ListOf[Buffer] = ()
    extensionsRequired: _ListOf[str] = ()
    extensionsUsed: Any = None
    animations: Any = None
    cameras: Any = None
    images: Any = None
    materials: Any = None
    samplers: Any = None
    skins: Any = None
    textures: Any = None
