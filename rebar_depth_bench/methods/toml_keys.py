"""Takes keys out of a TOML table; each that is missing, unknown or wrong becomes one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_SHOWN_CHARACTERS = 60
_LARGEST = 1e9
"""No number of a model's description comes near it, and its float is exact enough."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """What a value must be, in words, and what makes one of it; ``convert`` raises ``ValueError`` otherwise."""

    expected: str
    convert: Callable[[Any], T]


@dataclass(frozen=True)
class Keys:
    """One table; ``where`` goes before each key in a problem, and problems go to the shared list."""

    values: Mapping[str, Any]
    where: str
    problems: list[str]

    def required(self, key: str, kind: Kind[T], fallback: T) -> T:
        """Return the value of ``key``; ``fallback``, and a problem more, where it is missing or wrong."""
        if key not in self.values:
            self.problems.append(f"{self.where}{key} is missing, expected {kind.expected}")
        return self.optional(key, kind, fallback)

    def optional(self, key: str, kind: Kind[T], default: T) -> T:
        """Return the value of ``key``, or ``default`` where it is not given; a wrong one is a problem more."""
        if key not in self.values:
            return default
        try:
            return kind.convert(self.values[key])
        except ValueError:
            self.problems.append(f"{self.where}{key}: got {_shown(self.values[key])}, expected {kind.expected}")
            return default

    def only(self, known: Iterable[str]) -> None:
        """Note every key that is not one of ``known`` as a problem."""
        names = tuple(known)
        for key in self.values:
            if key not in names:
                near = get_close_matches(key, names, n=1)
                hint = f"did you mean {near[0]}?" if near else f"expected only {', '.join(names)}"
                self.problems.append(f"{self.where}{_shown(key)} is not a known key, {hint}")


def number(low: float, high: float) -> Kind[float]:
    """Return the kind of finite numbers from ``low`` to ``high``, above 0 where ``low`` is 0."""
    words = f"above 0, up to {high:g}" if low == 0 else f"from {low:g} to {high:g}"

    def convert(value: object) -> float:
        found = _number(value)
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
        red, green, blue = (_number(item) for item in value)
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


def text(most: int, what: str = "text on one line") -> Kind[str]:
    """Return the kind of printable strings, not blank, of up to ``most`` characters."""

    def convert(value: object) -> str:
        if not isinstance(value, str) or not value.strip() or not value.isprintable() or len(value) > most:
            raise ValueError
        return value

    return Kind(f"{what}, 1 to {most} characters", convert)


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


TABLE: Kind[Mapping[str, Any] | None] = Kind("a table", _table)


def _number(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError
    if math.isnan(value) or abs(value) > _LARGEST:
        raise ValueError
    return float(value)


def _shown(value: object) -> str:
    try:
        found = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists in lists in lists
        return f"a huge {type(value).__name__}"
    return found if len(found) <= _SHOWN_CHARACTERS else f"{found[:_SHOWN_CHARACTERS]} ..."
