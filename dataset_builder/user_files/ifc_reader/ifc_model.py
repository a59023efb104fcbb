"""IFC models: opening with checks of completeness, and the check of single instances.

The parser skips what it cannot read and goes on, which could place a bar wrongly without an error. It turns an
attribute that it cannot parse, and a reference to an instance that it could not read, into null or drops it from a
list. So each instance that a bar depends on is written again and compared with its text (``Model``). The types of
its attributes and the dimensions of its points are checked too, since the geometry kernel replaces missing
coordinates by zero.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from textwrap import shorten
from typing import Any

import ifcopenshell
import numpy as np
from ifcopenshell import entity_instance, ifcopenshell_wrapper

from dataset_builder.user_files.ifc_reader.step_text import (
    StepText,
    class_name,
    same_tokens,
    split_arguments,
    tokens,
)
from rebar_depth_bench.base.errors import MeshError, escape_text
from rebar_depth_bench.base.reading import decode_text

Entity = Any
"""An ``ifcopenshell.entity_instance``, with the attributes of its IFC class."""

_wrapper: Any = ifcopenshell_wrapper
_LOGGED_REASON = re.compile(r"\] (?!Pars)[A-Za-z]")
"""Message in the parser's log that gives a reason, after severity and time; out of memory, it may be cut off."""

_UNUSED = {
    *("ContextOfItems", "Dimensions", "ProfileName", "RepresentationType", "SelfIntersect", "TagList"),
    "Transition",
}
"""Attributes without influence on the shape of a bar, which are neither checked nor followed."""

_MAY_BE_NULL = {
    *("BarRole", "EndParam", "GlobalId", "NominalDiameter", "PredefinedType", "StartParam", "UnitsInContext"),
    *("LongitudinalBarNominalDiameter", "TransverseBarNominalDiameter"),
}
"""Attributes that a version of IFC requires, that exporters leave out, and that the reader can do without."""

_DIMENSION: dict[str, int | None] = {
    **dict.fromkeys(["IfcAxis2Placement2D", "IfcCartesianTransformationOperator2D", "IfcCartesianPointList2D"], 2),
    **dict.fromkeys(["IfcCartesianTransformationOperator3D", "IfcCartesianTransformationOperator3DnonUniform"], 3),
    **dict.fromkeys(["IfcAxis1Placement", "IfcAxis2Placement3D", "IfcCartesianPointList3D", "IfcPolyLoop"], 3),
    **dict.fromkeys(["IfcExtrudedAreaSolid", "IfcRevolvedAreaSolid", "IfcVertexPoint"], 3),
    **dict.fromkeys(["IfcPolyline", "IfcIndexedPolyCurve", "IfcLine", "IfcVector", "IfcTrimmedCurve"]),
    **dict.fromkeys(["IfcCircle", "IfcEllipse", "IfcCompositeCurve", "IfcCompositeCurveSegment"]),
    **dict.fromkeys(["IfcBSplineCurveWithKnots", "IfcRationalBSplineCurveWithKnots", "IfcSweptDiskSolid"]),
    **dict.fromkeys(["IfcSweptDiskSolidPolygonal"]),
}
"""Dimension of the points below instances of a class; None: that of its first point."""

_PYTHON_TYPES: dict[str, tuple[type, ...]] = {
    "string": (str,),
    "binary": (str,),
    "integer": (int,),
    "real": (int, float),  # Some exporters write 5 in place of 5.
    "number": (int, float),
    "boolean": (bool,),
    "logical": (bool, str),
}


def open_model(content: bytes) -> Model:
    """Return the model of a STEP file's ``content``.

    Raises ``MeshError`` if the file is not a complete IFC file: truncated, of an unknown schema, with text that
    is not an instance, or with instances that the parser cannot read; ``MemoryError`` at the limit of memory.
    """
    text, problems = decode_text(content)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise MeshError(str(problems[0]))
    text = text or content.decode("utf-8", errors="replace")  # Some programs write Latin-1.
    step = StepText(text)
    try:
        file = ifcopenshell.file.from_string(text)
        schema = str(file.schema_identifier)
        read = np.array(sorted(file.entity_names()), np.int64)
    except MemoryError:
        raise
    except Exception as error:
        reason = shorten(str(error), 200) or type(error).__name__
        raise MeshError(f"not a readable IFC file ({reason})") from error
    unread = np.setdiff1d(step.numbers, read).tolist()
    if unread and not _LOGGED_REASON.search(ifcopenshell.get_log()):
        raise MemoryError  # The parser swallows a failed allocation; it logs any other reason.
    known = _wrapper.schema_by_name(schema)
    _check_unread(step, unread, known)
    return Model(file, known, step)


def _check_unread(step: StepText, unread: list[int], schema: Any) -> None:
    """Raise ``MeshError`` if the parser left out an instance that may be a bar.

    Some programs write classes of another version of IFC, which are left out. A name that no version has may be
    a damaged one.
    """
    others = [_wrapper.schema_by_name(name) for name in _wrapper.schema_names() if name.startswith("IFC")]
    for number in unread:
        name = class_name(step.instance(number))
        if _has_class(schema, name) or not any(_has_class(other, name) for other in others):
            raise MeshError(
                f"{len(unread)} of its instances cannot be read, first #{number} ({escape_text(name)}), expected "
                f"a complete {schema.name()} file"
            )


def _has_class(schema: Any, name: str) -> bool:
    try:
        schema.declaration_by_name(name)
    except RuntimeError:
        return False
    return True


@dataclass(frozen=True)
class _Attribute:
    """Attribute of a class: position, name, type as text, and whether a value is valid; None: any value."""

    index: int
    name: str
    kind: str
    accepts: Callable[[Any], bool] | None


class Model:
    """IFC model: ifcopenshell's ``file``, and the comparison of its instances with the text of the file.

    The methods that check raise ``MeshError``.
    """

    def __init__(self, file: Any, schema: Any, step: StepText) -> None:
        self.file, self._schema, self._step = file, schema, step
        self._attributes: dict[tuple[str, tuple[str, ...]], list[_Attribute]] = {}
        self._checked: set[tuple[int, tuple[str, ...]]] = set()
        self._seen: set[int] = set()
        self._dimensions: dict[int, frozenset[int]] = {}

    def by_type(self, name: str) -> list[Entity]:
        """Return the instances of a class and its subclasses, by number."""
        return sorted(self.file.by_type(name), key=lambda entity: int(entity.id()))

    def check_attributes(self, entity: Entity, *names: str) -> None:
        """Check the attributes ``names`` of an instance, or all, once; a class may lack some of the names.

        A relation is checked for each of the objects that it holds, which may be all bars of a model.
        """
        if (entity.id(), names) not in self._checked:
            self._checked_references(entity, names)
            self._checked.add((entity.id(), names))

    def _checked_references(self, entity: Entity, names: tuple[str, ...]) -> list[Entity]:
        """Check the attributes ``names`` of an instance, or all; return the instances that they refer to."""
        used = self._used_attributes(entity.is_a(), names)
        source, written = self._step.instance(entity.id()), entity.to_string(True).partition("=")[2]
        if source != written:
            self._compare(entity, used, source, written)
        references: list[Entity] = []
        for attribute in used:
            value = entity.get_argument(attribute.index)
            assert attribute.accepts
            if not attribute.accepts(value):
                found = "null" if value is None else escape_text(shorten(str(value), 60))
                raise MeshError(f"{_where(entity, attribute)} is {found}, expected {shorten(attribute.kind, 80)}")
            references += _references(value)
        return references

    def check_tree(self, root: Entity) -> None:
        """Check an instance and all instances that it refers to, directly or through others, each once."""
        stack: list[tuple[Entity, list[Entity] | None]] = [(root, None)]
        while stack:
            entity, references = stack.pop()
            if references is not None:
                self._dimensions[entity.id()] = self._dimensions_below(entity, references)
            elif entity.id() not in self._seen:
                self._seen.add(entity.id())
                references = self._checked_references(entity, ())
                stack.append((entity, references))  # It is completed after the instances below it.
                stack += [(reference, None) for reference in references]

    def _dimensions_below(self, entity: Entity, references: list[Entity]) -> frozenset[int]:
        """Return the numbers of coordinates of the points and directions that define an instance.

        The set is empty for classes whose points are in several spaces.
        """
        name = entity.is_a()
        if name in ("IfcCartesianPoint", "IfcDirection"):
            size = len(entity.get_argument(0))
            if size not in (2, 3):
                raise MeshError(f"#{entity.id()} ({name}) has {size} coordinates, expected 2 or 3")
            return frozenset((size,))
        if name not in _DIMENSION:
            return frozenset()
        sizes: frozenset[int] = frozenset().union(
            *(self._dimensions.get(reference.id(), ()) for reference in references)
        )
        expected = _DIMENSION[name]
        if len(sizes) > 1 or (expected and sizes - {expected}):
            found = " and ".join(map(str, sorted(sizes)))
            raise MeshError(
                f"#{entity.id()} ({name}) refers to points of {found} coordinates, "
                f"expected {expected or 'one kind'}"
            )
        return frozenset((expected,)) if expected else sizes

    def _compare(self, entity: Entity, used: list[_Attribute], source: str, written: str) -> None:
        """Raise ``MeshError`` if used attributes of an instance differ between its text and what was read."""
        given_tokens, read_tokens = tokens(source), tokens(written)
        if given_tokens and same_tokens(given_tokens, read_tokens):
            return
        given, read = split_arguments(given_tokens), split_arguments(read_tokens)
        attributes = len(read)
        # Lists of points have the attribute TagList in IFC4x3 only; exporters mix the versions up.
        if entity.is_a() in ("IfcCartesianPointList2D", "IfcCartesianPointList3D"):
            given, read = given[:1], read[:1]
        if class_name(source) != class_name(written) or not given or len(given) != len(read):
            raise MeshError(
                f"#{entity.id()} is {escape_text(source)}, expected {attributes} readable attributes of "
                f"{entity.is_a()}"
            )
        for attribute in used:
            if not same_tokens(given[attribute.index], read[attribute.index]):
                found = escape_text("".join(given[attribute.index]))
                raise MeshError(
                    f"{_where(entity, attribute)} is {found}, which cannot be read, "
                    f"expected {shorten(attribute.kind, 80)}"
                )

    def _used_attributes(self, name: str, names: tuple[str, ...]) -> list[_Attribute]:
        """Return the attributes ``names`` of a class, or all, that have an influence on a bar."""
        if (name, names) not in self._attributes:
            entity = self._schema.declaration_by_name(name).as_entity()
            declared = zip(entity.all_attributes(), entity.derived(), strict=True)
            attributes = [self._attribute(index, *one) for index, one in enumerate(declared)]
            used = (one for one in attributes if one.accepts and (not names or one.name in names))
            self._attributes[name, names] = list(used)
        return self._attributes[name, names]

    def _attribute(self, index: int, declared: Any, derived: bool) -> _Attribute:
        kind, name = declared.type_of_attribute(), str(declared.name())
        accepts = None if derived or name in _UNUSED else _predicate(kind)
        if accepts and (declared.optional() or name in _MAY_BE_NULL):
            accepts = _or_null(accepts)
        return _Attribute(index, name, str(kind), accepts)


def _where(entity: Entity, attribute: _Attribute) -> str:
    return f"#{entity.id()} ({entity.is_a()}): {attribute.name}"


def _references(value: Any) -> Iterator[Entity]:
    """Yield the numbered instances in an attribute's value."""
    for item in value if isinstance(value, tuple) else (value,):
        if isinstance(item, tuple):
            yield from _references(item)
        elif isinstance(item, entity_instance) and item.id():
            yield item


def _or_null(accepts: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or accepts(value)


def _predicate(kind: Any) -> Callable[[Any], bool]:
    """Return the function that tells whether a value is of an attribute's type."""
    while isinstance(kind, _wrapper.named_type | _wrapper.type_declaration):
        kind = kind.declared_type()
    if isinstance(kind, _wrapper.aggregation_type):
        accepts, low, high = _predicate(kind.type_of_element()), kind.bound1(), kind.bound2()
        return lambda value: (
            isinstance(value, tuple) and low <= len(value) and (high < 0 or len(value) <= high)
            and all(map(accepts, value))
        )  # fmt: skip
    if isinstance(kind, _wrapper.simple_type):
        types = _PYTHON_TYPES[kind.declared_type()]
        return lambda value: isinstance(value, types) and (bool in types or not isinstance(value, bool))
    if isinstance(kind, _wrapper.enumeration_type):
        return lambda value: isinstance(value, str)
    if isinstance(kind, _wrapper.select_type):
        members = dict(_select_members(kind))
        return lambda value: (
            isinstance(value, entity_instance) and value.is_a() in members and members[value.is_a()](value)
        )
    name = kind.name()
    return lambda value: isinstance(value, entity_instance) and value.is_a(name)


def _select_members(kind: Any) -> Iterator[tuple[str, Callable[[Any], bool]]]:
    """Yield the names of a select type's classes and value types, each with a test of its instances."""
    if isinstance(kind, _wrapper.select_type):
        for member in kind.select_list():
            yield from _select_members(member)
    elif isinstance(kind, _wrapper.entity):
        yield kind.name(), lambda _: True
        for subtype in kind.subtypes():
            yield from _select_members(subtype)
    else:
        accepts = _predicate(kind)
        yield kind.name(), lambda value: accepts(value.get_argument(0))
