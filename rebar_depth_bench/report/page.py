"""A result as one self-contained HTML page: no scripts, no requests, the same bytes for the same input.

Every text that comes from an archive or a dataset passes ``printable`` and jinja's escaping.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from rebar_depth_bench import wording
from rebar_depth_bench.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.report import charts
from rebar_depth_bench.report.panels import ViewImages, ViewPanels, colour_bar_uri, view_images
from rebar_depth_bench.result import Result, Table, ViewScore, badness
from rebar_depth_bench.submission import config_of

WORST_SHOWN = 10
"""Views of a config that are listed at once; the others are folded away."""


@dataclass(frozen=True)
class _Row:
    """One config or one view, spelled: the cells of both tables."""

    name: str
    views: str
    coverage: str
    ranked: bool
    reasons: str
    native: list[str]
    scaled: list[str]
    scale: str
    within: list[str]


@dataclass(frozen=True)
class _Config:
    """One config's views: chart, the worst ones, and all of them in protocol order where these are more."""

    name: str
    chart: Markup
    worst: list[_Row]
    all: list[_Row]
    views: int


@dataclass(frozen=True)
class _Shown:
    """One panel view: its numbers, its images and what their colour bars say."""

    row: _Row
    images: ViewImages
    near: str
    far: str
    predicted: str
    off_scale: bool
    native_limit: str
    scaled_limit: str


def render_report(result: Result, panels: Sequence[ViewPanels], *, title: str | None = None) -> str:
    """Return the report of ``result`` with one row of images for each of ``panels``.

    ``title`` defaults to the method's name. The page needs no network and runs no script.
    """
    views = _views_by_config(result)
    configs = [_config(name, views[name]) for name in result.tables]
    rows = [_table_row(name, table) for name, table in result.tables.items()]
    return (
        _environment()
        .get_template("report.html.j2")
        .render(
            title=wording.printable(title if title is not None else result.method),
            method=wording.printable(result.method),
            stamps=_stamps(result),
            protocol=PROTOCOL,
            min_coverage=f"{MIN_RANKED_COVERAGE * 100:.0f}",
            metric_heads=wording.METRIC_HEADS,
            tolerances=WITHIN_MM,
            dash_note=wording.DASH_NOTE,
            dash_in_results=_any_dash(rows),
            dash_in_views=_any_dash([row for one in configs for row in one.worst]),
            rows=rows,
            alignment_chart=charts.alignment_chart(result.tables),
            scale_chart=charts.scale_chart(result.tables, views),
            configs=configs,
            panels=[_shown(view) for view in panels],
            depth_bar=colour_bar_uri(DEPTH_COLOURS[::-1]),
            error_bar=colour_bar_uri(ERROR_COLOURS),
        )
    )


def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("rebar_depth_bench", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


def _stamps(result: Result) -> list[tuple[str, str]]:
    return [
        ("Protocol", PROTOCOL),
        ("Dataset version", wording.printable(result.dataset_version)),
        ("Dataset digest", wording.printable(result.dataset_digest)),
        ("Archive sha256", wording.printable(result.submission_sha256.removeprefix("sha256:"))),
        ("Software", f"rebar-depth-bench {wording.printable(result.software_version)}"),
    ]


def _views_by_config(result: Result) -> Mapping[str, list[ViewScore]]:
    views: dict[str, list[ViewScore]] = {name: [] for name in result.tables}
    for view in result.views:
        views.setdefault(config_of(view.view_id), []).append(view)
    return views


def _config(name: str, views: Sequence[ViewScore]) -> _Config:
    worst = sorted(views, key=badness, reverse=True)[:WORST_SHOWN]
    return _Config(
        name=wording.printable(name),
        chart=charts.views_chart(name, views),
        worst=[_view_row(view) for view in worst],
        all=[_view_row(view) for view in views] if len(views) > WORST_SHOWN else [],
        views=len(views),
    )


def _table_row(name: str, table: Table) -> _Row:
    return _Row(
        name=wording.printable(name),
        views=f"{table.views_scored}/{table.views}",
        coverage=wording.coverage_percent(table.coverage),
        ranked=table.ranked,
        reasons="; ".join(wording.unranked_reasons(table)),
        native=wording.metric_cells(table.native),
        scaled=wording.metric_cells(table.scaled),
        scale=wording.scale_cell(table.scale_median),
        within=wording.within_cells(table.within_mm),
    )


def _view_row(view: ViewScore) -> _Row:
    return _Row(
        name=wording.printable(view.view_id),
        views=f"{view.scored_px:,}".replace(",", "\N{NARROW NO-BREAK SPACE}"),
        coverage=wording.coverage_percent(view.coverage),
        ranked=True,
        reasons="",
        native=wording.metric_cells(view.native),
        scaled=wording.metric_cells(view.scaled),
        scale=wording.scale_cell(view.scale),
        within=wording.within_cells(view.within_mm),
    )


def _any_dash(rows: Sequence[_Row]) -> bool:
    return wording.has_dash([*row.native, *row.scaled, row.scale, row.coverage, *row.within] for row in rows)


def _shown(view: ViewPanels) -> _Shown:
    images = view_images(view)
    predicted = images.predicted_m
    return _Shown(
        row=_view_row(view.score),
        images=images,
        near=_metres(images.near_m),
        far=_metres(images.far_m),
        predicted=f"{_metres(predicted[0])} to {_metres(predicted[1])}" if predicted else "",
        off_scale=predicted is not None and (predicted[0] > images.far_m or predicted[1] < images.near_m),
        native_limit=_centimetres(images.native_limit_cm),
        scaled_limit=_centimetres(images.scaled_limit_cm),
    )


def _metres(value: float) -> str:
    return f"{value:#.3g} m" if 0.01 <= abs(value) < 1000 else f"{value:.3g} m"


def _centimetres(value: float | None) -> str:
    return "" if value is None else f"{value:g} cm"
