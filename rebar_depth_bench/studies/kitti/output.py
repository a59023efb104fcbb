"""The KITTI check in words and cells: its page, which the terminal prints too, and its CSV row."""

from __future__ import annotations

from typing import Any

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.study_page import PageTable, StudyPage
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE
from rebar_depth_bench.studies.kitti.ground_truth import EXPECTED_IMAGES
from rebar_depth_bench.studies.kitti.metrics import METRIC_NAMES, KittiMetrics
from rebar_depth_bench.studies.kitti.result import SCALE, KittiResult

_HEADS = (
    ("method", ""),
    ("AbsRel ↓", ""),
    ("RMSE ↓", "m"),
    ("log RMSE ↓", ""),
    ("δ1 ↑", "< 1.25"),
    ("δ2 ↑", "< 1.25²"),
    ("δ3 ↑", "< 1.25³"),
    ("s", "median"),
)
_NAMES_SHOWN = 5


def study_page(result: KittiResult) -> StudyPage:
    """Return the check's page."""
    how = result.protocol
    truth = "raw LiDAR" if how.ground_truth == "raw" else "improved"
    return StudyPage(
        study="kitti",
        title=(
            f"KITTI Eigen split, {truth} ground truth, {result.table.images} images, crop {how.crop}, "
            f"cap {how.cap_m:g} m: native (no alignment) beside scaled (oracle median scale per image)"
        ),
        lead=_lead(result),
        stamps=result.stamp.lines(),
        figures=(),
        tables=[_measured(result), _intervals(result), _published()],
        notes=_notes(result),
    )


def csv_rows(result: KittiResult) -> list[dict[str, Any]]:
    """Return a line for each alignment."""
    how, stamp, table = result.protocol, result.stamp.to_dict(), result.table
    both = (("native", table.native), ("scaled", table.scaled))
    return [
        {
            "protocol": stamp["protocol"],
            "method": result.method,
            "alignment": way,
            **vars(how),
            "images": table.images,
            "images_scored": table.images_scored,
            "coverage": table.coverage,
            "complete": table.complete,
            "published_set": result.is_published_set,
            **{name: getattr(metrics, name, None) for name in METRIC_NAMES},
            SCALE: table.scale_median,
            "ground_truth_digest": result.stamp.dataset_digest,
            "submission_sha256": result.stamp.archives[0].sha256,
            "software_version": stamp["software"]["version"],
        }
        for way, metrics in both
    ]


def _lead(result: KittiResult) -> str:
    fit = "" if result.is_published_set and result.table.complete else ", which does not hold here (see the notes)"
    return (
        "A check of an implementation: a method scored here should come close to what its authors publish, on the "
        f"same images, crop and cap{fit}."
    )


def _measured(result: KittiResult) -> PageTable:
    table = result.table
    scale = formatting.scale_cell(table.scale_median)
    method = formatting.printable(result.method)
    rows = [
        [f"{method}, native", *_cells(table.native), formatting.DASH],
        [f"{method}, scaled", *_cells(table.scaled), scale],
    ]
    return PageTable(f"Means over {table.images_scored} of {table.images} images", _HEADS, rows)


def _intervals(result: KittiResult) -> PageTable:
    def cells(way: str) -> list[str]:
        ends = [result.table.intervals.get(f"{way}.{name}") for name in METRIC_NAMES]
        ends.append(result.table.intervals.get(SCALE) if way == "scaled" else None)
        return [
            formatting.DASH if one is None else " to ".join(formatting.number(end, 4) for end in one)
            for one in ends
        ]

    caption = "Their 95 % intervals: block bootstrap over images, in order of drive and frame"
    return PageTable(caption, _HEADS, [[way, *cells(way)] for way in ("native", "scaled")])


def _published() -> PageTable:
    published = load_published()
    part = published.parts["kitti"]
    heads = (("method", ""), ("AbsRel ↓", ""), ("RMSE ↓", "m"), ("δ1 ↑", "< 1.25"))
    rows = [
        [one.method, *(number or formatting.DASH for number in (one.abs_rel, one.rmse_m, one.delta1))]
        for one in published.kitti
    ]
    return PageTable(
        f"Published, {part.place}, {part.protocol}: {part.mark}; crop and cap are not stated", heads, rows
    )


def _notes(result: KittiResult) -> list[str]:
    how, table = result.protocol, result.table
    expected = EXPECTED_IMAGES[how.ground_truth]
    notes = [
        "z: ground truth, p: prediction. Means over images of each image's numbers; s = median(z)/median(p) of "
        f"each image. Pixels count inside the crop with 0.001 m < z < {how.cap_m:g} m; p is clamped to these ends "
        "after the alignment, as public evaluators do.",
        f"{result.found} images of the list have {how.ground_truth} ground truth here, {expected} in the "
        f"published set.{_missing(result)}",
    ]
    if how.ground_truth == "raw":
        meaning = {
            "camera": "A laser point's depth is planar z in the camera. Monodepth and its successors score "
            "against the point's x in the scanner's frame, about 0.27 m more: --lidar-depth velodyne does so.",
            "velodyne": "A laser point's depth is its x in the scanner's frame, as in Monodepth and its "
            "successors: about 0.27 m more than planar z in the camera.",
        }
        notes.append(meaning[how.lidar_depth])
    if table.images < result.found:
        notes.append(
            f"{result.found - table.images} images have no ground truth inside the crop and are left out."
        )
    if not table.complete:
        notes.append(
            f"Not to be compared: predictions cover {formatting.coverage_percent(table.coverage)} % of the pixels "
            f"and {table.images_scored} of {table.images} images; expected at least "
            f"{MIN_RANKED_COVERAGE * 100:.0f} % and all images."
        )
    return notes


def _missing(result: KittiResult) -> str:
    if not result.missing:
        return ""
    names = ", ".join(result.missing[:_NAMES_SHOWN])
    more = len(result.missing) - _NAMES_SHOWN
    return f" Without: {names}{f' and {more} more (all in the JSON)' if more > 0 else ''}."


def _cells(metrics: KittiMetrics | None) -> list[str]:
    return [formatting.number(getattr(metrics, name, None), 2 if name == "rmse_m" else 4) for name in METRIC_NAMES]
