"""Result of the KITTI study: means over images, evaluation protocol and completeness."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from rebar_depth_bench.scoring.bootstrap import INTERVALS, Interval, interval, resample
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.provenance import Provenance
from rebar_depth_bench.studies.kitti.ground_truth import EXPECTED_IMAGES, GroundTruthKind, LidarDepthConvention
from rebar_depth_bench.studies.kitti.metrics import METRIC_NAMES, ImageScore, KittiMetrics

SCALE_NAME = "scale_median"
INTERVAL_NAMES = (
    *(f"{alignment}.{name}" for alignment in ("native", "scaled") for name in METRIC_NAMES),
    SCALE_NAME,
)


@dataclass(frozen=True)
class KittiProtocol:
    """Evaluation protocol: kind of ground truth, crop, depth cap in metres and laser depth convention."""

    ground_truth: GroundTruthKind
    crop: str
    cap_m: float
    lidar_depth: LidarDepthConvention


@dataclass(frozen=True)
class KittiTable:
    """Means of the metrics over the images.

    ``images`` counts the images with a scored pixel and ``images_scored`` those of them with a prediction; the
    means and ``scale_median`` are over the latter. ``coverage`` is the mean over all ``images``. ``intervals`` has
    a 95 % block bootstrap interval for each of ``INTERVAL_NAMES``. ``complete`` is true if every image has a
    prediction and the coverage is at least ``MIN_COMPARABLE_COVERAGE``; otherwise, missing predictions could
    improve the numbers.
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
    """Result of the KITTI study.

    ``images_with_truth`` counts the images of the split that have ground truth in the folder; ``missing`` names
    the others.
    """

    provenance: Provenance
    method: str
    protocol: KittiProtocol
    images_with_truth: int
    missing: Sequence[str]
    table: KittiTable
    images: Sequence[ImageScore]

    @property
    def is_published_set(self) -> bool:
        """Return whether the number of images with ground truth equals that of the published set."""
        return self.images_with_truth == EXPECTED_IMAGES[self.protocol.ground_truth]

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON object of the study."""
        table = {
            **vars(self.table),
            "native": _metrics_json(self.table.native),
            "scaled": _metrics_json(self.table.scaled),
        }
        images = [
            {**vars(image), "native": _metrics_json(image.native), "scaled": _metrics_json(image.scaled)}
            for image in self.images
        ]
        kitti = {**vars(self.protocol), "found": self.images_with_truth, "missing": list(self.missing)}
        return {
            **self.provenance.to_dict(),
            "intervals": dict(INTERVALS),
            "method": self.method,
            "kitti": kitti,
            "table": table,
            "images": images,
        }


def tabulate_images(images: Sequence[ImageScore]) -> KittiTable:
    """Return the means over one or more images, given in the order of the split."""
    scored = [image for image in images if image.native is not None]
    coverage = math.fsum(image.coverage for image in images) / len(images)
    scales = [image.scale for image in scored if image.scale is not None]
    return KittiTable(
        images=len(images),
        images_scored=len(scored),
        coverage=coverage,
        complete=len(scored) == len(images) and coverage >= MIN_COMPARABLE_COVERAGE,
        native=_mean_metrics([image.native for image in scored if image.native]),
        scaled=_mean_metrics([image.scaled for image in scored if image.scaled]),
        scale_median=median(scales) if scales else None,
        intervals=_intervals(images),
    )


def _mean_metrics(metrics: Sequence[KittiMetrics]) -> KittiMetrics | None:
    if not metrics:
        return None
    return KittiMetrics(
        *(
            math.fsum(getattr(image_metrics, name) for image_metrics in metrics) / len(metrics)
            for name in METRIC_NAMES
        )
    )


def _intervals(images: Sequence[ImageScore]) -> dict[str, Interval | None]:
    resampling = resample(range(len(images)))
    rows = [[_metric_value(image, name) for name in INTERVAL_NAMES] for image in images]
    values = np.array(rows, dtype=np.float64).reshape(len(images), len(INTERVAL_NAMES))
    draws = resampling.means(values)
    draws[:, -1] = resampling.medians(values[:, -1])
    blocks = resampling.blocks(np.flatnonzero(~np.isnan(values[:, 0])))
    return {name: interval(draws[:, column], blocks) for column, name in enumerate(INTERVAL_NAMES)}


def _metric_value(image: ImageScore, name: str) -> float:
    alignment, _, key = name.partition(".")
    value = image.scale if name == SCALE_NAME else getattr(getattr(image, alignment), key, None)
    return math.nan if value is None else float(value)


def _metrics_json(metrics: KittiMetrics | None) -> dict[str, float | None]:
    return {name: getattr(metrics, name, None) for name in METRIC_NAMES}
