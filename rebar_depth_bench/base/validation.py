"""Validation of TOML and JSON tables with pydantic: one ``Problem`` for each missing, unknown or invalid key.

A schema is a subclass of ``StrictModel`` whose field types are annotated with ``Expected``, the description of a
valid value::

    class InputTable(StrictModel):
        width: Annotated[int, whole_number(1, 8192)]

``validate_table`` returns the model of a table and appends all problems of the table to a list.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Annotated, Any, TypeGuard, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, Strict, TypeAdapter, ValidationError
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from rebar_depth_bench.base.errors import Problem, ProblemCode

Model = TypeVar("Model", bound=BaseModel)
Document = TypeVar("Document")
_MAX_REPR_CHARACTERS = 60
_MAX_MAGNITUDE = 1e9
"""Largest accepted magnitude: far above any number of a scene or model file, with powers that stay finite."""
_EXPLAINED = "explained"
_INVALID_KEY = "[key]"
"""Last part of the location at which pydantic reports an invalid key of a dict."""
_TYPES = {
    "model_type": "a table",
    "dict_type": "a table",
    "dataclass_type": "a table",
    "tuple_type": "a list",
    "unexpected_keyword_argument": "no such key",
}


class StrictModel(BaseModel):
    """Base class of schemas; unknown keys and conversions between types (``"3"`` or true to 1) are rejected."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)


@dataclass(frozen=True)
class Expected:
    """Annotation of a type: a description of the valid values, and a predicate that a value must fulfil.

    The description replaces pydantic's message, except for elements of a list that have their own description.
    """

    text: str
    accept: Callable[[Any], bool] = lambda _: True

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the annotated type with the check of this description around it."""
        return core_schema.no_info_wrap_validator_function(self._check, handler(source))

    def _check(self, value: Any, convert: core_schema.ValidatorFunctionWrapHandler) -> Any:
        try:
            converted = convert(value)
        except ValidationError as error:
            if all(details["type"] == _EXPLAINED for details in error.errors()):
                raise
            raise field_error(f"got {short_repr(value)}", self.text) from None
        if not self.accept(converted):
            raise field_error(f"got {short_repr(value)}", self.text)
        return converted


def field_error(found: str, expected: str, code: ProblemCode = "invalid") -> PydanticCustomError:
    """Return the error that a validator raises to report what it found and expected."""
    context = {"found": found, "expected": expected, "code": code}
    return PydanticCustomError(_EXPLAINED, "{found}, expected {expected}", context)


def check_unique(names: Sequence[str], what: str) -> None:
    """Raise the error of a field unless it has one or more names, each once."""
    if not names:
        raise field_error("got none", f"one {what} or more")
    name, occurrences = Counter(names).most_common(1)[0]
    if occurrences > 1:
        raise field_error(f"{name} occurs more than once", f"each {what} once", "duplicate")


def number(low: float, high: float = _MAX_MAGNITUDE, expected: str = "") -> Expected:
    """Return the description of finite numbers from ``low`` to ``high``; 0 is excluded if ``low`` is 0."""
    interval = f"above 0, up to {high:g}" if low == 0 else f"from {low:g} to {high:g}"
    return Expected(
        expected or f"a number {interval}", lambda value: low <= value <= high and not value == 0 == low
    )


def whole_number(low: int, high: int) -> Expected:
    """Return the description of integers from ``low`` to ``high``."""
    return Expected(f"a whole number from {low} to {high}", lambda value: low <= value <= high)


def three_numbers(low: float, high: float, expected: str = "") -> Expected:
    """Return the description of a ``Triple`` of numbers from ``low`` to ``high``; by default red, green, blue."""
    return Expected(
        expected or f"three numbers from {low:g} to {high:g}: red, green, blue",
        lambda values: all(low <= value <= high for value in values),
    )


def text(max_length: int, what: str = "text on one line") -> Expected:
    """Return the description of printable, non-blank strings of at most ``max_length`` characters."""
    return Expected(
        f"{what}, 1 to {max_length} characters",
        lambda value: bool(value.strip()) and value.isprintable() and len(value) <= max_length,
    )


def one_of(*values: str | int) -> Expected:
    """Return the description of values that equal one of ``values``."""
    *others, last = (f'"{value}"' if isinstance(value, str) else f"{value}" for value in values)
    return Expected(f"{', '.join(others)} or {last}" if others else last, lambda value: value in values)


UNITS_M: Mapping[str, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length of one unit in metres, by the name of the unit in files."""

Triple = Annotated[tuple[float, float, float], Strict(False)]
"""Type of a list of three numbers, converted to a tuple."""

Flag = Annotated[bool, Expected("true or false")]


def validate_table(
    model: type[Model],
    values: object,
    problems: list[Problem],
    where: str = "",
    context: Any = None,
    *,
    from_json: bool = False,
) -> Model | None:
    """Return the validated table, or None after adding all its problems to ``problems``.

    ``where`` is the location of the table, and ``context`` is passed to validators (``info.context``). With
    ``from_json`` the values are those of a JSON text, in which lists stand for tuples and tables for dataclasses.
    """
    try:
        if from_json:
            return model.model_validate_json(json.dumps(values), context=context)
        return model.model_validate(values, context=context)
    except ValidationError as error:
        problems += [_problem(details, model, where) for details in error.errors(include_url=False)]
        return None


def validate_document(
    schema: TypeAdapter[Document], values: object, problems: list[Problem], where: str = ""
) -> Document | None:
    """Return the validated value of a JSON document that is no model; otherwise as ``validate_table``."""
    try:
        return schema.validate_python(values)
    except ValidationError as error:
        problems += [_problem(details, BaseModel, where) for details in error.errors(include_url=False)]
        return None


def _problem(details: ErrorDetails, model: type[BaseModel], where: str) -> Problem:
    location, kind = details["loc"], details["type"]
    place = format_location(where, *location)
    if kind == _EXPLAINED:
        context = details["ctx"]
        return Problem(context["code"], place, context["found"], context["expected"])
    if kind == "missing":
        return Problem("missing", place, "missing", _expectation(_model_at(model, location), location[-1]))
    if kind == "extra_forbidden":
        fields = _model_at(model, location).model_fields
        known = [field.alias or name for name, field in fields.items()]
        close = get_close_matches(str(location[-1]), known, n=1)
        return Problem("unknown", place, "not a known key", close[0] if close else f"one of {', '.join(known)}")
    expected = _TYPES.get(
        kind, details["msg"].removeprefix("Input should be ").replace("String should match", "text that matches")
    )
    return Problem("invalid", place, f"got {short_repr(details['input'])}", expected)


def _model_at(model: type[BaseModel], location: Sequence[int | str]) -> type[BaseModel]:
    """Return the model of the table that holds the last key of a location."""
    for key in location[:-1]:
        fields = {field.alias or name: field for name, field in model.model_fields.items()}
        if key in fields:  # Other keys are those of a dict.
            annotation = fields[key].annotation
            model = next((item for item in (annotation, *get_args(annotation)) if _is_model(item)), model)
    return model


def _is_model(annotation: Any) -> TypeGuard[type[BaseModel]]:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _expectation(model: type[BaseModel], key: int | str) -> str:
    field = next((field for name, field in model.model_fields.items() if key in (name, field.alias)), None)
    if field is None:  # The table was validated by a validator of the model.
        return ""
    if _is_model(field.annotation):
        return "a table"
    return next((item.text for item in field.metadata if isinstance(item, Expected)), "")


def format_location(where: str, *keys: int | str) -> str:
    """Return the location of a value: keys joined by dots, after each index of a list, counted from 1, a colon."""
    for key in keys:
        if isinstance(key, int):
            where = f"{where} {key + 1}:"
        elif key != _INVALID_KEY:
            name = key if key and key.isprintable() and len(key) <= _MAX_REPR_CHARACTERS else short_repr(key)
            where += f"{'' if not where else ' ' if where.endswith(':') else '.'}{name}"
    return where.removesuffix(":")


def short_repr(value: object) -> str:
    """Return ``repr(value)`` on one line, truncated to 60 characters."""
    try:
        line = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # Huge integers and deep nesting have no repr.
        return f"a huge {type(value).__name__}"
    return line if len(line) <= _MAX_REPR_CHARACTERS else f"{line[:_MAX_REPR_CHARACTERS]} ..."
