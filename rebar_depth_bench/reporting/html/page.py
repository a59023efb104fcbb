"""HTML report of a scored submission, as one self-contained page.

The page makes no requests, is complete without its script, and has the same bytes for the same input. The script
sorts tables and shows views one at a time. All text from a submission or a dataset passes through ``printable``
and Jinja's escaping. Each section has its own template, ``part_*.html.j2``. ``write_report`` also selects the
views to show and loads their images.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rebar_depth_bench.data.rows import RowDecoder, iterate_undecoded
from rebar_depth_bench.diagnosis.diagnose import PossibleMistake
from rebar_depth_bench.errors import printable
from rebar_depth_bench.names import config_of
from rebar_depth_bench.outputs import write_output
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts import score_charts
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.assets import environment, inline_script
from rebar_depth_bench.reporting.html.crossing_picture import crossing_pictures
from rebar_depth_bench.reporting.html.crossings import CrossingPicture, crossing_section
from rebar_depth_bench.reporting.html.extended import extended_section
from rebar_depth_bench.reporting.html.groups import config_groups
from rebar_depth_bench.reporting.html.published import paper_scenes
from rebar_depth_bench.reporting.html.rows import METRIC_HEADS, ScoreRow, table_row, view_row
from rebar_depth_bench.reporting.html.view_browser import (
    VIEWS_SHOWN,
    ShownView,
    shown_counts,
    shown_views,
    views_to_show,
)
from rebar_depth_bench.reporting.html.view_images import ViewPanels, colour_bar_uri
from rebar_depth_bench.reporting.published import OTHER_OPTICS_NOTE, load_published
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.protocol import WITHIN_MM
from rebar_depth_bench.scoring.result import Result, ViewScore
from rebar_depth_bench.submission import SubmissionReader

WORST_SHOWN = 10
"""Number of views of a config that are listed openly; the full list is collapsed."""


@dataclass(frozen=True)
class ConfigViewTables:
    """View tables of one config: chart, rows of the worst views, and rows of all views in protocol order.

    ``all`` is empty if the worst views are all views.
    """

    name: str
    chart: Markup
    worst: list[ScoreRow]
    all: list[ScoreRow]
    views: int


def render_report(
    result: Result,
    panels: Iterable[ViewPanels],
    mistakes: Sequence[PossibleMistake] = (),
    pictures: Mapping[str, CrossingPicture] | None = None,
) -> str:
    """Return the HTML report of ``result`` with the images of ``panels``, by config, worst view first.

    ``panels`` may be in any order and is iterated once; only the encoded images stay in memory. ``mistakes`` are
    the possible mistakes in the submission, and ``pictures`` the views with their crossings, by config.
    """
    views = views_by_config(result)
    shown = shown_views(panels, list(result.tables))
    script = inline_script("sortable.js", "browser.js")
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            method=printable(result.method),
            stamps=_provenance(result),
            protocol=result.protocol,
            script=script.text,
            policy=script.policy,
            mistakes=[printable(mistake.text) for mistake in mistakes],
            metric_heads=METRIC_HEADS,
            tolerances=WITHIN_MM,
            dash_note=formatting.DASH_NOTE,
            **results_context(result, views),
            **paper_context(result),
            extended=None if result.extended is None else extended_section(result.extended),
            crossings=None if result.extended is None else crossing_section(result.extended, pictures or {}),
            **_browser_context(shown, views),
            **_views_context(result, views),
        )
    )


def results_context(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_results.html.j2``."""
    rows = [table_row(name, table) for name, table in result.tables.items()]
    return {
        "rows": rows,
        "references": [
            (f"{printable(config)}: {name}", native, scaled)
            for config, table in result.tables.items()
            for name, native, scaled in formatting.reference_rows([("", table)])
        ],
        "reference_note": formatting.REFERENCE_NOTE,
        "dash_in_results": any(row.has_dash() for row in rows),
        "interval_note": (
            formatting.interval_note(result.tables.values()) if any(row.has_interval() for row in rows) else ""
        ),
        "groups": config_groups(result.tables),
        "group_note": formatting.GROUP_NOTE,
        "alignment_chart": score_charts.alignment_chart(result.tables),
        "scale_chart": score_charts.scale_chart(result.tables, views),
    }


def paper_context(result: Result) -> dict[str, object]:
    """Return the context of ``part_paper.html.j2``."""
    published = load_published()
    return {
        "paper_scenes": paper_scenes(result),
        "paper_title": published.title,
        "paper_part": published.parts["synthetic"],
        "other_optics_note": OTHER_OPTICS_NOTE,
    }


def _browser_context(shown: Sequence[ShownView], views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_browser.html.j2``."""
    return {
        "shown": shown,
        "shown_counts": shown_counts(shown, {name: len(scores) for name, scores in views.items()}),
        "depth_bar": colour_bar_uri(DEPTH_COLOURS[::-1]),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
    }


def _views_context(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_views.html.j2``."""
    configs = [_config_views(name, views[name]) for name in result.tables]
    return {"configs": configs, "dash_in_views": any(row.has_dash() for config in configs for row in config.worst)}


def _provenance(result: Result) -> list[tuple[str, str]]:
    return [
        ("Protocol", result.protocol),
        ("Inputs", formatting.inputs_text(result.declared)),
        ("Ground truth", formatting.ground_truth_text(result.declared)),
        ("Dataset version", printable(result.dataset.version)),
        ("Dataset digest", printable(result.dataset.digest)),
        ("Archive sha256", printable(result.submission.sha256.removeprefix("sha256:"))),
        ("Software", f"rebar-depth-bench {printable(result.software.version)}"),
    ]


def views_by_config(result: Result) -> Mapping[str, list[ViewScore]]:
    """Return the view scores by config, in protocol order."""
    views: dict[str, list[ViewScore]] = {name: [] for name in result.tables}
    for view in result.views:
        views.setdefault(config_of(view.view_id), []).append(view)
    return views


def _config_views(name: str, views: Sequence[ViewScore]) -> ConfigViewTables:
    worst = sorted(views, key=attrgetter("rank_error"), reverse=True)[:WORST_SHOWN]
    return ConfigViewTables(
        name=printable(name),
        chart=score_charts.views_chart(name, views),
        worst=[view_row(view) for view in worst],
        all=[view_row(view) for view in views] if len(views) > WORST_SHOWN else [],
        views=len(views),
    )


_COLUMNS = ("view_id", "left_rgb", "left_depth", "left_mask")


def write_report(
    result: Result,
    evaluation: Evaluation,
    target: Path,
    *,
    mistakes: Sequence[PossibleMistake] = (),
    views_shown: int = VIEWS_SHOWN,
) -> None:
    """Write the HTML report of ``result``, the scores of the submission of ``evaluation``, and its ``mistakes``.

    Up to ``views_shown`` views of each config are shown with images: the worst by rank error, then evenly
    spaced down to the best. Raises ``InputError`` if ``views_shown`` is negative.
    """
    chosen = {
        config: views_to_show([view for view in result.views if config_of(view.view_id) == config], views_shown)
        for config in result.tables
    }
    pictures = crossing_pictures(evaluation) if result.extended is not None else {}
    write_output(target, render_report(result, iter_view_panels(chosen, evaluation), mistakes, pictures))


def iter_view_panels(chosen: Mapping[str, list[ViewScore]], evaluation: Evaluation) -> Iterator[ViewPanels]:
    """Yield the arrays of the chosen views (by config), one view at a time; other rows are not decoded."""
    for config in evaluation.configs:
        scores = {view.view_id: view for view in chosen.get(config.name, ())}
        if scores:
            decoder = RowDecoder.of(config)
            for row in iterate_undecoded(config, _COLUMNS):
                if score := scores.get(row["view_id"]):
                    yield _panels(score, decoder.row(row), evaluation.submission)


def _panels(score: ViewScore, row: Mapping[str, Any], submission: SubmissionReader) -> ViewPanels:
    return ViewPanels(
        view_id=score.view_id,
        rgb=row["left_rgb"],
        truth_m=row["left_depth"],
        prediction_m=submission.read(score.view_id),
        steel=row["left_depth"] > 0 if row["left_mask"] is None else row["left_mask"],
        score=score,
    )
