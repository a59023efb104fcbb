"""Which views to match a view with, and between which depths: both from the sparse points."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rebar_depth_bench.cameras import camera_centre
from rebar_depth_bench.methods.multiview.structure import Structure

NEIGHBOURS = 4
BEST_ANGLE_DEG = 12.0
NARROWER_DEG, WIDER_DEG = 6.0, 10.0
"""How fast a pair's worth falls off below and above the best angle between its rays."""
RANGE_MARGIN = 0.15
RANGE_PERCENTILES = (1.0, 99.0)


def neighbours(structure: Structure) -> Mapping[str, tuple[str, ...]]:
    """Return each view's neighbours, best first: shared points, each weighed by the angle between its two rays.

    Source of the weighing: Y. Yao et al., "MVSNet", ECCV 2018, section 4.1.
    """
    names = list(structure.cam_from_sfm)
    centres = {name: camera_centre(structure.cam_from_sfm[name]) for name in names}
    found = {}
    for name in names:
        worth = {other: _worth(structure, name, other, centres) for other in names if other != name}
        ranked = sorted((other for other in worth if worth[other] > 0), key=lambda other: -worth[other])
        found[name] = tuple(ranked[:NEIGHBOURS])
    return found


def depth_range(structure: Structure, name: str) -> tuple[float, float]:
    """Return the nearest and farthest depth worth looking at in a view, with a margin."""
    near, far = np.percentile(structure.depths(name), RANGE_PERCENTILES)
    return float(near) * (1 - RANGE_MARGIN), float(far) * (1 + RANGE_MARGIN)


def _worth(structure: Structure, one: str, other: str, centres: Mapping[str, np.ndarray]) -> float:
    shared = np.intersect1d(structure.seen[one], structure.seen[other], assume_unique=True)
    if not len(shared):
        return 0.0
    first = structure.points[shared] - centres[one]
    second = structure.points[shared] - centres[other]
    cosine = (first * second).sum(axis=1) / (np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1))
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    width = np.where(angle_deg < BEST_ANGLE_DEG, NARROWER_DEG, WIDER_DEG)
    return float(np.exp(-(((angle_deg - BEST_ANGLE_DEG) / width) ** 2) / 2).sum())
