"""A result as one self-contained HTML page: no requests, complete without its script, same input, same bytes.

The script sorts tables and shows views one at a time. Every text that comes from an archive or a dataset passes
``printable`` and jinja's escaping. Sections are templates of their own, ``part_*.html.j2``.

The report of a scored archive: picks the views to show and gathers their pictures.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rebar_depth_bench.atomic_io import write_text
from rebar_depth_bench.data.dataset import decode_row, load_undecoded
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts import score_charts
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.assets import environment, inline_script
from rebar_depth_bench.reporting.html.extended import extended_section
from rebar_depth_bench.reporting.html.published import paper_scenes
from rebar_depth_bench.reporting.html.rows import Row, table_row, view_row
from rebar_depth_bench.reporting.html.view_browser import (
    VIEWS_SHOWN,
    ShownView,
    counted,
    shown_views,
    views_to_show,
)
from rebar_depth_bench.reporting.html.view_images import ViewPanels, colour_bar_uri
from rebar_depth_bench.reporting.published import load_published
from rebar_depth_bench.scoring.protocol import MIN_RANKED_COVERAGE, PROTOCOL, WITHIN_MM
from rebar_depth_bench.scoring.result import Result, ViewScore, badness
from rebar_depth_bench.submission import SubmissionReader, config_of, open_submission

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
            title=formatting.printable(title if title is not None else result.method),
            method=formatting.printable(result.method),
            stamps=_stamps(result),
            protocol=PROTOCOL,
            script=script.text,
            policy=script.policy,
            metric_heads=formatting.METRIC_HEADS,
            tolerances=WITHIN_MM,
            dash_note=formatting.DASH_NOTE,
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
        "interval_note": formatting.INTERVAL_NOTE if any(row.has_interval() for row in rows) else "",
        "alignment_chart": score_charts.alignment_chart(result.tables),
        "scale_chart": score_charts.scale_chart(result.tables, views),
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
        ("Dataset version", formatting.printable(result.dataset_version)),
        ("Dataset digest", formatting.printable(result.dataset_digest)),
        ("Archive sha256", formatting.printable(result.submission_sha256.removeprefix("sha256:"))),
        ("Software", f"rebar-depth-bench {formatting.printable(result.software_version)}"),
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
        name=formatting.printable(name),
        chart=score_charts.views_chart(name, views),
        worst=[view_row(view) for view in worst],
        all=[view_row(view) for view in views] if len(views) > WORST_SHOWN else [],
        views=len(views),
    )


_COLUMNS = ("view_id", "left_rgb", "left_depth", "left_mask")


def write_report(
    result: Result,
    archive: str | os.PathLike[str],
    root: str | Path,
    target: Path,
    *,
    views_shown: int = VIEWS_SHOWN,
) -> None:
    """Write the HTML report of ``result``, which came from scoring ``archive`` on ``root``.

    Of each config up to ``views_shown`` views are shown in pictures: the worst by native AbsRel, then evenly down
    to the best. Raises ``InputError`` where ``views_shown`` is negative.
    """
    chosen = {
        config: views_to_show([view for view in result.views if config_of(view.view_id) == config], views_shown)
        for config in result.tables
    }
    folder = open_folder(root)
    with open_submission(archive, folder.expected_views()) as submission:
        page = render_report(result, panels_of(chosen, root, submission))
    write_text(target, page)


def panels_of(
    chosen: Mapping[str, list[ViewScore]], root: str | Path, submission: SubmissionReader
) -> Iterator[ViewPanels]:
    """Yield the arrays of the chosen views one view at a time; rows of other views are streamed past undecoded."""
    for config, views in chosen.items():
        scores = {view.view_id: view for view in views}
        if scores:
            for row in load_undecoded(root, config, streaming=True, columns=_COLUMNS):
                if row["view_id"] in scores:
                    yield _panels(scores[row["view_id"]], decode_row(row), submission)


def _panels(score: ViewScore, row: Mapping[str, Any], submission: SubmissionReader) -> ViewPanels:
    return ViewPanels(
        view_id=score.view_id,
        rgb=row["left_rgb"],
        truth_m=row["left_depth"],
        prediction_m=submission.read(score.view_id),
        steel=row["left_mask"],
        score=score,
    )
