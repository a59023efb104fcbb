"""A result as one self-contained HTML page: no requests, complete without its script, same input, same bytes.

The script sorts tables and shows views one at a time. Every text that comes from an archive or a dataset passes
``printable`` and jinja's escaping. Sections are templates of their own, ``part_*.html.j2``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from rebar_depth_bench import wording
from rebar_depth_bench.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.published import load_published
from rebar_depth_bench.report import charts
from rebar_depth_bench.report.browser import ShownView, counted, shown_views
from rebar_depth_bench.report.extended import extended_section
from rebar_depth_bench.report.panels import ViewPanels, colour_bar_uri
from rebar_depth_bench.report.paper import paper_scenes
from rebar_depth_bench.report.rows import Row, table_row, view_row
from rebar_depth_bench.report.scripts import inline_script
from rebar_depth_bench.report.templates import environment
from rebar_depth_bench.result import Result, ViewScore, badness
from rebar_depth_bench.submission import config_of

WORST_SHOWN = 10
"""Views of a config that are listed at once; the others are folded away."""


@dataclass(frozen=True)
class ConfigViews:
    """One config's views: chart, the worst ones, and all of them in protocol order where these are more."""

    name: str
    chart: Markup
    worst: list[Row]
    all: list[Row]
    views: int


def render_report(result: Result, panels: Iterable[ViewPanels], *, title: str | None = None) -> str:
    """Return the report of ``result`` with the images of each of ``panels``, config by config, worst first.

    ``panels`` may come in any order and is gone through once: only the encoded images stay in memory.
    ``title`` defaults to the method's name.
    """
    views = views_by_config(result)
    shown = shown_views(panels, list(result.tables))
    script = inline_script("sortable.js", "browser.js")
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            title=wording.printable(title if title is not None else result.method),
            method=wording.printable(result.method),
            stamps=_stamps(result),
            protocol=PROTOCOL,
            script=script.text,
            policy=script.policy,
            metric_heads=wording.METRIC_HEADS,
            tolerances=WITHIN_MM,
            dash_note=wording.DASH_NOTE,
            min_coverage=f"{MIN_RANKED_COVERAGE * 100:.0f}",
            **results_part(result, views),
            **paper_part(result),
            **_extended(result),
            **_browser(shown, views),
            **_every_view(result, views),
        )
    )


def results_part(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return what ``part_results.html.j2`` shows."""
    rows = [table_row(name, table) for name, table in result.tables.items()]
    return {
        "rows": rows,
        "dash_in_results": any(row.has_dash() for row in rows),
        "interval_note": wording.INTERVAL_NOTE if any(row.has_interval() for row in rows) else "",
        "alignment_chart": charts.alignment_chart(result.tables),
        "scale_chart": charts.scale_chart(result.tables, views),
    }


def paper_part(result: Result) -> dict[str, object]:
    """Return what ``part_paper.html.j2`` shows."""
    published = load_published()
    return {
        "paper_scenes": paper_scenes(result),
        "paper_title": published.title,
        "paper_part": published.parts["synthetic"],
    }


def _extended(result: Result) -> dict[str, object]:
    """Return what ``part_extended.html.j2`` shows, None where the archive was scored without."""
    return {"extended": None if result.extended is None else extended_section(result.extended)}


def _browser(shown: Sequence[ShownView], views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return what ``part_browser.html.j2`` shows."""
    return {
        "shown": shown,
        "shown_counts": counted(shown, {name: len(scores) for name, scores in views.items()}),
        "depth_bar": colour_bar_uri(DEPTH_COLOURS[::-1]),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
    }


def _every_view(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return what ``part_views.html.j2`` shows."""
    configs = [_config(name, views[name]) for name in result.tables]
    return {"configs": configs, "dash_in_views": any(row.has_dash() for one in configs for row in one.worst)}


def _stamps(result: Result) -> list[tuple[str, str]]:
    return [
        ("Protocol", PROTOCOL),
        ("Dataset version", wording.printable(result.dataset_version)),
        ("Dataset digest", wording.printable(result.dataset_digest)),
        ("Archive sha256", wording.printable(result.submission_sha256.removeprefix("sha256:"))),
        ("Software", f"rebar-depth-bench {wording.printable(result.software_version)}"),
    ]


def views_by_config(result: Result) -> Mapping[str, list[ViewScore]]:
    """Return the views of each config, in protocol order."""
    views: dict[str, list[ViewScore]] = {name: [] for name in result.tables}
    for view in result.views:
        views.setdefault(config_of(view.view_id), []).append(view)
    return views


def _config(name: str, views: Sequence[ViewScore]) -> ConfigViews:
    worst = sorted(views, key=badness, reverse=True)[:WORST_SHOWN]
    return ConfigViews(
        name=wording.printable(name),
        chart=charts.views_chart(name, views),
        worst=[view_row(view) for view in worst],
        all=[view_row(view) for view in views] if len(views) > WORST_SHOWN else [],
        views=len(views),
    )
