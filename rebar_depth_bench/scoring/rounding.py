"""Rounding of numbers for JSON output."""

from __future__ import annotations

import math

SIGNIFICANT_DIGITS = 12
"""Significant digits of written numbers; the last bits of sums may differ between processors."""

INTERVAL_DIGITS = 6
"""Significant digits of interval bounds, which are estimates from resamples and have no more accuracy."""


def rounded(value: float | None, digits: int = SIGNIFICANT_DIGITS) -> float | None:
    """Return ``value`` rounded to ``digits`` significant digits; None if it is None or not finite."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")


def rounded_interval(interval: tuple[float, float] | None) -> list[float | None] | None:
    """Return both ends of an interval rounded to ``INTERVAL_DIGITS``; None if the interval is None."""
    return None if interval is None else [rounded(end, INTERVAL_DIGITS) for end in interval]
