"""Page (also printed to the terminal) and CSV rows of the KITTI study."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.html.study_page import PageTable, StudyPage
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring.frames import make_frame
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.studies.kitti.ground_truth import EXPECTED_IMAGES
from rebar_depth_bench.studies.kitti.metrics import METRIC_NAMES, KittiMetrics
from rebar_depth_bench.studies.kitti.result import SCALE_NAME, KittiResult

if TYPE_CHECKING:
    from pandas import DataFrame

_METRIC_HEADS = (
    ("method", ""),
    ("AbsRel ↓", ""),
    ("RMSE ↓", "m"),
    ("log RMSE ↓", ""),
    ("δ1 ↑", "< 1.25"),
    ("δ2 ↑", "< 1.25²"),
    ("δ3 ↑", "< 1.25³"),
    ("s", "median"),
)
_MAX_NAMES_SHOWN = 5


def to_page(result: KittiResult) -> StudyPage:
    """Return the page of the study."""
    protocol = result.protocol
    truth = "raw LiDAR" if protocol.ground_truth == "raw" else "improved"
    return StudyPage(
        study="kitti",
        title=(
            f"KITTI Eigen split, {truth} ground truth, {result.table.images} images, crop {protocol.crop}, "
            f"cap {protocol.cap_m:g} m: native (no alignment) and scaled (oracle median scale per image)"
        ),
        lead=_lead(result),
        stamps=result.provenance.lines(),
        figures=(),
        tables=[_measured_table(result), _interval_table(result), _published_table()],
        notes=_notes(result),
    )


def to_pandas(result: KittiResult) -> DataFrame:
    """Return the rows of the CSV as a frame: one for the native and one for the scaled alignment."""
    protocol, provenance, table = result.protocol, result.provenance.to_dict(), result.table
    alignments = (("native", table.native), ("scaled", table.scaled))
    return make_frame(
        [
            {
                "protocol": provenance["protocol"],
                "method": result.method,
                "alignment": alignment,
                **vars(protocol),
                "images": table.images,
                "images_scored": table.images_scored,
                "coverage": table.coverage,
                "complete": table.complete,
                "published_set": result.is_published_set,
                **{name: getattr(metrics, name, None) for name in METRIC_NAMES},
                SCALE_NAME: table.scale_median,
                "ground_truth_digest": result.provenance.dataset_digest,
                "submission_sha256": result.provenance.archives[0].sha256,
                "software_version": provenance["software"]["version"],
            }
            for alignment, metrics in alignments
        ]
    )


def _lead(result: KittiResult) -> str:
    caveat = (
        ""
        if result.is_published_set and result.table.complete
        else "; these conditions are not met here (see the notes)"
    )
    return (
        "Check of an implementation: the numbers of a method should be close to those that its authors publish "
        f"for the same images, crop and cap{caveat}."
    )


def _measured_table(result: KittiResult) -> PageTable:
    table = result.table
    scale = formatting.scale_cell(table.scale_median)
    method = printable(result.method)
    rows = [
        [f"{method}, native", *_metric_cells(table.native), formatting.DASH],
        [f"{method}, scaled", *_metric_cells(table.scaled), scale],
    ]
    return PageTable(f"Means over {table.images_scored} of {table.images} images", _METRIC_HEADS, rows)


def _interval_table(result: KittiResult) -> PageTable:
    def cells(alignment: str) -> list[str]:
        intervals = [result.table.intervals.get(f"{alignment}.{name}") for name in METRIC_NAMES]
        intervals.append(result.table.intervals.get(SCALE_NAME) if alignment == "scaled" else None)
        return [formatting.interval_text(interval, 4) for interval in intervals]

    caption = "95 % intervals of the means: block bootstrap over images, ordered by drive and frame"
    return PageTable(
        caption, _METRIC_HEADS, [[alignment, *cells(alignment)] for alignment in ("native", "scaled")]
    )


def _published_table() -> PageTable:
    published = load_published()
    part = published.parts["kitti"]
    heads = (("method", ""), ("AbsRel ↓", ""), ("RMSE ↓", "m"), ("δ1 ↑", "< 1.25"))
    rows = [
        [row.method, *(number or formatting.DASH for number in (row.abs_rel, row.rmse_m, row.delta1))]
        for row in published.kitti
    ]
    return PageTable(
        f"Published, {part.place}, {part.protocol}: {part.mark}; crop and cap are not stated", heads, rows
    )


def _notes(result: KittiResult) -> list[str]:
    protocol, table = result.protocol, result.table
    expected = EXPECTED_IMAGES[protocol.ground_truth]
    notes = [
        "z: ground truth, p: prediction. Numbers are means over images; s = median(z)/median(p) of "
        f"each image. Pixels count inside the crop with 0.001 m < z < {protocol.cap_m:g} m; "
        "p is clamped to this range after the alignment, as in public evaluators.",
        f"{result.images_with_truth} images of the list have {protocol.ground_truth} ground truth here, "
        f"{expected} in the published set.{_missing_sentence(result)}",
    ]
    if protocol.ground_truth == "raw":
        meaning = {
            "camera": "A laser point's depth is planar z in the camera. Monodepth and its successors score "
            "against the point's x in the scanner's frame, about 0.27 m more; use --lidar-depth velodyne for it.",
            "velodyne": "A laser point's depth is its x in the scanner's frame, as in Monodepth and its "
            "successors: about 0.27 m more than planar z in the camera.",
        }
        notes.append(meaning[protocol.lidar_depth])
    if table.images < result.images_with_truth:
        notes.append(
            f"{result.images_with_truth - table.images} images have no ground truth inside the crop "
            "and are not scored."
        )
    if not table.complete:
        notes.append(
            f"Not comparable: predictions cover {formatting.coverage_percent(table.coverage)} % of the pixels "
            f"and {table.images_scored} of {table.images} images; expected at least "
            f"{MIN_COMPARABLE_COVERAGE * 100:.0f} % and all images."
        )
    return notes


def _missing_sentence(result: KittiResult) -> str:
    if not result.missing:
        return ""
    names = ", ".join(result.missing[:_MAX_NAMES_SHOWN])
    more = len(result.missing) - _MAX_NAMES_SHOWN
    return f" Missing: {names}{f' and {more} more (all in the JSON)' if more > 0 else ''}."


def _metric_cells(metrics: KittiMetrics | None) -> list[str]:
    return [formatting.number(getattr(metrics, name, None), 2 if name == "rmse_m" else 4) for name in METRIC_NAMES]
