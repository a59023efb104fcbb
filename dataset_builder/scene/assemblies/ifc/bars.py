"""The bars of an IFC model: axes and diameters as modelled, world frame, metres.

Every IfcReinforcingBar is read, in the order of its instance number in the file; ids count from 1. Each
IfcSweptDiskSolid in its Body, directly or through IfcMappedItem, is one bar: some programs write a whole row of
bars as one object. Its axis is the directrix (polylines, indexed curves of lines and arcs, composite curves of
these and of trimmed lines and circles), its diameter twice the disc's radius. An object with anything else in its
Body is tessellated; each connected surface is then a bar, with the straight axis and the diameter of
``estimate_bar`` and the role "imported". Other reinforcement (IfcReinforcingMesh, IfcTendon) and everything else
is left out.

The project's coordinates are the world's; a context's own coordinate system and a map projection do not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from textwrap import shorten

import numpy as np
import trimesh
from jaxtyping import Float64
from numpy import ndarray

from dataset_builder.scene.assemblies.cage_assembly import CageBar
from dataset_builder.scene.assemblies.ifc.geometry import directrix, mapped_matrix, placement_matrix
from dataset_builder.scene.assemblies.ifc.model import Entity, Model, angle_unit_rad, length_unit_m, open_model
from dataset_builder.scene.assemblies.ifc.tessellation import meshes_of
from dataset_builder.scene.assemblies.mesh_file import estimate_bar
from dataset_builder.scene.model import MAX_BARS, Bar, Mesh
from rebar_depth_bench.errors import MeshError

ROLES = {"LIGATURE": "stirrup"}
"""What a PredefinedType is called where its name in small letters would not say it."""

_NO_TYPE = ("USERDEFINED", "NOTDEFINED", None, "")
_PICOMETRES = 12
_MAX_ITEMS = 10_000
"""In one object's body, maps within maps counted each time; a file of a few lines may ask for billions."""


@dataclass(frozen=True, eq=False)
class _Shape:
    """What is known of a bar before it has its id: its axis (world, metres) and diameter, or else its surface."""

    of: Entity
    axis_m: Float64[ndarray, "n 3"] | None = None
    diameter_m: float = 0.0
    mesh: Mesh | None = None


def ifc_bars(content: bytes, where: str) -> list[CageBar]:
    """Return the bars of an IFC file's ``content``; ``where`` names it in messages.

    Raises ``MeshError`` where the file is no whole IFC file, tells no length unit, holds no reinforcing bar or one
    of which nothing can be made (its GlobalId is named); ``InputError`` where ifcopenshell is not installed.
    """
    model = open_model(content, where)
    objects = sorted(model.by_type("IfcReinforcingBar"), key=lambda entity: int(entity.id()))
    if not objects:
        raise MeshError(f"{where}: holds no IfcReinforcingBar{_what_else(model)}, expected at least one")
    unit_m, angle_rad = length_unit_m(model, where), angle_unit_rad(model)
    shapes: dict[int, list[_Shape]] = {}
    reasons: dict[int, str] = {}
    for entity in objects:
        try:
            shapes[entity.id()] = _swept(entity, unit_m, angle_rad)
        except Exception as error:  # whatever a half-filled instance makes of the attributes that are asked for
            reasons[entity.id()] = shorten(str(error), 200) or type(error).__name__
    shapes |= _surfaces(content, where, [entity for entity in objects if entity.id() in reasons], reasons)
    every = [shape for entity in objects for shape in shapes[entity.id()]]
    if len(every) > MAX_BARS:
        raise MeshError(f"{where}: {len(every)} bars found, expected at most {MAX_BARS}")
    return [_cage_bar(bar_id, shape, where) for bar_id, shape in enumerate(every, start=1)]


def _what_else(model: Model) -> str:
    """Return a note on the reinforcement that is there and not read."""
    others = [name for name in ("IfcReinforcingMesh", "IfcTendon") if model.by_type(name)]
    return f" ({' and '.join(others)} are not read)" if others else ""


def _swept(entity: Entity, unit_m: float, angle_rad: float) -> list[_Shape]:
    """Return one shape for each swept disc of the object; raise an error where it has other things in it."""
    world_from_object = placement_matrix(entity.ObjectPlacement)
    shapes = []
    for solid, object_from_solid, scale in _solids(_body_items(entity)):
        matrix = world_from_object @ object_from_solid
        axis = directrix(solid, angle_rad) @ matrix[:3, :3].T + matrix[:3, 3]
        diameter_m = round(2 * float(solid.Radius) * scale * unit_m, _PICOMETRES)
        shapes.append(_Shape(entity, np.round(axis * unit_m, _PICOMETRES), diameter_m))
    if not shapes:
        raise ValueError("the body is empty")
    return shapes


def _body_items(entity: Entity) -> list[Entity]:
    """Return the items of the object's Body, or of all its representations where none is called so."""
    representations = entity.Representation.Representations
    bodies = [one for one in representations if one.RepresentationIdentifier == "Body"] or representations
    return [item for body in bodies for item in body.Items]


def _solids(items: list[Entity]) -> Iterator[tuple[Entity, Float64[ndarray, "4 4"], float]]:
    """Yield every swept disc with its ``object_from_solid`` and scale, in order, through maps within maps."""
    maps: dict[int, tuple[Float64[ndarray, "4 4"], float, list[Entity]]] = {}
    waiting = [(item, np.eye(4), 1.0) for item in reversed(items)]
    for _ in range(_MAX_ITEMS):
        if not waiting:
            return
        item, matrix, scale = waiting.pop()
        if item.is_a("IfcMappedItem"):
            if item.id() not in maps:
                inside = item.MappingSource.MappedRepresentation.Items
                maps[item.id()] = (*mapped_matrix(item), list(reversed(inside)))
            mapped, factor, inner = maps[item.id()]
            waiting += [(one, matrix @ mapped, scale * factor) for one in inner]
        elif item.is_a("IfcSweptDiskSolid"):
            yield item, matrix, scale
        else:
            raise ValueError(f"the body is a {item.is_a()}")
    raise ValueError(f"the body has more than {_MAX_ITEMS} items, or maps that go round in a circle")


def _surfaces(
    content: bytes, where: str, objects: list[Entity], reasons: dict[int, str]
) -> dict[int, list[_Shape]]:
    """Return the connected surfaces of ``objects`` by instance number; ``reasons`` are why they are not swept."""
    found: dict[int, list[_Shape]] = {}
    if not objects:
        return found
    ids = [entity.id() for entity in objects]
    for entity, mesh in zip(objects, meshes_of(content, where, ids), strict=False):
        if isinstance(mesh, str):
            raise MeshError(
                f"{where}: {_label(entity)} has no shape that can be read: {reasons[entity.id()]}; "
                f"tessellated: {mesh}; expected an IfcSweptDiskSolid along lines and arcs, or another solid"
            )
        found[entity.id()] = [_Shape(entity, mesh=part) for part in _connected(mesh)]
    return found


def _connected(mesh: Mesh) -> list[Mesh]:
    """Return the connected parts of a surface, in the order of their first triangles."""
    edges = trimesh.geometry.faces_to_edges(mesh.faces)
    labels = trimesh.graph.connected_component_labels(edges, node_count=len(mesh.vertices_m))[mesh.faces[:, 0]]
    parts = []
    for label in dict.fromkeys(labels.tolist()):
        used, faces = np.unique(mesh.faces[labels == label], return_inverse=True)
        parts.append(Mesh(mesh.vertices_m[used], faces.reshape(-1, 3).astype(np.int32)))
    return parts


def _cage_bar(bar_id: int, shape: _Shape, where: str) -> CageBar:
    label = f"bar {bar_id}, {_label(shape.of)}"
    if shape.mesh is not None:
        try:
            return CageBar(label, estimate_bar(bar_id, shape.mesh), mesh=shape.mesh)
        except ValueError as error:
            raise MeshError(f"{where}: {label}: is no solid ({error}), expected a bar") from error
    assert shape.axis_m is not None
    axis_m = tuple((x, y, z) for x, y, z in shape.axis_m.tolist())
    return CageBar(label, Bar(bar_id, _role(shape.of), shape.diameter_m, axis_m))


def _label(entity: Entity) -> str:
    return f"IfcReinforcingBar {entity.GlobalId} (#{entity.id()})"


def _role(entity: Entity) -> str:
    """Return what the bar does: its or its type's PredefinedType (BarRole in IFC2x3), else its words for it."""
    for source in (entity, *_types(entity)):
        kind = getattr(source, "PredefinedType", None) or getattr(source, "BarRole", None)
        if kind not in _NO_TYPE:
            return ROLES.get(kind, str(kind).lower())
    words = " ".join(str(entity.ObjectType or entity.Name or "").split())
    return words[:60] or "bar"


def _types(entity: Entity) -> list[Entity]:
    relations = [*(getattr(entity, "IsTypedBy", None) or ()), *(getattr(entity, "IsDefinedBy", None) or ())]
    return [relation.RelatingType for relation in relations if relation.is_a("IfcRelDefinesByType")]
