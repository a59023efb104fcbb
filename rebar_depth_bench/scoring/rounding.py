"""How numbers are written into JSON."""

from __future__ import annotations

import math

SIGNIFICANT_DIGITS = 12
"""Numbers are written with this many digits: sums may differ in their last bits between processors."""

INTERVAL_DIGITS = 6
"""An interval's ends are estimates from resamples: more digits would say nothing."""


def rounded(value: float | None, digits: int = SIGNIFICANT_DIGITS) -> float | None:
    """Return a number as it is written: None where undefined."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{digits}g}")
