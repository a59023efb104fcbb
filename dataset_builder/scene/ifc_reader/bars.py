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
from itertools import pairwise
from textwrap import shorten
from typing import Any

import numpy as np
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.ifc_reader.bodies import (
    BodyItem,
    axis_placement,
    body_items,
    placement_matrix,
    point_xyz,
    type_objects,
    unit_vector,
)
from dataset_builder.scene.ifc_reader.curves import ARC_STEP_DEG, Leg, Piece, curve_pieces, cut
from dataset_builder.scene.ifc_reader.model import (
    Entity,
    Model,
    angle_unit_rad,
    item_mesh,
    length_unit_m,
    open_model,
)
from dataset_builder.scene.ifc_reader.objects import (
    DAMAGE,
    Declared,
    LeftOut,
    Relations,
    choose_objects,
    declared_sizes,
    left_out_object,
    role,
    shown,
)
from dataset_builder.scene.model import MAX_BARS
from dataset_builder.scene.selection import Selection
from dataset_builder.scene.shapes.bending import bent_line_m, without_repeats
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


_FOOT_M = 0.3048
_SAME_PARAMETER = 1e-6
"""Largest relative difference of parameters that are taken to be equal."""

_CLOSED_GAP = 0.25
"""Largest gap between two segments that is closed, in diameters."""

_NOTED_GAP = 0.01
"""Smallest gap between two segments that is noted when it is closed, in diameters."""

_OBLIQUE = 1e-6
"""Smallest 1 - cos of the angle between an extrusion and its circle's axis that makes it no bar."""


@dataclass(frozen=True)
class Units:
    """Units of a project: length in metres, plane angle in radians."""

    length_m: float
    angle_rad: float


@dataclass(frozen=True, eq=False)
class Sweep:
    """Circle swept along an axis, in the frame and unit of its file; ``notes`` are pairs of a code and a text."""

    axis: Float64[ndarray, "n 3"]
    diameter: float
    notes: tuple[tuple[str, str], ...] = ()


def read_sweep(solid: Any, units: Units) -> Sweep | None:
    """Return the sweep that a solid is, or None if it is not the sweep of a circle.

    Raises ``ValueError`` if an IfcSweptDiskSolid has a curve that is not supported, degenerate or not connected,
    or has parameters that are not on the curve.
    """
    if solid.is_a("IfcSweptDiskSolid"):
        return _swept_disc(solid, units)
    if solid.is_a() == "IfcExtrudedAreaSolid" and solid.SweptArea.is_a("IfcCircleProfileDef"):
        return _extruded_circle(solid)
    return None


def _swept_disc(solid: Any, units: Units) -> Sweep:
    diameter = 2 * float(solid.Radius)
    notes = _hollow_note(solid.InnerRadius)
    whole = curve_pieces(solid.Directrix, units.angle_rad)
    pieces = _swept_pieces(solid, whole, units.length_m)
    line, gap = _joined(pieces, diameter)
    axis = _drop_repeated_points(line)
    if gap > _NOTED_GAP * diameter:
        notes += (("gap", f"closed a gap of {gap / diameter:.0%} of the diameter between two segments"),)
    if pieces is not whole:
        share = _length(axis) / sum(_length(piece.points()) for piece in whole)
        found = f"the curve is swept from {solid.StartParam} to {solid.EndParam}, {share:.1%} of its length"
        notes += (("cut", found),)
    if solid.is_a("IfcSweptDiskSolidPolygonal") and solid.FilletRadius:
        axis = bent_line_m(axis, solid.FilletRadius, ARC_STEP_DEG)
    return Sweep(axis, diameter, notes)


def _hollow_note(inner_radius: float | None) -> tuple[tuple[str, str], ...]:
    return (("hollow", "a hollow bar is taken to be solid"),) if inner_radius else ()


def _extruded_circle(solid: Any) -> Sweep | None:
    """Return the bar of a circle that is extruded along its axis, or None if it is extruded obliquely."""
    profile, along = solid.SweptArea, unit_vector(solid.ExtrudedDirection)
    if 1 - abs(along[2]) > _OBLIQUE:
        return None
    start = np.array((0.0, 0.0, 0.0) if profile.Position is None else point_xyz(profile.Position.Location))
    matrix = np.eye(4) if solid.Position is None else axis_placement(solid.Position)
    ends = np.array([start, start + float(solid.Depth) * along]) @ matrix[:3, :3].T + matrix[:3, 3]
    notes = _hollow_note(getattr(profile, "WallThickness", None))
    return Sweep(_drop_repeated_points(ends), 2 * float(profile.Radius), notes)


def _swept_pieces(solid: Any, pieces: list[Piece], unit_m: float) -> list[Piece]:
    """Return ``pieces`` itself if the whole curve is swept, else the swept part of them.

    Programs disagree about the parameters of an IfcSweptDiskSolid that mean the whole curve. These do, each within
    a millionth: none; 0 to the number of segments; 0 to 1; 0 to the sum of the pieces' parameter ranges (ISO
    10303-42: a leg of a polyline counts 1, a trimmed line its length over the vector's magnitude, an arc its angle
    in the project's unit), also with legs counted by their length in the file's unit or in feet; an end beyond the
    largest of these. Any other parameters cut the curve: they count as in the rule, or else in the first of the
    other ways that ends at the end parameter, or at least reaches it.
    """
    start, end = float(solid.StartParam or 0.0), solid.EndParam
    by_rule = [piece.parameters for piece in pieces]
    if not sum(by_rule) > 0:
        raise ValueError("a curve has no length")
    counts = [
        by_rule,
        [piece.length if isinstance(piece, Leg) else piece.parameters for piece in pieces],
        [piece.length * unit_m / _FOOT_M if isinstance(piece, Leg) else piece.parameters for piece in pieces],
        [1.0] * len(pieces),
        [size / sum(by_rule) for size in by_rule],
    ]
    totals = [*map(sum, counts), float(len(getattr(solid.Directrix, "Segments", None) or pieces))]
    end = max(totals) if end is None else float(end)
    if not (np.isfinite([start, end]).all() and 0 <= start < end):
        raise ValueError(
            f"the disc is swept from {start} to {end}, expected from 0 or above to a larger parameter"
        )
    ends_at = [total for total in totals if abs(end - total) <= _SAME_PARAMETER * total]
    if start <= _SAME_PARAMETER * end and (ends_at or end > max(totals)):
        return pieces
    chosen = [count for count in counts if abs(end - sum(count)) <= _SAME_PARAMETER * end]
    chosen += [count for count in counts if end <= sum(count)]
    return cut(pieces, (chosen or counts)[0], start, end)


def _joined(pieces: list[Piece], diameter: float) -> tuple[Float64[ndarray, "k 3"], float]:
    """Return the pieces as one line with joints in the middle of gaps, and the largest gap.

    Raises ``ValueError`` if no piece is given or a gap is larger than ``_CLOSED_GAP`` diameters.
    """
    if not pieces:
        raise ValueError("the swept part of the curve is empty")
    lines = [np.array(piece.points(), np.float64) for piece in pieces]
    largest = 0.0
    for before, after in pairwise(lines):
        gap = float(np.linalg.norm(after[0] - before[-1]))
        if not gap <= _CLOSED_GAP * diameter:  # The negated comparison also catches NaN.
            raise ValueError(f"two segments of a curve are {gap:.6g} apart, expected at most a quarter of the "
                             f"diameter {diameter:.6g}")  # fmt: skip
        before[-1] = after[0] = before[-1] + (after[0] - before[-1]) / 2
        largest = max(largest, gap)
    return np.concatenate(lines), largest


def _length(line: Float64[ndarray, "n 3"]) -> float:
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _drop_repeated_points(points: Float64[ndarray, "n 3"]) -> Float64[ndarray, "k 3"]:
    """Return the points without those that equal their predecessor to a millionth of the curve's extent.

    Raises ``ValueError`` if fewer than two points remain or a point is not finite.
    """
    if len(points) < 2 or not np.isfinite(points).all():
        raise ValueError("a curve has fewer than two points, or a point that is not finite")
    distinct = without_repeats(points, 1e-6 * np.ptp(points, axis=0).max())
    if len(distinct) < 2:
        raise ValueError("a curve has no length")
    return distinct
