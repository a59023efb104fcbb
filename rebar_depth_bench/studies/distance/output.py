"""The study ``distance`` in words: its JSON, its CSV rows, its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.lines import HEIGHT, LEFT, RIGHT, TOP, ChartWords, Series, chart, span_axis
from rebar_depth_bench.reporting.html.study_page import PageFigure, PageTable, StudyPage
from rebar_depth_bench.scoring.bootstrap import MIN_VIEWS
from rebar_depth_bench.studies.distance.study import ALL, Bin, DistanceStudy, Estimate, Slope, ViewPoint


def content(study: DistanceStudy) -> dict[str, Any]:
    """Return the JSON object: the stamp, slopes, bins, and every view's distance, scale and errors."""
    return {
        "study": "distance",
        **study.stamp.to_dict(),
        "bins_per_decade": study.bins_per_decade,
        "slopes": [asdict(slope) for slope in study.slopes],
        "bins": [asdict(one) for one in study.bins],
        "views": [_view(point) for point in study.points],
    }


def rows(study: DistanceStudy) -> list[dict[str, Any]]:
    """Return the CSV's rows: one per config and bin, with the stamps as columns."""
    stamp = study.stamp
    return [
        {
            "study": "distance",
            "protocol": stamp.protocol,
            "method": stamp.archives[0].method,
            **{
                name: getattr(one, name)
                for name in ("config", "low_m", "high_m", "distance_m", "views", "views_scored")
            },
            **_estimate("scale_median", one.scale),
            "scale_min": one.scale_range[0] if one.scale_range else None,
            "scale_max": one.scale_range[1] if one.scale_range else None,
            **_estimate("native_abs_rel", one.native_abs_rel),
            **_estimate("scaled_abs_rel", one.scaled_abs_rel),
            **stamp.csv_cells(),
        }
        for one in study.bins
    ]


def page(study: DistanceStudy) -> StudyPage:
    """Return the page: s over distance, both errors over distance, slopes and bins."""
    method = formatting.printable(study.stamp.archives[0].method)
    return StudyPage(
        study="distance",
        title=f"{method} over distance: native, and scaled by an oracle median per view",
        lead=" ".join([_slope_sentence(study.slopes[-1]), *_reversal(study.slopes[-1], study.bins)]),
        stamps=study.stamp.lines(),
        figures=(_scale_figure(study), _error_figure(study)),
        tables=(_slope_table(study.slopes), _bin_table(study.bins)),
        notes=_notes(study),
    )


def _slope_sentence(slope: Slope) -> str:
    value, interval = slope.slope.value, slope.slope.interval
    name = "All configs together" if slope.config == ALL else formatting.printable(slope.config)
    if value is None:
        return f"{name}: no slope, for its views with a prediction are too few or all about as far."
    verb = "falls" if value < 0 else "grows"
    power = f"s {verb} as distance to the power {formatting.number(value, 3)}"
    if interval is None:
        return f"{name}: {power}, from too few views for an interval."
    between = f"(95 % interval {_interval(interval, 3)})"
    if interval[0] <= 0 <= interval[1]:
        return f"{name}: {power} {between}, so one scale may serve all distances."
    return f"{name}: {power} {between}: twice the distance, {formatting.number(2**value, 3)} times the scale."


def _reversal(slope: Slope, bins: Sequence[Bin]) -> list[str]:
    """Return a sentence where near bins surely need s on one side of 1 and far ones on the other."""
    interval = slope.slope.interval
    if interval is None or interval[0] <= 0 <= interval[1]:
        return []
    known = sorted((one.distance_m, one.scale.value) for one in bins if one.scale.value is not None)
    if not known or not min(s for _, s in known) < 1 < max(s for _, s in known):
        return []
    near, far = known[0], known[-1]
    if (near[1] < 1) == (far[1] < 1):
        return []
    return [
        f"The correction reverses: the median s is {formatting.scale_cell(near[1])} at {_metres(near[0])} m and "
        f"{formatting.scale_cell(far[1])} at {_metres(far[0])} m."
    ]


def _by_config(bins: Sequence[Bin]) -> Mapping[str, list[Bin]]:
    grouped: dict[str, list[Bin]] = {}
    for one in bins:
        grouped.setdefault(one.config, []).append(one)
    return grouped


def _scale_figure(study: DistanceStudy) -> PageFigure:
    grouped = _by_config(study.bins)
    clouds = {
        config: [(p.distance_m, p.score.scale) for p in study.points if p.config == config and p.score.scale]
        for config in grouped
    }
    series = [
        Series(config, colour, clouds[config], _line(bins, "scale"), _bars(bins, "scale"))
        for colour, (config, bins) in enumerate(grouped.items())
    ]
    far = [point.distance_m for point in study.points]
    spoken = "; ".join(
        f"{one.config} at {_metres(one.distance_m)} m: {formatting.scale_cell(one.scale.value)}"
        for one in study.bins
    )
    words = ChartWords("Scale s over distance", f"Median s of each bin. {spoken}", "distance, m", "s")
    scales = [1.0, *(scale for cloud in clouds.values() for _, scale in cloud)]
    svg = chart(series, span_axis(far, LEFT, RIGHT), span_axis(scales, HEIGHT, TOP), words, reference=1.0)
    caption = (
        "Dots: views; discs: medians of bins with 95 % intervals. The dashed line is s = 1, metric as it stands: "
        "below it the prediction is too far, above it too near. A level line is one scale for all distances."
    )
    return PageFigure(svg, "Scale s = median(z) / median(p) over distance, both in log.", caption)


def _error_figure(study: DistanceStudy) -> PageFigure:
    grouped = _by_config(study.bins)
    series = [
        Series(config, colour, line=_line(bins, name), bars=_bars(bins, name), hollow=hollow)
        for colour, (config, bins) in enumerate(grouped.items())
        for name, hollow in (("native_abs_rel", False), ("scaled_abs_rel", True))
    ]
    far = [one.distance_m for one in study.bins]
    errors = [y for one in series for _, y in one.line] + [
        end for one in series for bar in one.bars for end in bar[1:]
    ]
    spoken = "; ".join(
        f"{one.config} at {_metres(one.distance_m)} m: native {formatting.number(one.native_abs_rel.value, 4)}, "
        f"scaled {formatting.number(one.scaled_abs_rel.value, 4)}"
        for one in study.bins
    )
    words = ChartWords(
        "AbsRel over distance, native and scaled", f"Means of bins. {spoken}", "distance, m", "AbsRel"
    )
    svg = chart(series, span_axis(far, LEFT, RIGHT), span_axis(errors, HEIGHT, TOP), words)
    caption = (
        "Discs: native, no alignment; rings and dashed lines: scaled, an oracle s per view. Means of bins with "
        "95 % intervals."
    )
    return PageFigure(svg, "AbsRel over distance, both in log.", caption)


def _line(bins: Sequence[Bin], name: str) -> list[tuple[float, float]]:
    found = [(one.distance_m, getattr(one, name).value) for one in bins]
    return [(x, y) for x, y in found if y is not None]


def _bars(bins: Sequence[Bin], name: str) -> list[tuple[float, float, float]]:
    found = [(one.distance_m, getattr(one, name).interval) for one in bins]
    return [(x, *interval) for x, interval in found if interval is not None]


def _slope_table(slopes: Sequence[Slope]) -> PageTable:
    return PageTable(
        caption="Slope of log s over log distance, least squares over views: 0 says that one scale serves all.",
        heads=(
            ("Config", ""),
            ("Views", "with s"),
            ("Distance", "m"),
            ("Slope", ""),
            ("Slope", "95 % interval"),
            ("s at twice the distance", "times"),
        ),
        rows=[
            (
                formatting.printable(one.config),
                str(one.views),
                f"{_metres(one.nearest_m)} to {_metres(one.farthest_m)}",
                formatting.number(one.slope.value, 3),
                _interval(one.slope.interval, 3),
                formatting.number(None if one.slope.value is None else 2**one.slope.value, 3),
            )
            for one in slopes
        ],
    )


def _bin_table(bins: Sequence[Bin]) -> PageTable:
    return PageTable(
        caption="Bins of distance: native (no alignment) and scaled (oracle median scale per view), same pixels.",
        heads=(
            ("Config", ""),
            ("Distance", "m, from to"),
            ("Views", "scored/all"),
            ("s", "median"),
            ("s", "95 % interval"),
            ("s", "least to most"),
            ("AbsRel ↓", "native"),
            ("AbsRel ↓", "95 % interval"),
            ("AbsRel ↓", "scaled"),
            ("AbsRel ↓", "95 % interval"),
        ),
        rows=[
            (
                formatting.printable(one.config),
                f"{_metres(one.low_m)} to {_metres(one.high_m)}",
                f"{one.views_scored}/{one.views}",
                formatting.scale_cell(one.scale.value),
                _interval(one.scale.interval, 3),
                _interval(one.scale_range, 3),
                formatting.number(one.native_abs_rel.value, 4),
                _interval(one.native_abs_rel.interval, 4),
                formatting.number(one.scaled_abs_rel.value, 4),
                _interval(one.scaled_abs_rel.interval, 4),
            )
            for one in bins
        ],
    )


def _notes(study: DistanceStudy) -> list[str]:
    notes = [
        "Distance of a view: the median true depth of its scored pixels. z: truth, p: prediction.",
        "Intervals resample blocks of neighbouring views: how far a number would move with other views of the "
        f"same scenes. {formatting.DASH}: undefined, or no interval from fewer than {MIN_VIEWS} views.",
    ]
    without = sum(point.score.scale is None for point in study.points)
    if without:
        notes.append(f"{without} of {len(study.points)} views have no prediction: they have neither s nor error.")
    if len(study.slopes) > 1:
        notes.append("The slope of all configs mixes distance with what else differs between their scenes.")
    return notes


def _view(point: ViewPoint) -> dict[str, Any]:
    score = point.score
    return {
        "view_id": score.view_id,
        "distance_m": point.distance_m,
        "scale": score.scale,
        "native_abs_rel": score.native.abs_rel if score.native else None,
        "scaled_abs_rel": score.scaled.abs_rel if score.scaled else None,
    }


def _estimate(name: str, estimate: Estimate) -> dict[str, float | None]:
    low, high = estimate.interval or (None, None)
    return {name: estimate.value, f"{name}_low": low, f"{name}_high": high}


def _interval(interval: tuple[float, float] | None, decimals: int) -> str:
    if interval is None:
        return formatting.DASH
    return f"{formatting.number(interval[0], decimals)} to {formatting.number(interval[1], decimals)}"


def _metres(value: float) -> str:
    return formatting.number(value, 2)
