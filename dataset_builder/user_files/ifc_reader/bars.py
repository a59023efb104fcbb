"""Shapes of the reinforcement in an IFC model, as modelled: the project's frame, metres.

Every IfcReinforcingBar, IfcReinforcingMesh and IfcTendon is read, or every object that a selection chooses, in the
order of the instance numbers. Each sweep of a circle in its Body (an IfcSweptDiskSolid, a straight
IfcExtrudedAreaSolid or an IfcRevolvedAreaSolid), directly or through IfcMappedItem, is one bar, since programs
write a whole row of bars as one object; sweeps that continue each other are one bar. Only other solids are
tessellated, each once for all of its uses. All other objects are left out.

The project's coordinates are world coordinates; a context's coordinate system and map projections are ignored.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from textwrap import shorten

import numpy as np
from ifcopenshell import geom
from jaxtyping import Float64, Int32
from numpy import ndarray

from dataset_builder.scene.model import MAX_BARS
from dataset_builder.specs.file_specs import Selection
from dataset_builder.user_files.ifc_reader.bodies import BodyItem, body_items, placement_matrix
from dataset_builder.user_files.ifc_reader.ifc_model import Entity, Model, open_model
from dataset_builder.user_files.ifc_reader.objects import (
    DAMAGE,
    DIAMETERS,
    choose_objects,
    left_out_record,
    object_label,
    project_units,
    role,
    source_record,
    type_objects,
)
from dataset_builder.user_files.ifc_reader.sweeps import Sweep, joined_sweeps, read_sweep
from dataset_builder.user_files.ifc_records import (
    BarRecord,
    ProjectRecord,
    Record,
    StepRecord,
    SurfaceRecord,
)
from rebar_depth_bench.base.errors import MeshError

MAX_POINTS = 20_000_000
"""Largest number of points of all axes and surfaces of a model, which maps can multiply: 480 MB."""

_ATTRIBUTES = (
    *("GlobalId", "Name", "ObjectType", "PredefinedType", "BarRole", "BarLength", *DIAMETERS),
    *("ObjectPlacement", "Representation", "RepresentationMaps"),
)
"""Attributes of an object and of its types that the bars depend on."""

SECONDS_PER_SHAPE = 60
"""Time limit for tessellating one object; SIGALRM ends the process after it."""


_Arrays = tuple[ndarray, ...]
_Shape = tuple[BarRecord | SurfaceRecord, _Arrays]


def read_bars(content: bytes, select: Sequence[Selection] = ()) -> Iterator[tuple[Record, _Arrays]]:
    """Yield the records of an IFC file's ``content`` with their arrays, but for the last one of an answer.

    They are the project, the objects that are left out, and the shapes in the file's order, with a ``StepRecord``
    before the geometry kernel is used. ``select`` chooses objects (``choose_objects``).

    Raises ``MeshError`` if the file is not a complete IFC file, has no known length unit, nothing to read or too
    much of it, if a bar depends on an instance that is not as its class says, or if it has no usable geometry.
    """
    model = open_model(content)
    chosen, left_out = choose_objects(model, select)
    for relation in model.by_type("IfcRelDefinesByType"):
        model.check(relation, "RelatedObjects", "RelatingType")
    reader = _Reader(model)
    yield ProjectRecord(unit_m=reader.units.length_m), ()
    for record in left_out:
        yield record, ()
    outside = 0
    for entity, tables in chosen:
        shapes = yield from reader.shapes(entity)
        points = np.concatenate([arrays[0] for _, arrays in shapes]) / reader.units.length_m
        if tables and not any(table.contains(points) for table in tables):
            outside += 1
            yield left_out_record(entity, "not inside the box of a [[select]] table"), ()
        else:
            yield from shapes
    if outside == len(chosen):
        found = f"{outside} selected objects are not wholly inside"
        raise MeshError(f"no object is inside the box of a [[select]] table: {found}, expected one or more")


class _Reader:
    """Reader of a model's objects, which share placements and solids."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self.units = project_units(model)
        self._placements: dict[int, Float64[ndarray, "4 4"]] = {}
        self._sweeps: dict[tuple[int, float | None], Sweep | None] = {}
        self._meshes: dict[int, tuple[Float64[ndarray, "v 3"], Int32[ndarray, "f 3"]]] = {}
        self._num_shapes = self._num_points = 0

    def shapes(self, entity: Entity) -> Generator[tuple[StepRecord, _Arrays], None, list[_Shape]]:
        """Return the shapes of an object, after a step for each solid that is tessellated.

        Raises ``MeshError`` that names the object.
        """
        label = object_label(entity)
        try:
            types = type_objects(entity)
            for one in (entity, *types):
                self._model.check(one, *_ATTRIBUTES)
            if entity.ObjectPlacement is not None:
                self._model.check_tree(entity.ObjectPlacement)
            source = source_record(entity, types, self.units.length_m)
            bar_role = role(entity, types)
            items = body_items(self._model, entity, types)
            world_from_object = placement_matrix(entity.ObjectPlacement, self._placements)
            matrices = [world_from_object @ item.object_from_item for item in items]
            sweeps = [
                self._sweep(item, matrix, source.length_m) for item, matrix in zip(items, matrices, strict=True)
            ]
            bars = joined_sweeps(sweeps, [item.use for item in items], source.length_m)
        except MeshError as error:
            raise MeshError(f"{label}: {error}") from error
        except DAMAGE as error:
            reason = shorten(str(error), 400) or type(error).__name__
            raise MeshError(f"{label} has no readable shape: {reason}") from error
        shapes: list[_Shape] = []
        for number, (item, matrix) in enumerate(zip(items, matrices, strict=True)):
            if number in bars:
                sweep = bars[number]
                bar = BarRecord(
                    source=source,
                    notes=sweep.notes,
                    role=bar_role,
                    diameter_m=sweep.diameter,
                    points=len(sweep.axis),
                )
                shapes.append((bar, (sweep.axis,)))
            elif sweeps[number] is None:  # Others are joined to an earlier one.
                if item.item.id() not in self._meshes:
                    step = StepRecord(label=label, reason=f"the body is a {item.item.is_a()}")
                    yield step, ()
                    self._meshes[item.item.id()] = _tessellated(item.item, step)
                mesh_vertices_m, faces = self._meshes[item.item.id()]
                turn, origin = matrix[:3, :3], matrix[:3, 3]
                if np.linalg.det(turn) < 0:  # A reflection turns the triangles inside out.
                    faces = faces[:, ::-1]
                vertices_m = mesh_vertices_m @ turn.T + origin * self.units.length_m
                surface = SurfaceRecord(source=source, vertices=len(vertices_m), faces=len(faces))
                shapes.append((surface, (vertices_m, faces)))
                self._count(len(vertices_m), f"{label}: ")
        return shapes

    def _sweep(self, item: BodyItem, matrix: Float64[ndarray, "4 4"], declared_m: float | None) -> Sweep | None:
        """Return the sweep (world frame, metres) that an item is; ``matrix`` is ``world_from_item``."""
        unit_m = self.units.length_m
        key = item.item.id(), None if declared_m is None else declared_m / unit_m / item.scale
        if key not in self._sweeps:
            self._sweeps[key] = read_sweep(item.item, self.units, key[1])
        sweep = self._sweeps[key]
        if sweep is None:
            return None
        self._count(len(sweep.axis))
        return sweep.placed(matrix, item.scale, unit_m)

    def _count(self, num_points: int, where: str = "") -> None:
        """Count a shape; raise ``MeshError`` if there are too many shapes or points up to this one."""
        self._num_shapes, self._num_points = self._num_shapes + 1, self._num_points + num_points
        if self._num_shapes > MAX_BARS or self._num_points > MAX_POINTS:
            raise MeshError(
                f"{where}{self._num_shapes} bars of {self._num_points} points up to this object, "
                f"expected at most {MAX_BARS} and {MAX_POINTS}"
            )


def _tessellated(solid: Entity, step: StepRecord) -> tuple[Float64[ndarray, "v 3"], Int32[ndarray, "f 3"]]:
    """Return vertices (metres, frame of the solid) and triangles; the geometry kernel may hang or crash.

    Raises ``MeshError`` if the kernel cannot tessellate the solid, and ``MemoryError`` at the limit of memory.
    """
    settings = geom.settings()
    settings.set("mesher-linear-deflection", 1e-5)
    settings.set("mesher-angular-deflection", 0.15)
    try:
        with limited_time():
            mesh = geom.create_shape(settings, solid)
    except RuntimeError as error:
        if "bad_alloc" in str(error):
            raise MemoryError from error
        raise MeshError(step.failure(str(error) or "the geometry kernel failed")) from error
    if not len(mesh.faces):
        raise MeshError(step.failure("has no surface"))
    return np.array(mesh.verts, np.float64).reshape(-1, 3), np.array(mesh.faces, np.int32).reshape(-1, 3)


@contextmanager
def limited_time() -> Iterator[None]:
    """Let SIGALRM end the process after ``SECONDS_PER_SHAPE``, or at the end of its own time if that is sooner."""
    begin_s, left_s = time.monotonic(), signal.getitimer(signal.ITIMER_REAL)[0]
    signal.setitimer(signal.ITIMER_REAL, min(left_s or math.inf, SECONDS_PER_SHAPE))
    try:
        yield
    finally:
        used_s = time.monotonic() - begin_s
        signal.setitimer(signal.ITIMER_REAL, max(left_s - used_s, 1e-6) if left_s else 0)
