"""What a submission's page shows: where it stands, its tables, its views worst first, its error maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import HTTPException

from leaderboard.db.models import SubmissionRecord
from leaderboard.db.rankings import picture_views, queue_place, submitter
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, result_json
from leaderboard.web.context import Service
from leaderboard.web.pages.rendering import lines, link, moment, size
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.reporting.charts import score_charts
from rebar_depth_bench.reporting.colormap import ERROR_COLOURS
from rebar_depth_bench.reporting.html.page import (
    WORST_SHOWN,
    ConfigViews,
    paper_part,
    results_part,
    views_by_config,
)
from rebar_depth_bench.reporting.html.rows import Row, view_row
from rebar_depth_bench.reporting.html.view_images import PANEL_WIDTH, colour_bar_uri
from rebar_depth_bench.scoring.result import Result, ViewScore, badness
from rebar_depth_bench.scoring.result_io import read_result
from rebar_depth_bench.submission import config_of


@dataclass(frozen=True)
class ErrorMap:
    """A view's error map: its address below the submission's, its size in pixels, its numbers."""

    path: str
    width: int
    height: int
    row: Row


def submission_part(
    service: Service, record: SubmissionRecord, all_of: str | None, placed: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """Return what a submission's page shows, its ranks by config, every view of the config ``all_of``."""
    database = service.database
    return {
        "id": record.id,
        "status": record.status,
        "waits": record.status in (QUEUED, SCORING),
        "place": queue_place(database, record),
        "public": record.public,
        "method": formatting.printable(record.method),
        "description": lines(record.description),
        "link": link(record.url),
        "intrinsics": record.uses_intrinsics,
        "submitter": formatting.printable(submitter(database, record)),
        "created": moment(record.created_at),
        "finished": None if record.finished_at is None else moment(record.finished_at),
        "sha256": record.archive_sha256,
        "size": size(record.archive_bytes),
        "reason": lines(record.reason),
        **(_scored(service, record, all_of, placed or {}) if record.status == SCORED else {"scored": False}),
    }


def _scored(
    service: Service, record: SubmissionRecord, all_of: str | None, placed: Mapping[str, int]
) -> dict[str, Any]:
    data = result_json(service.database, record.id)
    if data is None:  # deleted a moment ago
        raise HTTPException(404, "no such submission")
    result = read_result(data, record.id)
    views = views_by_config(result)
    configs = [_config(name, views[name], name == all_of) for name in result.tables]
    return {
        "scored": True,
        "ranks": placed,
        "configs": configs,
        "dash_in_views": any(row.has_dash() for one in configs for row in one.worst),
        "maps": _maps(service, record.id, result),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
        **results_part(result, views),
        **paper_part(result),
    }


def _config(name: str, views: Sequence[ViewScore], whole: bool) -> ConfigViews:
    """Return a config's chart and worst views; all of them, worst first, where these are asked for."""
    worst_first = sorted(views, key=badness, reverse=True)
    return ConfigViews(
        name=formatting.printable(name),
        chart=score_charts.views_chart(name, views),
        worst=[view_row(view) for view in worst_first[:WORST_SHOWN]],
        all=[view_row(view) for view in worst_first] if whole else [],
        views=len(views),
    )


def _maps(service: Service, submission_id: str, result: Result) -> list[ErrorMap]:
    """Return the error maps that are kept, config by config, worst first."""
    kept = set(picture_views(service.database, submission_id))
    shown = [view for view in result.views if view.view_id in kept]
    order = {config: place for place, config in enumerate(result.tables)}
    shown.sort(key=lambda view: (order[config_of(view.view_id)], -badness(view)))
    return [_map(service, view) for view in shown]


def _map(service: Service, view: ViewScore) -> ErrorMap:
    height, width = service.folder.grid(config_of(view.view_id))
    step = max(1, round(width / PANEL_WIDTH))
    return ErrorMap(
        f"error-maps/{view.view_id}.webp", math.ceil(width / step), math.ceil(height / step), view_row(view)
    )
