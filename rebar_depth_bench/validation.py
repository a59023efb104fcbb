"""Reads TOML tables strictly: each key that is missing, unknown or wrong becomes one sentence."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Generic, TypeVar, overload

T = TypeVar("T")
D = TypeVar("D")
_SHOWN_CHARACTERS = 60
_LARGEST = 1e9
"""No number of a scene or of a model's description comes near it, and its powers are finite."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """What a value must be, in words, and what makes one of it; ``convert`` raises ``ValueError`` otherwise.

    The error's words, where it has any, tell what was found in place of the value itself.
    """

    expected: str
    convert: Callable[[Any], T]


@dataclass(frozen=True)
class Keys:
    """One table; ``where`` goes before each key in a problem, and problems go to the shared list."""

    values: Mapping[str, Any]
    where: str
    problems: list[str]

    @overload
    def required(self, key: str, kind: Kind[T]) -> T | None: ...
    @overload
    def required(self, key: str, kind: Kind[T], fallback: D) -> T | D: ...
    def required(self, key: str, kind: Kind[Any], fallback: Any = None) -> Any:
        """Return the value of ``key``; ``fallback``, and a problem more, where it is missing or wrong."""
        if key not in self.values:
            self.problems.append(f"{self.where}{key} is missing, expected {kind.expected}")
        return self.optional(key, kind, fallback)

    @overload
    def optional(self, key: str, kind: Kind[T]) -> T | None: ...
    @overload
    def optional(self, key: str, kind: Kind[T], default: D) -> T | D: ...
    def optional(self, key: str, kind: Kind[Any], default: Any = None) -> Any:
        """Return the value of ``key``, or ``default`` where it is not given; a wrong one is a problem more."""
        if key not in self.values:
            return default
        try:
            return kind.convert(self.values[key])
        except ValueError as error:
            found = found_words(error, self.values[key])
            self.problems.append(f"{self.where}{key}: {found}, expected {kind.expected}")
            return default

    def only(self, known: Iterable[str]) -> None:
        """Note every key that is not one of ``known`` as a problem."""
        names = tuple(known)
        for key in self.values:
            if key not in names:
                near = get_close_matches(key, names, n=1)
                hint = f"did you mean {near[0]}?" if near else f"expected only {', '.join(names)}"
                self.problems.append(f"{self.where}{shown(key)} is not a known key, {hint}")


def found_words(error: ValueError, value: object) -> str:
    """Return what a problem says was found: the error's own words, or the value."""
    return str(error) or f"got {shown(value)}"


def shown(value: object) -> str:
    """Return a value as a problem shows it: on one line and short."""
    try:
        found = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists in lists in lists
        return f"a huge {type(value).__name__}"
    return found if len(found) <= _SHOWN_CHARACTERS else f"{found[:_SHOWN_CHARACTERS]} ..."


def finite(value: object) -> float:
    """Return a number as float; raise ``ValueError`` for anything else: truth values, NaN, beyond 1e9."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        raise ValueError
    if abs(value) > _LARGEST:
        raise ValueError(f"got a number beyond {_LARGEST:g}")
    return float(value)


def number(low: float, high: float) -> Kind[float]:
    """Return the kind of finite numbers from ``low`` to ``high``, above 0 where ``low`` is 0."""
    words = f"above 0, up to {high:g}" if low == 0 else f"from {low:g} to {high:g}"

    def convert(value: object) -> float:
        found = finite(value)
        if not low <= found <= high or found == 0 == low:
            raise ValueError
        return found

    return Kind(f"a number {words}", convert)


POSITIVE = Kind("a number above 0", number(0, _LARGEST).convert)


def three_numbers(low: float, high: float) -> Kind[tuple[float, float, float]]:
    """Return the kind of lists of three numbers from ``low`` to ``high``: red, green, blue."""

    def convert(value: object) -> tuple[float, float, float]:
        if not isinstance(value, list) or len(value) != 3:
            raise ValueError
        red, green, blue = (finite(item) for item in value)
        if not all(low <= item <= high for item in (red, green, blue)):
            raise ValueError
        return red, green, blue

    return Kind(f"three numbers from {low:g} to {high:g}: red, green, blue", convert)


def whole_number(low: int, high: int) -> Kind[int]:
    """Return the kind of integers from ``low`` to ``high``; truth values and 6.0 are none."""

    def convert(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return Kind(f"a whole number from {low} to {high}", convert)


def text_that(expected: str, accept: Callable[[str], bool]) -> Kind[str]:
    """Return the kind of strings that ``accept`` takes."""

    def convert(value: object) -> str:
        if not isinstance(value, str) or not accept(value):
            raise ValueError
        return value

    return Kind(expected, convert)


def text(most: int, what: str = "text on one line") -> Kind[str]:
    """Return the kind of printable strings, not blank, of up to ``most`` characters."""
    return text_that(
        f"{what}, 1 to {most} characters",
        lambda value: bool(value.strip()) and value.isprintable() and len(value) <= most,
    )


def choice(choices: Mapping[T, str]) -> Kind[T]:
    """Return the kind of values that are a key of ``choices``, which says how each is written."""
    *others, last = choices.values()

    def convert(value: object) -> T:
        for candidate in choices:
            if type(value) is type(candidate) and value == candidate:
                return candidate
        raise ValueError

    return Kind(f"{', '.join(others)} or {last}", convert)


def words(*names: str) -> Kind[str]:
    """Return the kind of strings that are one of ``names``."""
    return choice({name: f'"{name}"' for name in names})


FLAG: Kind[bool] = choice({True: "true", False: "false"})


def _table(value: object) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise ValueError
    return value


TABLE: Kind[Mapping[str, Any]] = Kind("a table", _table)
