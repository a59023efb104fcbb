"""JSON, CSV rows and page of the distance study."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.lines import HEIGHT, LEFT, RIGHT, TOP, ChartText, Series, chart, log_axis
from rebar_depth_bench.reporting.crossing_texts import FITS_NOTE, REACH_NOTE
from rebar_depth_bench.reporting.html.study_page import Columns, PageFigure, PageTable, StudyPage, page_table
from rebar_depth_bench.scoring.bootstrap import INTERVALS, MIN_BLOCKS
from rebar_depth_bench.scoring.frames import make_frame
from rebar_depth_bench.scoring.metrics import METRIC_NAMES
from rebar_depth_bench.scoring.single_bar import SingleBarScore
from rebar_depth_bench.studies.distance.reach_output import reach_sentences, reach_tables, reaches_json
from rebar_depth_bench.studies.distance.study import (
    ALL_CONFIGS,
    DistanceBin,
    DistancePoint,
    DistanceStudy,
    IntervalEstimate,
    ScaleSlope,
)

if TYPE_CHECKING:
    from pandas import DataFrame


def to_json(study: DistanceStudy) -> dict[str, Any]:
    """Return the JSON object: provenance, slopes, bins, and the distance, scale and errors of every view."""
    return {
        "study": "distance",
        **study.provenance.to_dict(),
        "intervals": dict(INTERVALS),
        "bins_per_decade": study.bins_per_decade,
        "slopes": [asdict(slope) for slope in study.slopes],
        "bins": [asdict(bin_) for bin_ in study.bins],
        "crossing_reach": {config: reaches_json(found) for config, found in study.reaches.items()},
        "views": [_view_json(point) for point in study.points],
    }


def to_pandas(study: DistanceStudy) -> DataFrame:
    """Return the rows of the CSV as a frame: one per config and bin, with the provenance in columns."""
    provenance = study.provenance
    return make_frame(
        [
            {
                "study": "distance",
                "protocol": provenance.protocol,
                "method": provenance.archives[0].method,
                **{
                    name: getattr(bin_, name)
                    for name in ("config", "low_m", "high_m", "distance_m", "views", "views_scored")
                },
                **_estimate_cells("scale_median", bin_.scale),
                "scale_min": bin_.scale_range[0] if bin_.scale_range else None,
                "scale_max": bin_.scale_range[1] if bin_.scale_range else None,
                **_estimate_cells("native_abs_rel", bin_.native_abs_rel),
                **_estimate_cells("scaled_abs_rel", bin_.scaled_abs_rel),
                **_single_bar_cells(bin_.single_bar),
                **provenance.csv_cells(),
            }
            for bin_ in study.bins
        ]
    )


def to_page(study: DistanceStudy) -> StudyPage:
    """Return the page: figures of s and of the errors over distance, tables of slopes and bins."""
    method = printable(study.provenance.archives[0].method)
    return StudyPage(
        study="distance",
        title=f"{method} over distance: native, and scaled by an oracle median per view",
        lead=" ".join(
            [
                _slope_sentence(study.slopes[-1]),
                *_reversal_sentence(study.slopes[-1], study.bins),
                *reach_sentences(study.reaches),
            ]
        ),
        stamps=study.provenance.lines(),
        figures=(_scale_figure(study), _error_figure(study)),
        tables=(
            *(reach_tables(study.reaches) if study.reaches else ()),
            _slope_table(study.slopes),
            _bin_table(study.bins),
            _single_bar_table(study.bins),
        ),
        notes=_notes(study),
    )


def _slope_sentence(slope: ScaleSlope) -> str:
    value, interval = slope.slope.value, slope.slope.interval
    name = "All configs together" if slope.config == ALL_CONFIGS else printable(slope.config)
    if value is None:
        return f"{name}: no slope: too few views have a prediction, or their distances are too similar."
    verb = "falls" if value < 0 else "grows"
    power = f"s {verb} as distance to the power {formatting.number(value, 3)}"
    if interval is None:
        return f"{name}: {power}; there are too few views for an interval."
    interval_text = f"(95 % interval {formatting.interval_text(interval, 3)})"
    if interval[0] <= 0 <= interval[1]:
        return f"{name}: {power} {interval_text}, which is consistent with one scale for all distances."
    return (
        f"{name}: {power} {interval_text}: doubling the distance multiplies s by {_format_doubling_factor(value)}."
    )


def _reversal_sentence(slope: ScaleSlope, bins: Sequence[DistanceBin]) -> list[str]:
    """Return a sentence if the correction reverses between the nearest and the farthest bin, else nothing.

    The correction reverses if the median s of these two bins lies on different sides of 1 and the interval of the
    slope excludes 0.
    """
    interval = slope.slope.interval
    if interval is None or interval[0] <= 0 <= interval[1]:
        return []
    scales = sorted((bin_.distance_m, bin_.scale.value) for bin_ in bins if bin_.scale.value is not None)
    if not scales or not min(s for _, s in scales) < 1 < max(s for _, s in scales):
        return []
    near, far = scales[0], scales[-1]
    if (near[1] < 1) == (far[1] < 1):
        return []
    return [
        f"The correction changes direction: the median s is {formatting.scale_cell(near[1])} "
        f"at {_format_metres(near[0])} m and {formatting.scale_cell(far[1])} at {_format_metres(far[0])} m."
    ]


def _group_by_config(bins: Sequence[DistanceBin]) -> Mapping[str, list[DistanceBin]]:
    grouped: dict[str, list[DistanceBin]] = {}
    for bin_ in bins:
        grouped.setdefault(bin_.config, []).append(bin_)
    return grouped


def _scale_figure(study: DistanceStudy) -> PageFigure:
    grouped = _group_by_config(study.bins)
    view_points = {
        config: [(p.distance_m, p.score.scale) for p in study.points if p.config == config and p.score.scale]
        for config in grouped
    }
    series = [
        Series(config, colour, view_points[config], _bin_points(bins, "scale"), _error_bars(bins, "scale"))
        for colour, (config, bins) in enumerate(grouped.items())
    ]
    distances_m = [point.distance_m for point in study.points]
    description = "; ".join(
        f"{bin_.config} at {_format_metres(bin_.distance_m)} m: {formatting.scale_cell(bin_.scale.value)}"
        for bin_ in study.bins
    )
    labels = ChartText("Scale s over distance", f"Median s of each bin. {description}", "distance, m", "s")
    scales = [1.0, *(scale for points in view_points.values() for _, scale in points)]
    svg = chart(series, log_axis(distances_m, LEFT, RIGHT), log_axis(scales, HEIGHT, TOP), labels, reference=1.0)
    caption = (
        "Dots: views; discs: medians of bins with 95 % intervals. The dashed line is s = 1 (no correction): below "
        "it the prediction is too far, above it too near. A horizontal line means one scale for all distances."
    )
    return PageFigure(svg, "Scale s = median(z) / median(p) over distance, both axes logarithmic.", caption)


def _error_figure(study: DistanceStudy) -> PageFigure:
    grouped = _group_by_config(study.bins)
    series = [
        Series(config, colour, line=_bin_points(bins, name), bars=_error_bars(bins, name), hollow=hollow)
        for colour, (config, bins) in enumerate(grouped.items())
        for name, hollow in (("native_abs_rel", False), ("scaled_abs_rel", True))
    ]
    distances_m = [bin_.distance_m for bin_ in study.bins]
    errors = [y for curve in series for _, y in curve.line] + [
        end for curve in series for bar in curve.bars for end in bar[1:]
    ]
    description = "; ".join(
        f"{bin_.config} at {_format_metres(bin_.distance_m)} m: "
        f"native {formatting.number(bin_.native_abs_rel.value, 4)}, "
        f"scaled {formatting.number(bin_.scaled_abs_rel.value, 4)}"
        for bin_ in study.bins
    )
    labels = ChartText(
        "AbsRel over distance, native and scaled", f"Means of bins. {description}", "distance, m", "AbsRel"
    )
    svg = chart(series, log_axis(distances_m, LEFT, RIGHT), log_axis(errors, HEIGHT, TOP), labels)
    caption = (
        "Discs: native, no alignment; rings and dashed lines: scaled, an oracle s per view. Means of bins with "
        "95 % intervals."
    )
    return PageFigure(svg, "AbsRel over distance, both axes logarithmic.", caption)


def _bin_points(bins: Sequence[DistanceBin], name: str) -> list[tuple[float, float]]:
    values = [(bin_.distance_m, getattr(bin_, name).value) for bin_ in bins]
    return [(x, y) for x, y in values if y is not None]


def _error_bars(bins: Sequence[DistanceBin], name: str) -> list[tuple[float, float, float]]:
    intervals = [(bin_.distance_m, getattr(bin_, name).interval) for bin_ in bins]
    return [(x, *interval) for x, interval in intervals if interval is not None]


def _slope_table(slopes: Sequence[ScaleSlope]) -> PageTable:
    caption = "Slope of log s over log distance, least squares over views: 0 means one scale for all distances."
    columns: Columns[ScaleSlope] = (
        ("Config", "", lambda row: printable(row.config)),
        ("Views", "with s", lambda row: str(row.views)),
        ("Distance", "m", lambda row: _format_metre_range(row.nearest_m, row.farthest_m)),
        ("Slope", "", lambda row: formatting.number(row.slope.value, 3)),
        ("Slope", "95 % interval", lambda row: formatting.interval_text(row.slope.interval, 3)),
        ("s at twice the distance", "times", lambda row: _format_doubling_factor(row.slope.value)),
    )
    return page_table(caption, columns, slopes)


def _bin_table(bins: Sequence[DistanceBin]) -> PageTable:
    caption = "Bins of distance: native (no alignment) and scaled (oracle median scale per view), same pixels."
    columns: Columns[DistanceBin] = (
        ("Config", "", lambda row: printable(row.config)),
        ("Distance", "m, from to", lambda row: _format_metre_range(row.low_m, row.high_m)),
        ("Views", "scored/all", lambda row: f"{row.views_scored}/{row.views}"),
        ("s", "median", lambda row: formatting.scale_cell(row.scale.value)),
        ("s", "95 % interval", lambda row: formatting.interval_text(row.scale.interval, 3)),
        ("s", "minimum to maximum", lambda row: formatting.interval_text(row.scale_range, 3)),
        ("AbsRel ↓", "native", lambda row: formatting.number(row.native_abs_rel.value, 4)),
        ("AbsRel ↓", "95 % interval", lambda row: formatting.interval_text(row.native_abs_rel.interval, 4)),
        ("AbsRel ↓", "scaled", lambda row: formatting.number(row.scaled_abs_rel.value, 4)),
        ("AbsRel ↓", "95 % interval", lambda row: formatting.interval_text(row.scaled_abs_rel.interval, 4)),
    )
    return page_table(caption, columns, bins)


def _single_bar_table(bins: Sequence[DistanceBin]) -> PageTable:
    caption = (
        "Single-bar interior: scored pixels whose 3 x 3 neighbourhood belongs to one bar. The other scored pixels "
        "have a second bar within one pixel, so that errors on them contain the step between the bars."
    )
    columns: Columns[DistanceBin] = (
        ("Config", "", lambda row: printable(row.config)),
        ("Distance", "m, from to", lambda row: _format_metre_range(row.low_m, row.high_m)),
        ("Share", "% of scored pixels", lambda row: formatting.coverage_percent(row.single_bar.share)),
        ("Coverage", "% of them", lambda row: formatting.coverage_percent(row.single_bar.coverage)),
        *(
            (
                f"{title} {better}",
                f"{alignment}, {unit}" if unit else alignment,
                _single_bar_cell(alignment, index),
            )
            for alignment in ("native", "scaled")
            for index, (title, unit, better) in enumerate(formatting.METRIC_HEADS)
        ),
    )
    return page_table(caption, columns, bins)


def _single_bar_cell(alignment: str, index: int) -> Callable[[DistanceBin], str]:
    return lambda row: formatting.metric_cells(getattr(row.single_bar, alignment))[index]


def _single_bar_cells(score: SingleBarScore) -> dict[str, float | None]:
    """Return the columns of the CSV with the numbers of the single-bar interior."""
    metrics = {
        f"single_bar_{alignment}_{name}": getattr(getattr(score, alignment), name, None)
        for alignment in ("native", "scaled")
        for name in METRIC_NAMES
    }
    return {"single_bar_share": score.share, "single_bar_coverage": score.coverage, **metrics}


def _notes(study: DistanceStudy) -> list[str]:
    notes = [
        "Distance of a view: the median true depth of its scored pixels. z: truth, p: prediction.",
        "Intervals: bootstrap over blocks of neighbouring views; they hold for other views of the same scenes, "
        "not for other scenes. In configs with splits: bootstrap over scenes; they hold for others of the same "
        f"generator. {formatting.DASH}: undefined, or no interval from fewer than {MIN_BLOCKS} blocks or scenes.",
    ]
    if study.reaches:
        notes += [f"Crossings: {REACH_NOTE}", FITS_NOTE]
    without = sum(point.score.scale is None for point in study.points)
    if without:
        notes.append(
            f"{without} of {len(study.points)} views have no prediction, and therefore neither s nor an error."
        )
    if len(study.slopes) > 1:
        notes.append("The slope over all configs also depends on other differences between their scenes.")
    return notes


def _view_json(point: DistancePoint) -> dict[str, Any]:
    score = point.score
    return {
        "view_id": score.view_id,
        "distance_m": point.distance_m,
        "scale": score.scale,
        "native_abs_rel": score.native.abs_rel if score.native else None,
        "scaled_abs_rel": score.scaled.abs_rel if score.scaled else None,
        "single_bar": asdict(point.single_bar),
    }


def _estimate_cells(name: str, estimate: IntervalEstimate) -> dict[str, float | None]:
    low, high = estimate.interval or (None, None)
    return {name: estimate.value, f"{name}_low": low, f"{name}_high": high}


def _format_metres(value: float) -> str:
    return formatting.number(value, 2)


def _format_metre_range(low_m: float, high_m: float) -> str:
    return f"{_format_metres(low_m)} to {_format_metres(high_m)}"


def _format_doubling_factor(slope: float | None) -> str:
    """Return the factor by which s changes over twice the distance."""
    return formatting.number(None if slope is None else 2**slope, 3)
