"""Shapes of the reinforcement in an IFC model, as modelled: the project's frame, metres.

Every IfcReinforcingBar, IfcReinforcingMesh and IfcTendon is read, or every object that a selection chooses, in the
order of the instance numbers. Each sweep of a circle in its Body (``sweeps``), directly or through IfcMappedItem,
is one bar, since some programs write a whole row of bars as one object. Only other solids are tessellated, each
once for all of its uses. All other objects are left out.

The project's coordinates are world coordinates; a context's coordinate system and map projections are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from textwrap import shorten

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.ifc_reader.bodies import BodyItem, body_items, type_objects
from dataset_builder.scene.ifc_reader.declared import Declared, declared_sizes, role
from dataset_builder.scene.ifc_reader.model import Model, angle_unit_rad, item_mesh, length_unit_m, open_model
from dataset_builder.scene.ifc_reader.objects import DAMAGE, LeftOut, choose_objects, left_out_object, shown
from dataset_builder.scene.ifc_reader.placements import placement_matrix
from dataset_builder.scene.ifc_reader.relations import Relations
from dataset_builder.scene.ifc_reader.source_check import Entity
from dataset_builder.scene.ifc_reader.sweeps import Sweep, Units, read_sweep
from dataset_builder.scene.model import MAX_BARS
from dataset_builder.scene.selection import Selection
from rebar_depth_bench.errors import MeshError

MAX_POINTS = 20_000_000
"""Largest number of points of all axes and surfaces of a model, which maps can multiply: 480 MB."""


class ShapeError(MeshError):
    """Solid that the geometry kernel cannot tessellate; the message is the reason alone."""


@dataclass(frozen=True, eq=False)
class Source:
    """Object of a model: GlobalId, name in messages, what it declares about its bars, host and storey."""

    global_id: str
    label: str
    declared: Declared
    host: str | None
    storey: str | None


@dataclass(frozen=True, eq=False)
class SweptBar:
    """Bar with an axis: object, role, axis and diameter (the project's frame, metres), notes (code and text)."""

    source: Source
    role: str
    axis_m: Float64[ndarray, "n 3"]
    diameter_m: float
    notes: tuple[tuple[str, str], ...]


@dataclass(frozen=True, eq=False)
class Surface:
    """Tessellated solid, of one or several bars: object, vertices (the project's frame, metres), triangles."""

    source: Source
    vertices_m: Float64[ndarray, "v 3"]
    faces: Int32[ndarray, "f 3"]


@dataclass(frozen=True)
class Project:
    """Project of a model: its length unit, metres."""

    unit_m: float


Shape = SweptBar | Surface

KernelStep = Callable[[str, str], AbstractContextManager[object]]
"""Function of an object's name and a reason; its context is entered while the geometry kernel is used."""


def read_bars(
    content: bytes,
    select: Sequence[Selection] = (),
    kernel_step: KernelStep = lambda *_: nullcontext(),
) -> Iterator[Project | Shape | LeftOut]:
    """Yield the project of an IFC file's ``content``, the objects that are left out, and the shapes in its order.

    ``select`` chooses objects (``choose_objects``). ``kernel_step`` is called with an object's name and the reason
    why it has no axis, and entered while the geometry kernel tessellates a solid of it, which may hang or crash.

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit, nothing to read or too
    much of it, if a bar depends on an instance that was not read as written, or if it has no usable geometry;
    ``ShapeError`` if a solid cannot be tessellated.
    """
    model = open_model(content)
    relations = Relations(model)
    chosen, left_out = choose_objects(model, relations, select)
    for relation in model.by_type("IfcRelDefinesByType"):
        model.check.attributes(relation, "RelatedObjects", "RelatingType")
    reader = _Reader(model, relations, kernel_step)
    yield Project(reader.unit_m)
    yield from left_out
    outside = 0
    size = _Size()
    for item in chosen:
        shapes = reader.shapes(item.entity)
        for shape in shapes:
            size.add(shape.source.label, len(_points_m(shape)))
        points = np.concatenate([_points_m(shape) for shape in shapes]) / reader.unit_m
        if item.tables and not any(table.contains(points) for table in item.tables):
            outside += 1
            yield left_out_object(item.entity, "not inside the box of a [[select]] table")
        else:
            yield from shapes
    if outside == len(chosen):
        found = f"{outside} selected objects are not wholly inside"
        raise MeshError(f"no object is inside the box of a [[select]] table: {found}, expected one or more")


def _points_m(shape: Shape) -> Float64[ndarray, "n 3"]:
    return shape.axis_m if isinstance(shape, SweptBar) else shape.vertices_m


class _Size:
    """Number of shapes and of their points."""

    def __init__(self) -> None:
        self._shapes = self._points = 0

    def add(self, label: str, points: int) -> None:
        """Count a shape of the object ``label``; raise ``MeshError`` if there are too many shapes or points."""
        self._shapes, self._points = self._shapes + 1, self._points + points
        if self._shapes > MAX_BARS or self._points > MAX_POINTS:
            raise MeshError(
                f"{label}: {self._shapes} bars of {self._points} points up to this object, "
                f"expected at most {MAX_BARS} and {MAX_POINTS}"
            )


class _Reader:
    """Reader of a model's objects, which share placements and solids."""

    def __init__(self, model: Model, relations: Relations, kernel_step: KernelStep) -> None:
        self._model, self._relations, self._kernel_step = model, relations, kernel_step
        self._units = Units(length_unit_m(model), angle_unit_rad(model))
        self._placements: dict[int, Float64[ndarray, "4 4"]] = {}
        self._sweeps: dict[int, Sweep | None] = {}
        self._meshes: dict[int, tuple[Float64[ndarray, "v 3"], Int32[ndarray, "f 3"]]] = {}

    @property
    def unit_m(self) -> float:
        """The project's length unit, metres."""
        return self._units.length_m

    def shapes(self, entity: Entity) -> list[Shape]:
        """Return the shapes of an object; raise ``MeshError`` that names it."""
        label = _label(entity)
        try:
            types = self._checked_types(entity)
            source = Source(
                shown(entity.GlobalId),
                label,
                declared_sizes(self._model, entity, types, self._units.length_m),
                _name(self._relations.host(entity)),
                _name(self._relations.storey(entity)),
            )
            items = body_items(self._model, entity, types)
            world_from_object = placement_matrix(entity.ObjectPlacement, self._placements)
            sweeps = [self._sweep(item.item) for item in items]
        except MeshError as error:
            raise MeshError(f"{label}: {error}") from error
        except DAMAGE as error:
            reason = shorten(str(error), 400) or type(error).__name__
            raise MeshError(f"{label} has no readable shape: {reason}") from error
        shapes: list[Shape] = []
        size = _Size()
        for item, sweep in zip(items, sweeps, strict=True):
            matrix = world_from_object @ item.object_from_item
            shape = (
                self._surface(source, item, matrix)
                if sweep is None
                else self._bar(source, role(entity, types), sweep, matrix, item.scale)
            )
            size.add(label, len(_points_m(shape)))
            shapes.append(shape)
        return shapes

    def _checked_types(self, entity: Entity) -> list[Entity]:
        """Return the types of an object; raise ``MeshError`` unless its attributes were read as written."""
        check = self._model.check
        check.attributes(
            entity, *("GlobalId", "Name", "ObjectType", "ObjectPlacement", "Representation"),
            *("PredefinedType", "BarRole"),
        )  # fmt: skip
        if entity.ObjectPlacement is not None:
            check.tree(entity.ObjectPlacement)
        return type_objects(self._model, entity)

    def _sweep(self, solid: Entity) -> Sweep | None:
        if solid.id() not in self._sweeps:
            self._sweeps[solid.id()] = read_sweep(solid, self._units)
        return self._sweeps[solid.id()]

    def _bar(
        self, source: Source, bar_role: str, sweep: Sweep, matrix: Float64[ndarray, "4 4"], scale: float
    ) -> SweptBar:
        axis = sweep.axis @ matrix[:3, :3].T + matrix[:3, 3]
        unit_m = self._units.length_m
        return SweptBar(source, bar_role, axis * unit_m, sweep.diameter * scale * unit_m, sweep.notes)

    def _surface(self, source: Source, item: BodyItem, matrix: Float64[ndarray, "4 4"]) -> Surface:
        number = item.item.id()
        if number not in self._meshes:
            with self._kernel_step(source.label, f"the body is a {item.item.is_a()}"):
                self._meshes[number] = _tessellated(self._model, number)
        vertices_m, faces = self._meshes[number]
        if np.linalg.det(matrix[:3, :3]) < 0:  # A reflection turns the triangles inside out.
            faces = faces[:, ::-1]
        return Surface(source, vertices_m @ matrix[:3, :3].T + matrix[:3, 3] * self._units.length_m, faces)


def _tessellated(model: Model, number: int) -> tuple[Float64[ndarray, "v 3"], Int32[ndarray, "f 3"]]:
    """Return the surface of an item, metres; raise ``ShapeError`` if it cannot be tessellated."""
    try:
        vertices, faces = item_mesh(model, number)
    except RuntimeError as error:
        if "bad_alloc" in str(error):
            raise MemoryError from error
        raise ShapeError(str(error) or "the geometry kernel failed") from error
    if not len(faces):
        raise ShapeError("has no surface")
    return np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3)


def _name(entity: Entity | None) -> str | None:
    """Return the name of a host or storey, or its GlobalId if it has no name."""
    return None if entity is None else shown(entity.Name or entity.GlobalId)


def _label(entity: Entity) -> str:
    """Return the object's name in error messages: class, GlobalId and instance number."""
    return f"{entity.is_a()} {shown(entity.GlobalId)} (#{entity.id()})"
