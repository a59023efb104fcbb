"""Kinds of values that only a scene's TOML file has: lengths, angles, points and lists."""

from __future__ import annotations

from rebar_depth_bench.toml_keys import POSITIVE, Kind, T, finite, found_words, number

Point = tuple[float, float, float]


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
                raise ValueError(f"{what} {place}: {found_words(error, value)}") from None
        return tuple(found)

    return Kind(expected, convert)


def _point(value: object) -> Point:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError
    x, y, z = (finite(coordinate) for coordinate in value)
    return x, y, z


LENGTH: Kind[float] = Kind("a length above 0, in the file's unit", POSITIVE.convert)
DISTANCE: Kind[float] = Kind("a distance above 0", POSITIVE.convert)
ELEVATION: Kind[float] = Kind("degrees above 0, up to 89", number(0, 89).convert)
POINT: Kind[Point] = Kind("three numbers", _point)
