"""Tolerance profiles of reinforcement standards, and the process capability index of a measured error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

ErrorKind = Literal["spacing", "layer", "cover"]
"""Kind of error that a tolerance bounds; ``inspection.measures`` defines each kind."""


@dataclass(frozen=True)
class Tolerance:
    """One tolerance of a profile: errors of this ``kind`` pass if their absolute value is at most ``limit_mm``."""

    key: str
    kind: ErrorKind
    limit_mm: float
    title: str


@dataclass(frozen=True)
class ToleranceProfile:
    """Tolerances of one standard; ``source`` is the citation shown beside them."""

    name: str
    title: str
    source: str
    tolerances: tuple[Tolerance, ...]


GB_50204 = ToleranceProfile(
    name="gb50204",
    title="GB 50204",
    source="GB 50204 (acceptance of concrete works, China), placing of bars; figures from a secondary source",
    tolerances=(
        Tolerance("gb50204_spacing", "spacing", 10.0, "bar spacing"),
        Tolerance("gb50204_stirrup_spacing", "spacing", 20.0, "stirrup spacing"),
        Tolerance("gb50204_layers", "layer", 5.0, "distance of layers"),
        Tolerance("gb50204_cover_slab", "cover", 3.0, "cover, slabs and walls"),
        Tolerance("gb50204_cover_beam", "cover", 5.0, "cover, beams and columns"),
    ),
)

EN_13670_CLASS_1 = ToleranceProfile(
    name="en13670_class1",
    title="EN 13670, class 1",
    source="EN 13670 (execution of concrete structures), cover, plus side, tolerance class 1, growing with the "
    "depth of the section; figures from a secondary source; held against errors of either sign",
    tolerances=(
        Tolerance("en13670_class1_cover_shallow", "cover", 10.0, "cover, shallow sections"),
        Tolerance("en13670_class1_cover_medium", "cover", 15.0, "cover, medium sections"),
        Tolerance("en13670_class1_cover_deep", "cover", 25.0, "cover, deep sections"),
    ),
)

EN_13670_CLASS_2 = ToleranceProfile(
    name="en13670_class2",
    title="EN 13670, class 2",
    source="EN 13670 (execution of concrete structures), cover, plus side, tolerance class 2, growing with the "
    "depth of the section; figures from a secondary source; held against errors of either sign",
    tolerances=(
        Tolerance("en13670_class2_cover_shallow", "cover", 5.0, "cover, shallow sections"),
        Tolerance("en13670_class2_cover_medium", "cover", 10.0, "cover, medium sections"),
        Tolerance("en13670_class2_cover_deep", "cover", 20.0, "cover, deep sections"),
    ),
)

PROFILES: tuple[ToleranceProfile, ...] = (GB_50204, EN_13670_CLASS_1, EN_13670_CLASS_2)
"""All tolerance profiles, in report order."""

TOLERANCES = tuple((profile, tolerance) for profile in PROFILES for tolerance in profile.tolerances)
"""All tolerances with their profiles, in report order."""


def pass_sample(tolerance: Tolerance) -> str:
    """Return the name of a tolerance's 0/1 sample and of the pass-rate measure over it."""
    return f"pass_{tolerance.key}"


def process_capability(tolerance_mm: float, p95_mm: float) -> float:
    """Return the capability index tolerance / p95 of the absolute error, akin to the process capability Cp.

    It is 1 or more if 95 % of the errors are within the tolerance, and inf for a p95 of 0. Raises ``ValueError``
    for a tolerance that is not positive and finite, or a p95 that is negative or NaN.
    """
    if not 0 < tolerance_mm < math.inf:
        raise ValueError(f"tolerance_mm is {tolerance_mm}, expected a positive length")
    if not p95_mm >= 0:
        raise ValueError(f"p95_mm is {p95_mm}, expected 0 or more")
    return tolerance_mm / p95_mm if p95_mm > 0 else math.inf
