"""Template context of a submission's page: status, tables, views sorted worst first, and error maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import HTTPException

from leaderboard.db.models import SubmissionModel
from leaderboard.db.rankings import error_map_views, queue_position, submitter_name
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, result_json
from leaderboard.service import Service
from leaderboard.web.pages.disclosed import disclosed_context
from leaderboard.web.pages.rendering import clean_text, format_size, format_time, link
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.reporting.charts import score_charts
from rebar_depth_bench.reporting.colormap import ERROR_COLOURS
from rebar_depth_bench.reporting.formatting import ground_truth_text, inputs_text
from rebar_depth_bench.reporting.html.page import (
    WORST_SHOWN,
    ConfigViewTables,
    paper_context,
    results_context,
    views_by_config,
)
from rebar_depth_bench.reporting.html.rows import ScoreRow, view_row
from rebar_depth_bench.reporting.html.view_images import PANEL_WIDTH, colour_bar_uri
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.result_io import read_result
from rebar_depth_bench.scoring.view_score import ViewScore, sort_key_worst_first
from rebar_depth_bench.submission import Declaration
from rebar_depth_bench.view_ids import config_of


@dataclass(frozen=True)
class ErrorMap:
    """An error map of a view: URL path below that of the submission, size in pixels, and the view's numbers."""

    path: str
    width: int
    height: int
    row: ScoreRow


_UNREADABLE = "The stored result was written by another version of this software, which must show it."


def submission_context(
    service: Service, record: SubmissionModel, full_config: str | None, ranks: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """Return the template context of a submission's page.

    Of the config ``full_config`` all views are listed, of the others the worst. ``ranks`` are its ranks by config.
    """
    database = service.database
    declared = Declaration(record.inputs, record.uses_ground_truth)
    return {
        "id": record.id,
        "status": record.status,
        "waits": record.status in (QUEUED, SCORING),
        "place": queue_position(database, record),
        "public": record.public,
        "method": printable(record.method),
        "description": clean_text(record.description),
        "link": link(record.url),
        "declared": [
            ("Inputs", inputs_text(declared)),
            ("Ground truth", ground_truth_text(declared)),
        ],
        "submitter": printable(submitter_name(database, record)),
        "created": format_time(record.created_at),
        "finished": None if record.finished_at is None else format_time(record.finished_at),
        "sha256": record.archive_sha256,
        "size": format_size(record.archive_bytes),
        "reason": clean_text(record.reason),
        **(
            _result_context(service, record, full_config, ranks or {})
            if record.status == SCORED
            else {"scored": False}
        ),
    }


def _result_context(
    service: Service, record: SubmissionModel, full_config: str | None, ranks: Mapping[str, int]
) -> dict[str, Any]:
    data = result_json(service.database, record.id)
    if data is None:  # Deleted since its row was read.
        raise HTTPException(404, "no such submission")
    try:
        if service.settings.hidden_truth:
            return {"ranks": ranks, **disclosed_context(data, record.id)}
        result = read_result(data, record.id)
    except InputError:
        return {"scored": False, "reason": _UNREADABLE, "configs": [], "ranks": {}}
    views = views_by_config(result)
    configs = [_config_views(name, views[name], name == full_config) for name in result.tables]
    return {
        "scored": True,
        "result_protocol": result.protocol,
        "ranks": ranks,
        "configs": configs,
        "dash_in_views": any(row.has_dash() for config in configs for row in config.worst),
        "maps": _error_maps(service, record.id, result),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
        **results_context(result, views),
        **paper_context(result),
    }


def _config_views(name: str, views: Sequence[ViewScore], list_all: bool) -> ConfigViewTables:
    """Return the chart and the worst views of a config, and, if ``list_all``, all views, sorted worst first."""
    worst_first = sorted(views, key=sort_key_worst_first, reverse=True)
    return ConfigViewTables(
        name=printable(name),
        chart=score_charts.views_chart(name, views),
        worst=[view_row(view) for view in worst_first[:WORST_SHOWN]],
        all=[view_row(view) for view in worst_first] if list_all else [],
        views=len(views),
    )


def _error_maps(service: Service, submission_id: str, result: Result) -> list[ErrorMap]:
    """Return the stored error maps, grouped by config and sorted worst first."""
    view_ids = set(error_map_views(service.database, submission_id))
    mapped_views = [view for view in result.views if view.view_id in view_ids]
    order = {config: index for index, config in enumerate(result.tables)}
    mapped_views.sort(key=lambda view: (order[config_of(view.view_id)], -sort_key_worst_first(view)))
    return [_error_map(service, view) for view in mapped_views]


def _error_map(service: Service, view: ViewScore) -> ErrorMap:
    height, width = service.folder.config(config_of(view.view_id)).grid
    step = max(1, round(width / PANEL_WIDTH))
    return ErrorMap(
        f"error-maps/{view.view_id}.webp", math.ceil(width / step), math.ceil(height / step), view_row(view)
    )
