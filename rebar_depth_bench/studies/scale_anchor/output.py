"""JSON, CSV rows and page of the scale-anchor study."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from rebar_depth_bench.errors import printable
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts.lines import (
    HEIGHT,
    LEFT,
    RIGHT,
    TOP,
    ChartText,
    Series,
    chart,
    linear_axis,
    log_axis,
)
from rebar_depth_bench.reporting.html.study_page import Columns, PageFigure, PageTable, StudyPage, page_table
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring.frames import make_frame
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.studies.scale_anchor.study import AnchorRow, AnchorStudy, Spread

if TYPE_CHECKING:
    from pandas import DataFrame

_SPREAD_FIELDS = ("scale", "deviation_percent", "abs_rel_change", "rmse_cm_change")


def to_json(study: AnchorStudy) -> dict[str, Any]:
    """Return the JSON object: provenance, errors at the two fixed scales, and one row per k with all draws."""
    return {
        "study": "anchor",
        **study.provenance.to_dict(),
        "config": study.config,
        "markers": study.markers,
        "seed": study.seed,
        "views": study.views,
        "views_without_prediction": list(study.views_without_prediction),
        "coverage": study.coverage,
        "given": asdict(study.given),
        "all_views": asdict(study.all_views),
        "left_out_k": list(study.skipped_counts),
        "rows": [
            {**asdict(row), "draws": [asdict(draw) for draw in draws]}
            for row, draws in zip(study.rows, study.draws, strict=True)
        ],
    }


def to_pandas(study: AnchorStudy) -> DataFrame:
    """Return the rows of the CSV as a frame: one per k, with the provenance in columns."""
    provenance = study.provenance
    return make_frame(
        [
            {
                "study": "anchor",
                "protocol": provenance.protocol,
                "method": provenance.archives[0].method,
                "config": study.config,
                "k": row.k,
                "draws": len(draws),
                "given_scale": study.given.scale,
                "given_abs_rel": study.given.abs_rel,
                "given_rmse_cm": study.given.rmse_cm,
                **{
                    f"{name}_{key}": value
                    for name in _SPREAD_FIELDS
                    for key, value in asdict(getattr(row, name)).items()
                },
                **provenance.csv_cells(),
            }
            for row, draws in zip(study.rows, study.draws, strict=True)
        ]
    )


def to_page(study: AnchorStudy) -> StudyPage:
    """Return the page: figures of the AbsRel change and of the scale deviation over k, and the table."""
    method, config = (printable(name) for name in (study.provenance.archives[0].method, study.config))
    return StudyPage(
        study="anchor",
        title=f"{method} on {config}: one scale for the whole archive, from k views of known depth",
        lead=_lead(study),
        stamps=study.provenance.lines(),
        figures=(_change_figure(study), _scale_figure(study)),
        tables=(_table(study), _published_table(study)),
        notes=_notes(study),
    )


def _lead(study: AnchorStudy) -> str:
    first = study.rows[0]
    least, most = (formatting.counted(row.k, "view") for row in (first, study.rows[-1]))
    return (
        f"Each draw takes {first.k} to {most} of known depth, and the median over them "
        "of r = median(z / p) multiplies every view of the archive. "
        f"With {least} the scale is {_format_signed(first.deviation_percent.mean, 2)} % off the "
        f"given {study.given.scale:g} in the mean over {len(study.draws[0])} draws "
        f"(from {_format_signed(first.deviation_percent.low, 2)} to "
        f"{_format_signed(first.deviation_percent.high, 2)} %), "
        f"and AbsRel changes by {_format_signed(first.abs_rel_change.mean, 5)} "
        f"from {formatting.number(study.given.abs_rel, 4)}."
    )


def _change_figure(study: AnchorStudy) -> PageFigure:
    svg = _spread_chart(
        study,
        [(row.k, row.abs_rel_change) for row in study.rows],
        "Change of AbsRel over the number of known-depth views",
        "change of mean AbsRel",
        lambda change: _format_signed(change, 6),
    )
    caption = (
        "relative to the given scale (dashed line). Below it the anchored archive is better. Line: mean of "
        f"{len(study.draws[0])} draws; band: from the smallest to the largest draw."
    )
    return PageFigure(svg, "Change of AbsRel", caption)


def _scale_figure(study: AnchorStudy) -> PageFigure:
    svg = _spread_chart(
        study,
        [(row.k, row.deviation_percent) for row in study.rows],
        "Deviation of the scale over the number of known-depth views",
        "scale against the given one, %",
        lambda deviation: f"{_format_signed(deviation, 3)} %",
    )
    caption = "from the given one (dashed line). Line: mean of the draws; band: their range."
    return PageFigure(svg, "Deviation of the scale", caption)


def _spread_chart(
    study: AnchorStudy,
    spreads: list[tuple[int, Spread]],
    title: str,
    y_title: str,
    format_mean: Callable[[float], str],
) -> Markup:
    """Return the chart of the mean and range of draws over k, with a line at 0."""
    description = "; ".join(f"k = {k}: {format_mean(spread.mean)}" for k, spread in spreads)
    labels = ChartText(title, description, "known-depth views k", y_title)
    ks = [float(k) for k, _ in spreads]
    ends = [end for _, spread in spreads for end in (spread.low, spread.high)]
    band = Series(
        name=study.config,
        colour=0,
        line=[(k, spread.mean) for k, spread in spreads],
        area=[(k, spread.low, spread.high) for k, spread in spreads],
    )
    y_axis = linear_axis(ends, HEIGHT, TOP)
    return chart([band], log_axis(ks, LEFT, RIGHT), y_axis, labels, x_ticks=ks, reference=0.0)


def _table(study: AnchorStudy) -> PageTable:
    caption = (
        "The archive multiplied by one scale from k known-depth views, relative to the archive multiplied by "
        f"{study.given.scale:g}: mean ± standard deviation over {len(study.draws[0])} draws, and the range."
    )
    columns: Columns[AnchorRow] = (
        ("k", "views", lambda row: str(row.k)),
        ("Scale", "mean ± sd", lambda row: f"{formatting.number(row.scale.mean, 5)} ± {_format_sd(row.scale, 5)}"),
        ("Deviation", "%", lambda row: _format_change(row.deviation_percent, 3)),
        ("Deviation", "% range", lambda row: _format_range(row.deviation_percent, 3)),
        ("AbsRel change", "mean ± sd", lambda row: _format_change(row.abs_rel_change, 6)),
        ("AbsRel change", "range", lambda row: _format_range(row.abs_rel_change, 6)),
        ("RMSE change", "cm, mean ± sd", lambda row: _format_change(row.rmse_cm_change, 4)),
        ("RMSE change", "cm, range", lambda row: _format_range(row.rmse_cm_change, 4)),
    )
    return page_table(caption, columns, study.rows)


def _published_table(study: AnchorStudy) -> PageTable:
    """Return the paper's numbers beside those of the study; the RMSE is in the row of the scene's markers."""
    published = load_published()
    part, anchor = published.parts["anchor"], published.anchor
    rmse_cm = {study.markers: formatting.number(study.given.rmse_cm, 2)}
    one_view = [_format_signed(row.deviation_percent.mean, 2) for row in study.rows if row.k == 1]
    archive = f"{printable(study.provenance.archives[0].method)} on {printable(study.config)}"
    heads = (("number", ""), ("paper", ""), (archive, formatting.counted(study.views, "view")))
    rows = [
        (
            "mean scale from 1 view against the given one, %",
            f"within {anchor.one_view_scale_within_percent}",
            *(one_view or [formatting.DASH]),
        ),
        ("RMSE at the given scale, 6 markers, cm", anchor.rmse_cm_6_markers, rmse_cm.get(6, formatting.DASH)),
        ("RMSE at the given scale, 12 markers, cm", anchor.rmse_cm_12_markers, rmse_cm.get(12, formatting.DASH)),
    ]
    return PageTable(f"Published, {part.place}, {part.protocol}: {part.mark}", heads, rows)


def _notes(study: AnchorStudy) -> list[str]:
    given, all_views = study.given, study.all_views
    notes = [
        f"Given scale {given.scale:g}: AbsRel {formatting.number(given.abs_rel, 4)}, RMSE "
        f"{formatting.number(given.rmse_cm, 2)} cm. "
        f"Scale of all {study.views - len(study.views_without_prediction)} views, their median r: "
        f"{formatting.number(all_views.scale, 5)}, AbsRel {formatting.number(all_views.abs_rel, 4)}, RMSE "
        f"{formatting.number(all_views.rmse_cm, 2)} cm.",
        "Means over views on the scored pixels that have a prediction; z: truth, p: prediction. The known "
        "depth is exact and free of noise, unlike measurements with a tape or marker on a site.",
    ]
    if study.views_without_prediction:
        notes.append(
            f"{len(study.views_without_prediction)} of {study.views} views have no prediction: "
            "they are neither drawn nor scored."
        )
    if study.coverage < MIN_COMPARABLE_COVERAGE:
        notes.append(
            f"Coverage {formatting.coverage_percent(study.coverage)} %: missing predictions have no error here."
        )
    if study.skipped_counts:
        skipped = ", ".join(map(str, study.skipped_counts))
        notes.append(
            f"Skipped: k = {skipped}, more than the "
            f"{study.views - len(study.views_without_prediction)} views to draw from."
        )
    return notes


def _format_sd(spread: Spread, decimals: int) -> str:
    return formatting.number(spread.sd, decimals)


def _format_change(spread: Spread, decimals: int) -> str:
    return f"{_format_signed(spread.mean, decimals)} ± {_format_sd(spread, decimals)}"


def _format_range(spread: Spread, decimals: int) -> str:
    return f"{_format_signed(spread.low, decimals)} to {_format_signed(spread.high, decimals)}"


def _format_signed(value: float, decimals: int) -> str:
    text = formatting.number(value, decimals)
    return f"+{text}" if value > 0 else text.replace("-", "−", 1)
