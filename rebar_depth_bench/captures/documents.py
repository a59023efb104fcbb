"""Content of other programs' calibration files: YAML, and OpenCV's FileStorage in YAML, XML or JSON.

A document is returned as dicts, lists, numbers and texts. Matrices of OpenCV are dicts with rows, cols and data.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import PurePath
from typing import Any
from xml.etree import ElementTree

from rebar_depth_bench.base.errors import Problem, escape_text
from rebar_depth_bench.base.reading import MAX_NESTING, decode_text, parse_json

_MAX_ALIASED = 10_000
"""Largest number of values that the aliases of a YAML text stand for; it keeps their nesting below 150 levels."""
_OPENCV_HEADER = re.compile(r"\A%YAML[: ][0-9.]+[^\n]*\n")
"""First line of OpenCV's YAML; its older form, ``%YAML:1.0``, is not YAML."""
_OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"
_STORAGE = "opencv_storage"


def parse_document(name: str, content: bytes, problems: list[Problem]) -> dict[str, Any]:
    """Return the first document of a calibration file ``name``, whose suffix is one of ``DOCUMENT_SUFFIXES``.

    Problems are added to ``problems``, and the result is empty if there are any.
    """
    text, text_problems = decode_text(content, name)
    if text_problems:
        problems += text_problems
        return {}
    try:
        document = _PARSERS[PurePath(name).suffix.lower()](text)
    except RecursionError:
        problems.append(Problem("size", name, "the values are nested too deep", f"at most {MAX_NESTING} levels"))
        return {}
    except ValueError as error:
        problems.append(Problem("syntax", name, escape_text(" ".join(str(error).split()))))
        return {}
    if not isinstance(document, dict):
        problems.append(Problem("invalid", name, f"holds {type(document).__name__}", "keys with values"))
        return {}
    return {str(key): value for key, value in document.items()}


def _parse_yaml(text: str) -> Any:
    """Return the first document of a text. Raises ``ValueError`` for invalid YAML and for what is too large."""
    import yaml

    class Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        """Loader of plain values and OpenCV's matrices."""

    Loader.add_constructor(_OPENCV_MATRIX, lambda loader, node: loader.construct_mapping(node, deep=True))
    content = _OPENCV_HEADER.sub("\n", text, count=1)  # The numbers of the lines stay.
    try:
        _check_events(yaml.parse(content, Loader))
        return next(iter(yaml.load_all(content, Loader)), None)
    except yaml.MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f"line {error.problem_mark.line + 1}: "
        raise ValueError(f"{line}not valid YAML: {error.problem}") from None
    except (yaml.YAMLError, TypeError) as error:
        raise ValueError(f"not valid YAML: {error}") from None


def _check_events(events: Iterable[Any]) -> None:
    """Raise ``ValueError`` for Python's tags, deep nesting, and aliases that make a short text huge or endless."""
    opened: list[tuple[str | None, int]] = []  # Anchor of each open container, and the values before it.
    sizes: dict[str | None, int] = {}  # Values that each anchor stands for.
    values = aliased = 0
    for event in events:
        kind, line, anchor = type(event).__name__, event.start_mark.line + 1, getattr(event, "anchor", None)
        if "python/" in str(getattr(event, "tag", "")):
            expected = "plain lists: array.tolist(), list(tuple), float(number)"
            raise ValueError(f"line {line}: a Python object (!!python/...), expected {expected}")
        if kind == "AliasEvent":
            if anchor not in sizes:
                raise ValueError(f"line {line}: the alias *{anchor} stands for no complete value")
            aliased += sizes[anchor]
            values += sizes[anchor]
        elif kind.endswith("EndEvent"):
            anchor, before = opened.pop()
            sizes[anchor] = values - before
        elif kind.endswith("StartEvent"):
            opened.append((anchor, values))
            sizes.pop(anchor, None)
            values += 1
        else:
            sizes[anchor] = 1
            values += 1
        if aliased > _MAX_ALIASED:
            found = f"the aliases (*) stand for more than {_MAX_ALIASED} values"
            raise ValueError(f"line {line}: {found}, expected plain values")
        if len(opened) > MAX_NESTING:
            raise ValueError(f"line {line}: the values are nested too deep, expected at most {MAX_NESTING} levels")


def _parse_json(text: str) -> Any:
    value, problems = parse_json(text.encode())
    if problems:
        raise ValueError(problems[0].found)
    return value


def _parse_xml(text: str) -> Any:
    """Return the values of OpenCV's XML. Raises ``ValueError`` for invalid XML and for document types."""
    if "<!" in re.sub(r"<!--.*?(?:-->|\Z)", "", text, flags=re.DOTALL):
        raise ValueError("a document type or CDATA, expected OpenCV's XML")
    try:
        root = ElementTree.fromstring(text.encode())  # noqa: S314 (no entities without a type)
    except ElementTree.ParseError as error:
        raise ValueError(f"line {error.position[0]}: not valid XML: {error}") from None
    if root.tag != _STORAGE:
        raise ValueError(f"the first element is <{root.tag}>, expected <{_STORAGE}>")
    return _element_value(root)


def _element_value(element: ElementTree.Element) -> Any:
    """Return the children of an element by name, or its numbers or text."""
    if len(element):
        return {child.tag: _element_value(child) for child in element}
    words = (element.text or "").split()
    return words if len(words) > 1 else "".join(words)


_PARSERS: Mapping[str, Callable[[str], Any]] = {
    ".yaml": _parse_yaml,
    ".yml": _parse_yaml,
    ".xml": _parse_xml,
    ".json": _parse_json,
}
DOCUMENT_SUFFIXES = tuple(_PARSERS)
"""Suffixes of the files that ``parse_document`` reads."""
