"""What the KITTI check says: means over images, what they were measured on, and whether they may be compared."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from rebar_depth_bench.scoring.bootstrap import Interval, interval, resample
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE
from rebar_depth_bench.scoring.provenance import Stamp
from rebar_depth_bench.studies.kitti.ground_truth import EXPECTED_IMAGES, GroundTruth, LidarDepth
from rebar_depth_bench.studies.kitti.metrics import METRIC_NAMES, ImageScore, KittiMetrics

SCALE = "scale_median"
NUMBERS = (*(f"{way}.{name}" for way in ("native", "scaled") for name in METRIC_NAMES), SCALE)


@dataclass(frozen=True)
class KittiProtocol:
    """How it was measured: ground truth, crop, cap in metres, and what a laser point's depth is."""

    ground_truth: GroundTruth
    crop: str
    cap_m: float
    lidar_depth: LidarDepth


@dataclass(frozen=True)
class KittiTable:
    """Means over ``images_scored`` of the ``images`` with a pixel that counts; ``scale_median`` over them too.

    ``intervals`` has a 95 % block bootstrap interval of each of ``NUMBERS``. ``complete`` says that nothing is
    missing which could help: every image has a value, and coverage is at least that of a ranked row.
    """

    images: int
    images_scored: int
    coverage: float
    complete: bool
    native: KittiMetrics | None
    scaled: KittiMetrics | None
    scale_median: float | None
    intervals: Mapping[str, Interval | None]


@dataclass(frozen=True)
class KittiResult:
    """The check's numbers. ``missing`` names the images of the list without ground truth in the folder."""

    stamp: Stamp
    method: str
    protocol: KittiProtocol
    found: int
    missing: Sequence[str]
    table: KittiTable
    images: Sequence[ImageScore]

    @property
    def is_published_set(self) -> bool:
        """Whether as many images have ground truth as in the published set."""
        return self.found == EXPECTED_IMAGES[self.protocol.ground_truth]

    def to_dict(self) -> dict[str, Any]:
        """Return the check's JSON object."""
        table = {**vars(self.table), "native": _plain(self.table.native), "scaled": _plain(self.table.scaled)}
        images = [{**vars(one), "native": _plain(one.native), "scaled": _plain(one.scaled)} for one in self.images]
        kitti = {**vars(self.protocol), "found": self.found, "missing": list(self.missing)}
        return {**self.stamp.to_dict(), "method": self.method, "kitti": kitti, "table": table, "images": images}


def tabulate_images(images: Sequence[ImageScore]) -> KittiTable:
    """Return the means over one or more images, in the split's order."""
    scored = [one for one in images if one.native is not None]
    coverage = math.fsum(one.coverage for one in images) / len(images)
    scales = [one.scale for one in scored if one.scale is not None]
    return KittiTable(
        images=len(images),
        images_scored=len(scored),
        coverage=coverage,
        complete=len(scored) == len(images) and coverage >= MIN_RANKED_COVERAGE,
        native=_mean([one.native for one in scored if one.native]),
        scaled=_mean([one.scaled for one in scored if one.scaled]),
        scale_median=median(scales) if scales else None,
        intervals=_intervals(images),
    )


def _mean(metrics: Sequence[KittiMetrics]) -> KittiMetrics | None:
    if not metrics:
        return None
    return KittiMetrics(
        *(math.fsum(getattr(one, name) for one in metrics) / len(metrics) for name in METRIC_NAMES)
    )


def _intervals(images: Sequence[ImageScore]) -> dict[str, Interval | None]:
    resampling = resample(range(len(images)))
    rows = [[_number(one, name) for name in NUMBERS] for one in images]
    values = np.array(rows, dtype=np.float64).reshape(len(images), len(NUMBERS))
    draws = resampling.means(values)
    present = np.flatnonzero(~np.isnan(values[:, -1]))
    draws[:, -1] = resampling.percentile(values[present, -1], present, 50)
    return {name: interval(draws[:, place]) for place, name in enumerate(NUMBERS)}


def _number(one: ImageScore, name: str) -> float:
    way, _, key = name.partition(".")
    value = one.scale if name == SCALE else getattr(getattr(one, way), key, None)
    return math.nan if value is None else float(value)


def _plain(metrics: KittiMetrics | None) -> dict[str, float | None]:
    return {name: getattr(metrics, name, None) for name in METRIC_NAMES}
