"""The study ``anchor`` in words: its JSON, its CSV rows, its page."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.lines import (
    HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    ChartWords,
    Series,
    chart,
    span_axis,
    zero_axis,
)
from rebar_depth_bench.reporting.html.study_page import PageFigure, PageTable, StudyPage
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE
from rebar_depth_bench.studies.scale_anchor.study import AnchorRow, AnchorStudy, Spread

_SPREADS = ("scale", "deviation_percent", "abs_rel_change", "rmse_cm_change")


def content(study: AnchorStudy) -> dict[str, Any]:
    """Return the JSON object: the stamp, the two fixed scales, a row per k with every draw."""
    return {
        "study": "anchor",
        **study.stamp.to_dict(),
        "config": study.config,
        "seed": study.seed,
        "views": study.views,
        "views_without_prediction": list(study.unpredicted),
        "coverage": study.coverage,
        "given": asdict(study.given),
        "all_views": asdict(study.all_views),
        "left_out_k": list(study.left_out),
        "rows": [
            {**asdict(row), "draws": [asdict(draw) for draw in draws]}
            for row, draws in zip(study.rows, study.draws, strict=True)
        ],
    }


def rows(study: AnchorStudy) -> list[dict[str, Any]]:
    """Return the CSV's rows: one per k, with the stamps as columns."""
    stamp = study.stamp
    return [
        {
            "study": "anchor",
            "protocol": stamp.protocol,
            "method": stamp.archives[0].method,
            "config": study.config,
            "k": row.k,
            "draws": len(draws),
            "given_scale": study.given.scale,
            "given_abs_rel": study.given.abs_rel,
            "given_rmse_cm": study.given.rmse_cm,
            **{f"{name}_{key}": value for name in _SPREADS for key, value in asdict(getattr(row, name)).items()},
            **stamp.csv_cells(),
        }
        for row, draws in zip(study.rows, study.draws, strict=True)
    ]


def page(study: AnchorStudy) -> StudyPage:
    """Return the page: the figure of changes over k, the figure of scales, the table."""
    method, config = (formatting.printable(name) for name in (study.stamp.archives[0].method, study.config))
    return StudyPage(
        study="anchor",
        title=f"{method} on {config}: one scale for the whole archive, from k views of known depth",
        lead=_lead(study),
        stamps=study.stamp.lines(),
        figures=(_change_figure(study), _scale_figure(study)),
        tables=(_table(study),),
        notes=_notes(study),
    )


def _lead(study: AnchorStudy) -> str:
    first = study.rows[0]
    return (
        f"Each draw takes {first.k} to {_views(study.rows[-1].k)} of known depth, and the median over them of "
        "r = median(z / p) multiplies every view of the archive alike. "
        f"With {_views(first.k)} the scale is {_signed(first.deviation_percent.mean, 2)} % off the given "
        f"{study.given.scale:g} in the mean of {len(study.draws[0])} draws "
        f"(from {_signed(first.deviation_percent.low, 2)} to {_signed(first.deviation_percent.high, 2)} %), "
        f"and AbsRel changes by {_signed(first.abs_rel_change.mean, 5)} "
        f"from {formatting.number(study.given.abs_rel, 4)}."
    )


def _change_figure(study: AnchorStudy) -> PageFigure:
    changes = [(row.k, row.abs_rel_change) for row in study.rows]
    svg = _figure(
        study,
        changes,
        0.0,
        ChartWords(
            "Change of AbsRel over the number of known-depth views",
            "; ".join(f"k = {k}: {_signed(one.mean, 6)}" for k, one in changes),
            "known-depth views k",
            "change of mean AbsRel",
        ),
    )
    caption = (
        "against the given scale, the dashed line: below it the anchored archive is better. Line: mean of "
        f"{len(study.draws[0])} draws; band: from the smallest to the largest draw."
    )
    return PageFigure(svg, "Change of AbsRel", caption)


def _scale_figure(study: AnchorStudy) -> PageFigure:
    deviations = [(row.k, row.deviation_percent) for row in study.rows]
    svg = _figure(
        study,
        deviations,
        0.0,
        ChartWords(
            "Deviation of the scale over the number of known-depth views",
            "; ".join(f"k = {k}: {_signed(one.mean, 3)} %" for k, one in deviations),
            "known-depth views k",
            "scale against the given one, %",
        ),
    )
    return PageFigure(
        svg,
        "Deviation of the scale",
        "from the given one, the dashed line. Line: mean of the draws; band: their range.",
    )


def _figure(study: AnchorStudy, spreads: list[tuple[int, Spread]], reference: float, words: ChartWords) -> Any:
    ks = [float(k) for k, _ in spreads]
    ends = [end for _, one in spreads for end in (one.low, one.high)]
    band = Series(
        name=study.config,
        colour=0,
        line=[(k, one.mean) for k, one in spreads],
        area=[(k, one.low, one.high) for k, one in spreads],
    )
    y_axis = zero_axis(ends, HEIGHT, TOP)
    return chart([band], span_axis(ks, LEFT, RIGHT), y_axis, words, x_ticks=ks, reference=reference)


def _table(study: AnchorStudy) -> PageTable:
    return PageTable(
        caption=(
            "The archive times one scale from k known-depth views, against the archive times "
            f"{study.given.scale:g}: mean ± standard deviation over {len(study.draws[0])} draws, and the range."
        ),
        heads=(
            ("k", "views"),
            ("Scale", "mean ± sd"),
            ("Deviation", "%"),
            ("Deviation", "% range"),
            ("AbsRel change", "mean ± sd"),
            ("AbsRel change", "range"),
            ("RMSE change", "cm, mean ± sd"),
            ("RMSE change", "cm, range"),
        ),
        rows=[_cells(row) for row in study.rows],
    )


def _cells(row: AnchorRow) -> list[str]:
    return [
        str(row.k),
        f"{formatting.number(row.scale.mean, 5)} ± {formatting.number(row.scale.sd, 5)}",
        f"{_signed(row.deviation_percent.mean, 3)} ± {formatting.number(row.deviation_percent.sd, 3)}",
        _range(row.deviation_percent, 3),
        f"{_signed(row.abs_rel_change.mean, 6)} ± {formatting.number(row.abs_rel_change.sd, 6)}",
        _range(row.abs_rel_change, 6),
        f"{_signed(row.rmse_cm_change.mean, 4)} ± {formatting.number(row.rmse_cm_change.sd, 4)}",
        _range(row.rmse_cm_change, 4),
    ]


def _notes(study: AnchorStudy) -> list[str]:
    given, every = study.given, study.all_views
    notes = [
        f"Given scale {given.scale:g}: AbsRel {formatting.number(given.abs_rel, 4)}, RMSE "
        f"{formatting.number(given.rmse_cm, 2)} cm. Scale of all {study.views - len(study.unpredicted)} views, "
        f"their median r: {formatting.number(every.scale, 5)}, AbsRel {formatting.number(every.abs_rel, 4)}, RMSE "
        f"{formatting.number(every.rmse_cm, 2)} cm.",
        "Means over views on the scored pixels that have a prediction; z: truth, p: prediction. The anchors' "
        "truth is exact and free of noise: a tape or a marker on a site is not.",
    ]
    if study.unpredicted:
        notes.append(
            f"{len(study.unpredicted)} of {study.views} views have no prediction: neither drawn nor scored."
        )
    if study.coverage < MIN_RANKED_COVERAGE:
        notes.append(
            f"Coverage {formatting.coverage_percent(study.coverage)} %: what is missing has no error here."
        )
    if study.left_out:
        left = ", ".join(map(str, study.left_out))
        notes.append(
            f"Left out: k = {left}, more than the {study.views - len(study.unpredicted)} views to draw from."
        )
    return notes


def _range(spread: Spread, decimals: int) -> str:
    return f"{_signed(spread.low, decimals)} to {_signed(spread.high, decimals)}"


def _signed(value: float, decimals: int) -> str:
    text = formatting.number(value, decimals)
    return f"+{text}" if value > 0 else text.replace("-", "−", 1)


def _views(count: int) -> str:
    return f"{count} view" if count == 1 else f"{count} views"
