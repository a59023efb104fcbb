"""HTML report of a scored submission, as one self-contained page.

The page makes no requests, is complete without its script, and has the same bytes for the same input. The script
sorts tables and shows views one at a time. All text from a submission or a dataset passes through ``printable``
and Jinja's escaping. Each section has its own template, ``part_*.html.j2``. ``write_report`` also selects the
views to show and loads their images.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from markupsafe import Markup
from numpy import ndarray

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.base.writing import write_output
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.diagnosis.diagnose import PossibleMistake
from rebar_depth_bench.reporting import charts
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.html.assets import environment, inline_script
from rebar_depth_bench.reporting.html.views import (
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
from rebar_depth_bench.scoring.columns import (
    ALIGNED,
    ALIGNED_CONSTANT,
    ALIGNED_ROBUST,
    METRIC_COLUMNS,
    METRICS,
    Column,
    columns_at,
)
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.groups import GROUPINGS
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.relative import aligned_depth, metric_as
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.table import Table, ViewScore
from rebar_depth_bench.submission.declaration import METRIC

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


def render_report(result: Result, shown: Iterable[ShownView], mistakes: Sequence[PossibleMistake] = ()) -> str:
    """Return the HTML report of ``result`` with the images of ``shown``, by config, worst view first.

    ``mistakes`` are the possible mistakes in the submission.
    """
    views = views_by_config(result)
    shown = sorted_views(shown, list(result.tables))
    script = inline_script("static/sortable.js", "browser.js")
    content = _browser_context(shown, views)
    if result.prediction is not None:
        content |= {**relative_context(result, views), "tasks": []}
    else:
        content |= {
            **results_context(result, views),
            **paper_context(result),
            **_extended_context(result),
            **_tasks_context(result),
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
            has_archive=result.submission.sha256 is not None,
            rank_purpose_note=formatting.RANK_PURPOSE_NOTE,
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
    robust = [] if result.kind == "scale" else ["aligned_robust.abs_rel"]
    shown = ["error", *METRICS, "within_mm.5"]
    places = [*(f"aligned.{one}" for one in shown), *robust, "constant.error", "constant.abs_rel"]
    view_columns = columns_at(*places)
    context = _tables_context(result)
    return {
        **context,
        "dash_in_results": context["dash_in_results"] or _have_dash(views, view_columns),
        "group_note": formatting.ALIGNED_GROUP_NOTE,
        "kind_text": formatting.kind_text(result),
        "alignments": {"aligned": ALIGNED, "robust": ALIGNED_ROBUST, "constant": ALIGNED_CONSTANT},
        "aligned_note": formatting.ALIGNED_NOTE,
        "view_columns": view_columns,
        "view_tables": [(printable(name), worst_first(scores), WORST_SHOWN) for name, scores in views.items()],
    }


def _tables_context(result: Result) -> dict[str, object]:
    rows = [(formatting.config_title(name, table.split), table) for name, table in result.tables.items()]
    has_intervals = any(table.interval(column) for _, table in rows for column in result.columns)
    return {
        "rows": rows,
        "row_notes": [
            (name, note)
            for name, table in rows
            for note in (*formatting.table_notes(table), *formatting.reference_findings(table))
        ],
        "dash_in_results": formatting.has_dash(result),
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


def _extended_context(result: Result) -> dict[str, object]:
    """Return the context of ``part_extended.html.j2`` and ``part_crossings.html.j2``."""
    if result.extended is None:
        return {"extended": [], "crossings": []}
    # The extended measures are a third of the package, which other reports do not need.
    from rebar_depth_bench.reporting.html.extended import extended_context

    return extended_context(result.extended)


def _tasks_context(result: Result) -> dict[str, object]:
    """Return the context of ``part_tasks.html.j2``, which is shown if a bin of any config is tested."""
    if result.extended is None or not any(tasks.is_tested for tasks in result.extended.tasks.values()):
        return {"tasks": []}
    from rebar_depth_bench.reporting.tasks import tasks_context

    return tasks_context([result])


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
    return {"configs": configs, "dash_in_views": _have_dash(views, METRIC_COLUMNS)}


def _have_dash(views: Mapping[str, Sequence[ViewScore]], columns: Sequence[Column]) -> bool:
    """Return whether any of the ``columns`` is undefined in a view."""
    return any(
        not math.isfinite(view.number(column))
        for scores in views.values()
        for view in scores
        for column in columns
    )


def _provenance(result: Result) -> list[tuple[str, str]]:
    return [
        ("Protocol", result.protocol),
        ("Inputs", formatting.inputs_text(result.declared)),
        ("Ground truth", formatting.ground_truth_text(result.declared)),
        ("Dataset version", printable(result.dataset.version)),
        ("Dataset digest", printable(result.dataset.digest)),
        ("Archive sha256", printable(result.submission.sha256 or "none")),
        ("Software", f"rebar-depth-bench {printable(result.software.version)}"),
    ]


def views_by_config(result: Result) -> Mapping[str, list[ViewScore]]:
    """Return the numbers of the views of each config, in their order."""
    return {name: list(frame.views()) for name, frame in result.frames.items()}


_COLUMNS = ("view_id", "left_rgb", "left_depth", "left_mask")


def write_report(
    result: Result,
    mistakes: Sequence[PossibleMistake],
    evaluation: Evaluation | None,
    target: Path,
    *,
    views_shown: int,
) -> None:
    """Write the HTML report of ``result``; ``evaluation`` is of its submission, None without an archive.

    Up to ``views_shown`` views of each config are shown with images: the worst by rank error, or by aligned error,
    then evenly spaced down to the best. Without an archive there are none. Only the rows of these views are read,
    and one is in memory at a time. Raises ``InputError`` if ``views_shown`` is negative, and ``EntryError`` and
    ``DatasetError`` for entries and shards that scoring refuses.
    """
    chosen = {name: views_to_show(views, views_shown) for name, views in views_by_config(result).items()}
    shown: list[ShownView] = []
    if evaluation is None:
        write_output(target, render_report(result, shown, mistakes))
        return
    for config in evaluation.configs:
        scores = {view.view_id: view for view in chosen[config.name]}
        for row in iterate_rows(config, _COLUMNS, scores) if scores else ():
            prediction = evaluation.submission.read(row["view_id"])
            panels = view_panels(row, prediction, scores[row["view_id"]], evaluation.meta.prediction, result.kind)
            shown.append(shown_view(panels))
    write_output(target, render_report(result, shown, mistakes))


def view_panels(
    row: Mapping[str, Any], prediction: Float[ndarray, "h w"], score: ViewScore, declared: str, kind: str
) -> ViewPanels:
    """Return the arrays of a view that are rendered; ``row`` is its decoded row.

    Predictions that are scored as a ``kind`` that is not metric are shown as aligned depth; ``declared`` is their
    own kind.
    """
    truth_m, mask = row["left_depth"], row["left_mask"]
    scored = scored_pixels(mask, truth_m)
    if kind != METRIC:
        values = prediction if kind == declared else metric_as(prediction, kind)
        prediction = aligned_depth(values, truth_m, scored, kind)
    steel = truth_m > 0 if mask is None else mask
    return ViewPanels(row["left_rgb"], truth_m, prediction, steel, scored, score)
