"""Reads TOML tables strictly: each key that is missing, unknown or wrong becomes one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, Generic, TypeVar

T = TypeVar("T")
_SHOWN_CHARACTERS = 60
_LARGEST = 1e9
"""No length, angle or count of a scene comes near it, and its powers are finite."""


@dataclass(frozen=True)
class Kind(Generic[T]):
    """What a value must be, in words, and what makes a value of it; ``convert`` raises ``ValueError`` otherwise.

    The error's words, where it has any, tell what was found in place of the value itself.
    """

    expected: str
    convert: Callable[[Any], T]


@dataclass
class Table:
    """One table of a TOML file as it is read; ``where`` names it in problems, which go to the shared list."""

    values: Mapping[str, Any]
    where: str
    problems: list[str]
    known: list[str] = field(default_factory=list)

    def required(self, key: str, kind: Kind[T]) -> T | None:
        """Return the value of ``key``; None, and a problem more, where it is missing or wrong."""
        if key not in self.values:
            self.problems.append(f"{self.where}{key} is missing, expected {kind.expected}")
        return self.optional(key, kind)

    def optional(self, key: str, kind: Kind[T]) -> T | None:
        """Return the value of ``key``, None where it is not given; a wrong one is a problem more, and None."""
        self.known.append(key)
        if key not in self.values:
            return None
        try:
            return kind.convert(self.values[key])
        except ValueError as error:
            found = str(error) or f"got {shown(self.values[key])}"
            self.problems.append(f"{self.where}{key}: {found}, expected {kind.expected}")
            return None

    def no_more(self) -> None:
        """Note every key that was never asked for as a problem."""
        for key in self.values:
            if key not in self.known:
                near = get_close_matches(key, self.known, n=1)
                hint = f"did you mean {near[0]}?" if near else f"expected only {', '.join(self.known)}"
                self.problems.append(f"{self.where}{shown(key)} is not a known key, {hint}")


def shown(value: object) -> str:
    """Return a value as a problem shows it: on one line and short."""
    try:
        words = " ".join(repr(value).split())
    except (ValueError, RecursionError):  # an integer of thousands of digits, lists in lists in lists
        return f"a huge {type(value).__name__}"
    return words if len(words) <= _SHOWN_CHARACTERS else f"{words[:_SHOWN_CHARACTERS]} ..."


def number(value: object) -> float:
    """Return a finite number as float; raise ``ValueError`` for anything else, truth values among it."""
    if isinstance(value, bool) or not isinstance(value, int | float) or value != value:
        raise ValueError
    if abs(value) > _LARGEST:
        raise ValueError(f"got a number beyond {_LARGEST:g}")
    return float(value)


def number_between(low: float, high: float, expected: str) -> Kind[float]:
    """Return the kind of numbers with ``low < number <= high``."""

    def convert(value: object) -> float:
        found = number(value)
        if not low < found <= high:
            raise ValueError
        return found

    return Kind(expected, convert)


def whole_number(low: int, high: int) -> Kind[int]:
    """Return the kind of integers from ``low`` to ``high``; truth values and 6.0 are none."""

    def convert(value: object) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return Kind(f"a whole number from {low} to {high}", convert)


def text(expected: str, accept: Callable[[str], bool]) -> Kind[str]:
    """Return the kind of strings that ``accept`` takes."""

    def convert(value: object) -> str:
        if not isinstance(value, str) or not accept(value):
            raise ValueError
        return value

    return Kind(expected, convert)


def one_of(names: Sequence[str]) -> Kind[str]:
    """Return the kind of strings that are one of ``names``."""
    quoted = [f'"{name}"' for name in names]
    return text(f"{', '.join(quoted[:-1])} or {quoted[-1]}", lambda value: value in names)


def list_of(kind: Kind[T], what: str, expected: str, least: int = 1, most: int = 10_000) -> Kind[tuple[T, ...]]:
    """Return the kind of lists of ``least`` to ``most`` values of ``kind``; problems call one of them ``what``."""

    def convert(values: object) -> tuple[T, ...]:
        if not isinstance(values, list):
            raise ValueError
        if not least <= len(values) <= most:
            raise ValueError(f"got a list of {len(values)}")
        found = []
        for place, value in enumerate(values, start=1):
            try:
                found.append(kind.convert(value))
            except ValueError as error:
                raise ValueError(f"{what} {place}: {str(error) or f'got {shown(value)}'}") from None
        return tuple(found)

    return Kind(expected, convert)


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise ValueError
    return value


FLAG: Kind[bool] = Kind("true or false", _flag)
LENGTH: Kind[float] = number_between(0.0, math.inf, "a length above 0, in the file's unit")
