"""HTML report of a scored submission, as one self-contained page.

The page makes no requests, is complete without its script, and has the same bytes for the same input. The script
sorts tables and shows views one at a time. All text from a submission or a dataset passes through ``printable``
and Jinja's escaping. Each section has its own template, ``part_*.html.j2``. ``write_report`` also selects the
views to show and loads their images.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.diagnosis.corrections import COLUMNS, diagnosed_view, positions_to_read
from rebar_depth_bench.diagnosis.diagnose import PossibleMistake, diagnose_config
from rebar_depth_bench.reporting import charts
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.assets import environment, inline_script
from rebar_depth_bench.reporting.html.views import (
    VIEWS_SHOWN,
    ShownView,
    ViewPanels,
    colour_bar_uri,
    shown_view,
    sorted_views,
    views_to_show,
    worst_first,
)
from rebar_depth_bench.reporting.published import OTHER_OPTICS_NOTE, load_published, paper_scenes
from rebar_depth_bench.scoring import formatting
from rebar_depth_bench.scoring.columns import ALIGNED, ALIGNED_CONSTANT, ALIGNED_ROBUST, VIEW_COLUMNS, has_dash
from rebar_depth_bench.scoring.evaluation import Evaluation, View
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.relative import aligned_depth, kind_text, metric_as
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import Table, ViewScore
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from rebar_depth_bench.reporting.html.extended import CrossingPicture

WORST_SHOWN = 10
"""Number of views of a config that are listed openly; the full list is collapsed."""
_MISTAKE_CHARACTERS = 1000
"""Largest number of characters that are shown of a possible mistake; its remedy stands at its end."""


@dataclass(frozen=True)
class ConfigViewTables:
    """View tables of one config: chart, the worst views, and all views in the order of their table.

    ``all`` is empty if that table is not shown; ``views`` is the number of views.
    """

    name: str
    chart: Markup
    worst: Sequence[ViewScore]
    all: Sequence[ViewScore]
    views: int


def render_report(
    result: Result,
    shown: Iterable[ShownView],
    mistakes: Sequence[PossibleMistake] = (),
    pictures: Mapping[str, CrossingPicture] | None = None,
) -> str:
    """Return the HTML report of ``result`` with the images of ``shown``, by config, worst view first.

    ``mistakes`` are the possible mistakes in the submission, and ``pictures`` the views with their crossings, by
    config.
    """
    views = views_by_config(result)
    shown = sorted_views(shown, list(result.tables))
    script = inline_script("static/sortable.js", "browser.js")
    content = _browser_context(shown, views)
    if result.prediction is not None:
        content |= relative_context(result, views)
    else:
        content |= {
            **results_context(result, views),
            **paper_context(result),
            **_extended_context(result, pictures or {}),
            **views_context(views, {name: of for name, of in views.items() if len(of) > WORST_SHOWN}),
        }
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            method=printable(result.method),
            stamps=_provenance(result),
            protocol=result.protocol,
            script=script.text,
            policy=script.policy,
            mistakes=[printable(mistake.text, _MISTAKE_CHARACTERS) for mistake in mistakes],
            kind=result.prediction,
            **content,
        )
    )


def results_context(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_results.html.j2``."""
    return {
        **_tables_context(result),
        "references": [
            (f"{printable(config)}: {name}", errors)
            for config, table in result.tables.items()
            for name, errors in formatting.reference_rows([("", table)])
        ],
        "group_note": formatting.GROUP_NOTE,
        "alignment_chart": charts.alignment_chart(result.tables),
        "scale_chart": charts.scale_chart(result.tables, views),
    }


def relative_context(result: Result, views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_relative.html.j2``, of predictions that are not metric."""
    robust = () if result.kind == "scale" else ALIGNED_ROBUST[1:2]
    return {
        **_tables_context(result),
        "group_note": formatting.ALIGNED_GROUP_NOTE,
        "kind_text": kind_text(result),
        "alignments": {"aligned": ALIGNED, "robust": ALIGNED_ROBUST, "constant": ALIGNED_CONSTANT},
        "aligned_note": formatting.ALIGNED_NOTE,
        "view_columns": (*ALIGNED[:5], ALIGNED[6], *robust, *ALIGNED_CONSTANT[:2]),
        "view_tables": [(printable(name), worst_first(scores), WORST_SHOWN) for name, scores in views.items()],
    }


def _tables_context(result: Result) -> dict[str, object]:
    rows = [(formatting.config_title(name, table.split), table) for name, table in result.tables.items()]
    has_intervals = any(column.interval(table) for _, table in rows for column in result.columns)
    return {
        "rows": rows,
        "row_notes": [
            (name, note)
            for name, table in rows
            for note in (*formatting.table_notes(table), *formatting.reference_findings(table))
        ],
        "dash_in_results": any(has_dash(result.columns, table) for table in result.tables.values()),
        "interval_note": formatting.interval_note(result.tables.values()) if has_intervals else "",
        "groups": [(name, _groupings(table)) for name, table in rows if any(table.groups.values())],
    }


def _groupings(table: Table) -> list[tuple[str, str, Mapping[str, Table]]]:
    """Return title, definition ("" if a later version has defined it) and tables of each grouping of a config."""
    return [
        (
            formatting.grouping_title(grouping),
            GROUPINGS[grouping].definition if grouping in GROUPINGS else "",
            tables,
        )
        for grouping, tables in table.groups.items()
        if tables
    ]


def paper_context(result: Result) -> dict[str, object]:
    """Return the context of ``part_paper.html.j2``."""
    published = load_published()
    return {
        "paper_scenes": paper_scenes(result),
        "paper_title": published.title,
        "paper_part": published.parts["synthetic"],
        "other_optics_note": OTHER_OPTICS_NOTE,
    }


def _extended_context(result: Result, pictures: Mapping[str, CrossingPicture]) -> dict[str, object]:
    """Return the context of ``part_extended.html.j2`` and ``part_crossings.html.j2``."""
    if result.extended is None:
        return {"extended": [], "crossings": []}
    # The extended measures are a third of the package, which other reports do not need.
    from rebar_depth_bench.reporting.html.extended import extended_context

    return extended_context(result.extended, pictures)


def _browser_context(shown: Sequence[ShownView], views: Mapping[str, Sequence[ViewScore]]) -> dict[str, object]:
    """Return the context of ``part_browser.html.j2``; ``shown_counts`` has a config's numbers of views."""
    configs = [view.config for view in shown]
    names = {printable(name): len(scores) for name, scores in views.items()}
    counts = [(name, configs.count(name), total) for name, total in names.items() if name in configs]
    return {
        "shown": shown,
        "shown_counts": counts,
        "partly_shown": any(count < total for _, count, total in counts),
        "depth_bar": colour_bar_uri(DEPTH_COLOURS[::-1]),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
    }


def views_context(
    views: Mapping[str, Sequence[ViewScore]], listed: Mapping[str, Sequence[ViewScore]]
) -> dict[str, object]:
    """Return the context of ``part_views.html.j2``; ``listed`` has the configs of which all views are listed."""
    configs = [
        ConfigViewTables(
            name=printable(name),
            chart=charts.views_chart(name, scores),
            worst=worst_first(scores)[:WORST_SHOWN],
            all=listed.get(name, ()),
            views=len(scores),
        )
        for name, scores in views.items()
    ]
    undefined = any(has_dash(VIEW_COLUMNS, view) for config in configs for view in config.worst)
    return {"configs": configs, "dash_in_views": undefined}


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


_COLUMNS = ("left_rgb", "left_depth", "left_mask")


@dataclass(frozen=True)
class LookedAt:
    """What was found in views of a submission: mistakes, encoded images, and pictures of crossings by config."""

    mistakes: Sequence[PossibleMistake] = ()
    shown: Sequence[ShownView] = ()
    pictures: Mapping[str, CrossingPicture] = field(default_factory=dict)


def look_at_views(
    evaluation: Evaluation,
    chosen: Mapping[str, Sequence[ViewScore]],
    *,
    crossings: bool = False,
    kind: str = METRIC,
) -> LookedAt:
    """Diagnose a submission and encode the images of the chosen views, by config, decoding each view once.

    ``kind`` is that of the scores; the images of a kind that is not metric show aligned depth.
    With ``crossings``, one view of each config that has any is pictured with its crossings. Only the rows of these
    views are read, and one is in memory at a time. Raises ``EntryError`` and ``DatasetError`` for entries and
    shards that scoring refuses.
    """
    mistakes: list[PossibleMistake] = []
    shown: list[ShownView] = []
    pictures: dict[str, CrossingPicture] = {}
    for config in evaluation.configs:
        scores = {view.view_id: view for view in chosen.get(config.name, ())}
        positions = {position for position, view_id in enumerate(config.view_ids) if view_id in scores}
        diagnosed_at = positions_to_read(config)
        pictured = None
        if crossings:
            from rebar_depth_bench.reporting.html.extended import crossing_view

            pictured = crossing_view(evaluation, config)
        wanted = {*positions, *diagnosed_at, *({pictured.position} if pictured else ())}
        columns = dict.fromkeys((*_COLUMNS, *(COLUMNS if diagnosed_at else ())))
        diagnosed = []
        for view in evaluation.views(config, tuple(columns), wanted):
            if view.position in diagnosed_at:
                diagnosed.append(diagnosed_view(view))
            if view.position in positions:
                shown.append(shown_view(view_panels(view, scores[view.view_id], evaluation.meta.prediction, kind)))
            if pictured and view.position == pictured.position:
                pictures[config.name] = pictured.picture(view)
        mistakes += diagnose_config(config, diagnosed, evaluation.submission)
    return LookedAt(mistakes, shown, pictures)


def write_report(
    result: Result, evaluation: Evaluation, target: Path, *, views_shown: int = VIEWS_SHOWN
) -> Sequence[PossibleMistake]:
    """Write the HTML report of ``result``, the scores of the submission of ``evaluation``; return its mistakes.

    Up to ``views_shown`` views of each config are shown with images: the worst by rank error, or by aligned error,
    then evenly spaced down to the best. Raises ``InputError`` if ``views_shown`` is negative.
    """
    views = views_by_config(result).items()
    chosen = {name: views_to_show(of_config, views_shown) for name, of_config in views}
    found = look_at_views(evaluation, chosen, crossings=result.extended is not None, kind=result.kind)
    write_output(target, render_report(result, found.shown, found.mistakes, found.pictures))
    return found.mistakes


def view_panels(view: View, score: ViewScore, declared: str, kind: str) -> ViewPanels:
    """Return the arrays of a view that are rendered.

    Predictions that are scored as a ``kind`` that is not metric are shown as aligned depth; ``declared`` is their
    own kind.
    """
    truth_m, mask, depth_m = view.cell("left_depth"), view.cell("left_mask"), view.prediction_m
    steel = truth_m > 0 if mask is None else mask
    if kind != METRIC:
        values = depth_m if kind == declared else metric_as(depth_m, kind)
        depth_m = aligned_depth(values, truth_m, scored_pixels(steel, truth_m), kind)
    return ViewPanels(view.cell("left_rgb"), truth_m, depth_m, steel, score)
