"""IFC models: opening with checks of completeness, and the check of the instances that a bar depends on.

The parser skips what it cannot read and goes on, which could place a bar wrongly without an error: a reference to
an instance that it could not read becomes null or is dropped from a list. It logs each of these errors, and a file
with one is refused. It only warns of instances with another number of attributes, which exporters that mix up
versions of IFC write, and accepts values of any type. So these are checked for what a bar depends on, like the
dimensions of points, since the geometry kernel replaces missing coordinates by zero.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from textwrap import shorten
from typing import Any

import ifcopenshell
from ifcopenshell import entity_instance, ifcopenshell_wrapper, validate

from rebar_depth_bench.base.errors import MeshError, escape_text
from rebar_depth_bench.base.reading import decode_text

Entity = Any
"""An ``ifcopenshell.entity_instance``, with the attributes of its IFC class."""

_wrapper: Any = ifcopenshell_wrapper

_FREE_TEXT = re.compile(r"'[^']*+(?:'|\Z)|/\*(?:[^*]++|\*(?!/))*+(?:\*/|\Z)")
"""Strings and comments; an open one reaches to the end of the text, so that a damaged text takes linear time."""

_MISREAD = [
    re.compile(pattern)  # One expression for all takes several times longer.
    for pattern in (
        r"[(,]\s*+,",
        r",\s*+\)",
        r"[$*]\s*+[^,)\s]",
        r"\s(?<=[\d.]\s)\s*+[\d.]",
        r"[(,]\s*+\(\s*+(?:(?:#\d++\s*+,\s*+)++[$*(]|(?:[$*]|\(\s*+\))\s*+,\s*+#)",
    )
]
"""Text that the parser leaves out or joins without a message.

It is nothing in place of a value, text after $ or *, a space in a number, and $, * or a list among references.
"""

_ERROR = re.compile(r"^\[error\][^\n]*?\d\] ([A-Za-z][^\n]*)", re.MULTILINE)
_ATTRIBUTES = re.compile(r"Expected \d+ attribute values, found \d+ for instance #(\d+)")
"""Messages in the parser's log, after severity, code and time."""

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

_IN_SPACE = ("IfcAxis1Placement", "IfcExtrudedAreaSolid", "IfcPolyLoop", "IfcVertexPoint")
"""Classes whose points and directions have three coordinates, beside those with 3D in their names."""

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

    Raises ``MeshError`` if the file is not a complete IFC file: truncated, of an unknown schema, with an error in
    the parser's log, or with another number of instances than are written; ``MemoryError`` at the limit of memory.
    """
    text, problems = decode_text(content)
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise MeshError(str(problems[0]))
    text = text or content.decode("utf-8", errors="replace")  # Some programs write Latin-1.
    if not text[:1000].lstrip("\ufeff \t\r\n").startswith("ISO-10303-21"):
        raise MeshError("does not begin with ISO-10303-21, expected an IFC file in STEP format")
    if not text[-1000:].rstrip().removesuffix(";").rstrip().endswith("END-ISO-10303-21"):
        raise MeshError("does not end with END-ISO-10303-21, expected a complete IFC file: is it truncated?")
    ifcopenshell.get_log()  # Errors of another file.
    try:
        file = ifcopenshell.file.from_string(text)
        schema, read = _wrapper.schema_by_name(str(file.schema_identifier)), len(list(file.entity_names()))
    except MemoryError:
        raise
    except Exception as error:
        reason = _errors(ifcopenshell.get_log()) or str(error) or type(error).__name__
        raise MeshError(f"not a readable IFC file ({shorten(escape_text(reason), 200)})") from error
    log = ifcopenshell.get_log()
    if errors := _errors(log):
        raise MeshError(f"not all of it can be read: {errors}; expected a complete {schema.name()} file")
    text = re.split(r"\bDATA\s*+;", _FREE_TEXT.sub("''", text), maxsplit=1)[-1]
    statements = max(text.count(";") - 2, 0)  # The instances; ENDSEC and END-ISO-10303-21 follow.
    if not read == statements == text.count("="):
        raise MeshError(
            f"{statements} instances are written, but {read} different ones can be read, expected as many: an "
            "instance is defined twice, or one of the characters # = ; is lost or added"
        )
    if found := next(filter(None, (pattern.search(text) for pattern in _MISREAD)), None):
        begin, end = text.rfind(";", 0, found.start()) + 1, text.find(";", found.end())
        instance = shorten(escape_text(text[begin:end].strip()), 200)
        raise MeshError(f"{instance} has {escape_text(found[0])}, expected values with commas between them")
    return Model(file, schema, set(map(int, _ATTRIBUTES.findall(log))))


def _errors(log: str) -> str:
    """Return the first errors in the parser's log, "" for none; raise ``MemoryError`` if it had no memory left."""
    reasons = _ERROR.findall(log)
    if reasons and reasons[0].startswith("Parsing terminated"):
        raise MemoryError  # The parser logs no reason for a failed allocation.
    return "; ".join(shorten(escape_text(reason), 200) for reason in reasons[:3])


class Model:
    """IFC model: ifcopenshell's ``file``, and the check of its instances, each once.

    ``unlike`` are the numbers of instances with another number of attributes than their class.
    """

    def __init__(self, file: Any, schema: Any, unlike: set[int]) -> None:
        self.file, self._schema, self._unlike = file, schema, unlike
        self._checked: set[int] = set()

    def by_type(self, name: str) -> list[Entity]:
        """Return the instances of a class and its subclasses, by number."""
        return sorted(self.file.by_type(name), key=lambda entity: int(entity.id()))

    def check_tree(self, root: Entity) -> None:
        """Check an instance and all instances that it refers to, directly or through others (``check``)."""
        stack = [root]
        while stack:
            entity = stack.pop()
            if entity.id() not in self._checked:
                self._checked.add(entity.id())
                stack += self.check(entity)

    def check(self, entity: Entity, *names: str) -> list[Entity]:
        """Check the attributes ``names`` of an instance, or all; return the instances that they refer to.

        A class may lack some of the names. Raises ``MeshError`` if the instance has another number of attributes
        than its class, one of another type, or points of other dimensions.
        """
        name = entity.is_a()
        # Lists of points have the attribute TagList in IFC4x3 only; exporters mix the versions up.
        if entity.id() in self._unlike and not name.startswith("IfcCartesianPointList"):
            raise MeshError(f"#{entity.id()} ({name}) has another number of attributes, expected {len(entity)}")
        references: list[Entity] = []
        declaration, attributes = validate.get_entity_attributes(self._schema, name)
        for index, (attribute, is_derived) in enumerate(zip(attributes, declaration.derived(), strict=True)):
            if is_derived or attribute.name() in _UNUSED or (names and attribute.name() not in names):
                continue
            value, kind = entity.get_argument(index), attribute.type_of_attribute()
            is_optional = attribute.optional() or attribute.name() in _MAY_BE_NULL
            if not (is_optional if value is None else self._is_of(kind, value)):
                found = "null" if value is None else escape_text(shorten(str(value), 60))
                where = f"#{entity.id()} ({name}): {attribute.name()}"
                raise MeshError(f"{where} is {found}, expected {shorten(str(kind), 80)}")
            references += _references(value)
        points = [one.get_argument(0) for one in references if one.is_a() in ("IfcCartesianPoint", "IfcDirection")]
        sizes = {len(coordinates) for coordinates in points if isinstance(coordinates, tuple)}
        expected = [2] if "2D" in name else [3] if "3D" in name or name in _IN_SPACE else [2, 3]
        if len(sizes) > 1 or not sizes.issubset(expected):
            found, right = (" or ".join(map(str, numbers)) for numbers in (sorted(sizes), expected))
            raise MeshError(f"#{entity.id()} ({name}) refers to points of {found} coordinates, expected {right}")
        return references

    def _is_of(self, kind: Any, value: Any) -> bool:
        """Return whether a value is of an attribute's type."""
        while isinstance(kind, _wrapper.named_type | _wrapper.type_declaration):
            kind = kind.declared_type()
        if isinstance(kind, _wrapper.aggregation_type):
            low, high, element = kind.bound1(), kind.bound2(), kind.type_of_element()
            is_long_enough = isinstance(value, tuple) and low <= len(value) and (high < 0 or len(value) <= high)
            return is_long_enough and all(self._is_of(element, item) for item in value)
        if isinstance(kind, _wrapper.simple_type):
            types = _PYTHON_TYPES[kind.declared_type()]
            return isinstance(value, types) and (bool in types or not isinstance(value, bool))
        if isinstance(kind, _wrapper.enumeration_type):
            return isinstance(value, str)
        if not isinstance(value, entity_instance):
            return False
        if isinstance(kind, _wrapper.entity):
            return bool(value.is_a(kind.name()))
        if value.is_a() not in validate.get_select_members(self._schema, kind):
            return False
        return value.id() != 0 or self._is_of(
            self._schema.declaration_by_name(value.is_a()), value.get_argument(0)
        )


def _references(value: Any) -> Iterator[Entity]:
    """Yield the numbered instances in an attribute's value."""
    for item in value if isinstance(value, tuple) else (value,):
        if isinstance(item, tuple):
            yield from _references(item)
        elif isinstance(item, entity_instance) and item.id():
            yield item
