"""Template context of a submission's page: status, tables, views sorted worst first, and error maps."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fastapi import HTTPException

from leaderboard.db.models import SubmissionModel
from leaderboard.db.rankings import LeaderboardEntry, picture_facts, queue_position, submitter_name
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, result_json, result_notes
from leaderboard.names import confused_scripts
from leaderboard.service import Service
from leaderboard.web.pages.disclosed import disclosed_context
from leaderboard.web.pages.rendering import PICTURE_TITLES, clean_text, format_size, format_time, link
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.reporting.charts import score_charts
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
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
class PicturedView:
    """A view with pictures: its numbers, their size in pixels, kinds and the texts of their colour bars.

    ``near``, ``far`` and ``limit`` are empty in submissions that an earlier version scored.
    """

    row: ScoreRow
    view_id: str
    width: int
    height: int
    kinds: list[str]
    near: str
    far: str
    limit: str


MAX_OTHERS = 50
"""Number of submissions offered for a comparison."""
_UNREADABLE = "The stored result was written by another version of this software, which must show it."


def submission_context(service: Service, record: SubmissionModel, full_config: str | None) -> dict[str, Any]:
    """Return the template context of a submission's page.

    Of the config ``full_config`` all views are listed, of the others the worst.
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
            *_details(record),
        ],
        "code_link": link(json.loads(record.details).get("code_url")),
        "scripts": confused_scripts(record.method),
        "archive_deleted": record.archive_deleted_at is not None,
        "submitter": printable(submitter_name(database, record)),
        "created": format_time(record.created_at),
        "finished": None if record.finished_at is None else format_time(record.finished_at),
        "sha256": record.archive_sha256,
        "size": format_size(record.archive_bytes),
        "reason": clean_text(record.reason),
        **(_result_context(service, record, full_config) if record.status == SCORED else {"scored": False}),
    }


def _details(record: SubmissionModel) -> list[tuple[str, str]]:
    """Return heading and text of what the submitter says about the method."""
    details = json.loads(record.details)
    parameters, seconds = details.get("parameters"), details.get("seconds_per_view")
    texts = {
        "Training data": clean_text(details.get("training_data")),
        "Parameters": f"{parameters:,}" if isinstance(parameters, int) else printable(str(parameters or "")),
        "Runtime per view": "" if seconds is None else f"{seconds:.3g} s",
        "Licence": printable(details.get("licence") or ""),
    }
    return [(name, text) for name, text in texts.items() if text]


def _result_context(service: Service, record: SubmissionModel, full_config: str | None) -> dict[str, Any]:
    data = result_json(service.database, record.id)
    if data is None:  # Deleted since its row was read.
        raise HTTPException(404, "no such submission")
    ranks = _entries(service, record)
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
        "pictured": _pictured_views(service, record.id, result),
        "notes": [clean_text(note) for note in result_notes(service.database, record.id)],
        "others": _others(service, record, ranks),
        "depth_bar": colour_bar_uri(DEPTH_COLOURS[::-1]),
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


def _entries(service: Service, record: SubmissionModel) -> dict[str, LeaderboardEntry]:
    """Return the ranked rows of a public submission by config."""
    if not record.public:
        return {}
    entries = {config: service.rankings.of(config).by_id.get(record.id) for config in service.folder.configs}
    return {config: entry for config, entry in entries.items() if entry is not None and entry.rank is not None}


def _others(
    service: Service, record: SubmissionModel, ranks: Mapping[str, LeaderboardEntry]
) -> list[tuple[str, str]]:
    """Return id and name of the best other submissions of the first config, for a comparison."""
    config = next(iter(ranks), None)
    entries = service.rankings.of(config).entries if config else ()
    others = [(entry.submission_id, printable(entry.method, 60)) for entry in entries]
    return [other for other in others if other[0] != record.id][:MAX_OTHERS]


def _pictured_views(service: Service, submission_id: str, result: Result) -> list[PicturedView]:
    """Return the views with pictures, grouped by config and sorted worst first."""
    pictures = picture_facts(service.database, submission_id)
    views = [view for view in result.views if view.view_id in pictures]
    order = {config: index for index, config in enumerate(result.tables)}
    views.sort(key=lambda view: (order[config_of(view.view_id)], -sort_key_worst_first(view)))
    return [_pictured_view(service, view, *pictures[view.view_id]) for view in views]


def _pictured_view(
    service: Service, view: ViewScore, facts: Mapping[str, Any], kinds: Sequence[str]
) -> PicturedView:
    height, width = service.folder.config(config_of(view.view_id)).grid
    step = max(1, round(width / PANEL_WIDTH))
    return PicturedView(
        row=view_row(view),
        view_id=view.view_id,
        width=facts.get("width", math.ceil(width / step)),
        height=facts.get("height", math.ceil(height / step)),
        kinds=[kind for kind in PICTURE_TITLES if kind in kinds],
        near=facts.get("near", ""),
        far=facts.get("far", ""),
        limit=facts.get("limit", ""),
    )
