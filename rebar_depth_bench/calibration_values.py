"""Numbers of a calibration file, checked one by one; what is wrong is collected rather than raised."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

MIN_PRINCIPAL_POINT = -0.5
"""The left edge of the first pixel, whose centre is 0."""


@dataclass(frozen=True)
class Range:
    """What a number may be, bounds included, and its unit for the words of a problem."""

    low: float
    high: float
    unit: str

    def __str__(self) -> str:
        return f"a number from {self.low:g} to {self.high:g} {self.unit}".rstrip()


FOCAL = Range(1.0, 1e5, "pixels")
TERM = Range(-1000.0, 1000.0, "")
ANGLE = Range(-0.5, 0.5, "radians")
BASELINE_MM = Range(1.0, 10_000.0, "millimetres")
OFFSET_MM = Range(-1000.0, 1000.0, "millimetres")
BASELINE_M = Range(0.001, 10.0, "metres")
OFFSET_M = Range(-10.0, 10.0, "metres")


def principal_range(side_px: int) -> Range:
    """Return the range of a principal point's coordinate: inside the picture."""
    return Range(MIN_PRINCIPAL_POINT, side_px - 0.5, "pixels")


def number(raw: object, where: str, allowed: Range, problems: list[str]) -> float:
    """Return ``raw``, text or a number, as a float; NaN and a further problem where it is none or out of range."""
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        problems.append(f"{where} is {raw!r}, expected {allowed}")
        return math.nan
    try:
        value = float(raw)
    except (ValueError, OverflowError):
        value = math.nan
    if not allowed.low <= value <= allowed.high:
        problems.append(f"{where} is {raw!r}, expected {allowed}")
        return math.nan
    return value


def numbers(
    raw: object, where: str, counts: Sequence[int], allowed: Range, problems: list[str]
) -> tuple[float, ...]:
    """Return a list of numbers; NaNs and further problems where it is none, or not of one of the ``counts``."""
    if not isinstance(raw, list) or len(raw) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        problems.append(f"{where} is {raw!r}, expected {wanted} numbers")
        return (math.nan,) * max(counts)
    return tuple(number(item, f"{where}[{n}]", allowed, problems) for n, item in enumerate(raw))
