"""Strict validation of TOML tables: one problem sentence for each missing, unknown or invalid key."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Generic, TypeVar, overload

T = TypeVar("T")
D = TypeVar("D")
_MAX_REPR_CHARACTERS = 60
_MAX_MAGNITUDE = 1e9
"""Largest accepted magnitude: far above any number of a scene or model file, with powers that stay finite."""


@dataclass(frozen=True)
class FieldType(Generic[T]):
    """Type of a TOML value: a description of the expected value and a conversion function.

    ``convert`` returns the converted value and raises ``ValueError`` for an invalid one. The message of the
    ``ValueError``, if not empty, replaces the value in the reported problem.
    """

    expected: str
    convert: Callable[[Any], T]


@dataclass(frozen=True)
class TableReader:
    """Reader of one table that appends every problem to the shared list ``problems``.

    ``where`` is the prefix of each key in a problem.
    """

    values: Mapping[str, Any]
    where: str
    problems: list[str]

    @overload
    def required(self, key: str, field_type: FieldType[T]) -> T | None: ...
    @overload
    def required(self, key: str, field_type: FieldType[T], fallback: D) -> T | D: ...
    def required(self, key: str, field_type: FieldType[Any], fallback: Any = None) -> Any:
        """Return the value of ``key``; if it is missing or invalid, add a problem and return ``fallback``."""
        if key not in self.values:
            self.problems.append(f"{self.where}{key} is missing, expected {field_type.expected}")
        return self.optional(key, field_type, fallback)

    @overload
    def optional(self, key: str, field_type: FieldType[T]) -> T | None: ...
    @overload
    def optional(self, key: str, field_type: FieldType[T], default: D) -> T | D: ...
    def optional(self, key: str, field_type: FieldType[Any], default: Any = None) -> Any:
        """Return the value of ``key``, or ``default`` if it is missing; add a problem if it is invalid."""
        if key not in self.values:
            return default
        try:
            return field_type.convert(self.values[key])
        except ValueError as error:
            description = describe_value(error, self.values[key])
            self.problems.append(f"{self.where}{key}: {description}, expected {field_type.expected}")
            return default

    def reject_unknown(self, known: Iterable[str]) -> None:
        """Add a problem for every key that is not one of ``known``."""
        names = tuple(known)
        for key in self.values:
            if key not in names:
                close_matches = get_close_matches(key, names, n=1)
                hint = (
                    f"did you mean {close_matches[0]}?" if close_matches else f"expected only {', '.join(names)}"
                )
                self.problems.append(f"{self.where}{short_repr(key)} is not a known key, {hint}")


def describe_value(error: ValueError, value: object) -> str:
    """Return the part of a problem that describes the invalid value: the error's message, or else the value."""
    return str(error) or f"got {short_repr(value)}"


def short_repr(value: object) -> str:
    """Return ``repr(value)`` on one line, truncated to 60 characters."""
    try:
        line = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # Huge integers and deep nesting have no repr.
        return f"a huge {type(value).__name__}"
    return line if len(line) <= _MAX_REPR_CHARACTERS else f"{line[:_MAX_REPR_CHARACTERS]} ..."


def finite(value: object) -> float:
    """Return a number as float.

    Raises ``ValueError`` for anything else, including booleans, NaN and magnitudes above 1e9.
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        raise ValueError
    if abs(value) > _MAX_MAGNITUDE:
        raise ValueError(f"got a number with a magnitude above {_MAX_MAGNITUDE:g}")
    return float(value)


def number(low: float, high: float) -> FieldType[float]:
    """Return the type of finite numbers from ``low`` to ``high``; 0 is excluded if ``low`` is 0."""
    interval = f"above 0, up to {high:g}" if low == 0 else f"from {low:g} to {high:g}"

    def convert(value: object) -> float:
        result = finite(value)
        if not low <= result <= high or result == 0 == low:
            raise ValueError
        return result

    return FieldType(f"a number {interval}", convert)


POSITIVE = FieldType("a number above 0", number(0, _MAX_MAGNITUDE).convert)


def three_numbers(low: float, high: float) -> FieldType[tuple[float, float, float]]:
    """Return the type of RGB lists: three numbers from ``low`` to ``high``, converted to a tuple."""

    def convert(value: object) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise ValueError
        red, green, blue = (finite(item) for item in value)
        if not all(low <= item <= high for item in (red, green, blue)):
            raise ValueError
        return red, green, blue

    return FieldType(f"three numbers from {low:g} to {high:g}: red, green, blue", convert)


def whole_number(low: int, high: int) -> FieldType[int]:
    """Return the type of integers from ``low`` to ``high``; booleans and floats such as 6.0 are rejected."""

    def convert(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return FieldType(f"a whole number from {low} to {high}", convert)


def string_matching(expected: str, accept: Callable[[str], bool]) -> FieldType[str]:
    """Return the type of strings for which ``accept`` returns true."""

    def convert(value: object) -> str:
        if not isinstance(value, str) or not accept(value):
            raise ValueError
        return value

    return FieldType(expected, convert)


def text(max_length: int, what: str = "text on one line") -> FieldType[str]:
    """Return the type of printable, non-blank strings of at most ``max_length`` characters."""
    return string_matching(
        f"{what}, 1 to {max_length} characters",
        lambda value: bool(value.strip()) and value.isprintable() and len(value) <= max_length,
    )


def choice(choices: Mapping[T, str]) -> FieldType[T]:
    """Return the type of values that equal a key of ``choices``, which maps each value to its TOML notation."""
    *others, last = choices.values()

    def convert(value: object) -> T:
        for candidate in choices:
            if type(value) is type(candidate) and value == candidate:
                return candidate
        raise ValueError

    return FieldType(f"{', '.join(others)} or {last}", convert)


def one_of(*names: str) -> FieldType[str]:
    """Return the type of strings that equal one of ``names``."""
    return choice({name: f'"{name}"' for name in names})


FLAG: FieldType[bool] = choice({True: "true", False: "false"})


def _table(value: object) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError
    return value


TABLE: FieldType[Mapping[str, Any]] = FieldType("a table", _table)
