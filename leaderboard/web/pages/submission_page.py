"""Pages of submissions: status, tables, views sorted worst first, pictures of views, and comparisons of two."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response
from fastapi.responses import HTMLResponse

from leaderboard.changes import get_submission, outdated_note
from leaderboard.db.models import SubmissionModel
from leaderboard.db.rankings import (
    LeaderboardEntry,
    picture_facts,
    picture_webp,
    queue_position,
    submitter_name,
)
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, result_json, result_notes
from leaderboard.service import Service
from leaderboard.web.cache import NO_STORE, REVALIDATE
from leaderboard.web.dependencies import ID_PATTERN, ServiceDep, SubmissionId
from leaderboard.web.pages.ranking import DISCLOSED_COLUMNS, NameQuery
from leaderboard.web.pages.rendering import PICTURE_TITLES, clean_text, render
from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, ERROR_COLOURS
from rebar_depth_bench.reporting.formatting import ground_truth_text, inputs_text
from rebar_depth_bench.reporting.html.page import (
    paper_context,
    results_context,
    views_by_config,
    views_context,
)
from rebar_depth_bench.reporting.html.views import colour_bar_uri, worst_first
from rebar_depth_bench.reporting.tables import COMPARISON_NOTE, comparison_cells, views_note
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import Result, read_disclosed, read_result
from rebar_depth_bench.submission import Declaration
from rebar_depth_bench.submission.declaration import MethodDetails

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

MAX_OTHERS = 50
"""Number of submissions offered for a comparison."""
_UNREADABLE = "The stored result was written by another version of this software, which must show it."
_IdQuery = Annotated[str, Query(min_length=1, max_length=32, pattern=ID_PATTERN)]
PathPart = Annotated[str, Path(max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


@router.get("/submissions/{submission_id}", name="submission_page")
def submission_page(
    submission_id: SubmissionId, request: Request, service: ServiceDep, views: NameQuery = None
) -> HTMLResponse:
    """Return the page of a submission, which anyone who knows its URL may read.

    All views of the config ``views`` are listed, and the worst views of the others.
    """
    record = get_submission(service, submission_id)
    cache = _cache_control(record.public and record.status == SCORED)
    scored = _result_context(service, record, views) if record.status == SCORED else {"scored": False}
    return render(
        request,
        "submission.html.j2",
        cache=cache,
        record=record,
        waits=record.status in (QUEUED, SCORING),
        place=queue_position(service.database, record),
        submitter=submitter_name(service.database, record),
        details=_details(record),
        outdated=outdated_note(record, service.folder.digest),
        **{"reason": record.reason, **scored},
    )


@router.get("/submissions/{submission_id}/pictures/{kind}/{config}/{number}.webp", response_class=Response)
def picture(
    submission_id: SubmissionId,
    kind: Literal["colour", "truth", "prediction", "error"],
    config: PathPart,
    number: PathPart,
    service: ServiceDep,
) -> Response:
    """Return a picture of a view. Raises status 404 if it is not stored."""
    record = get_submission(service, submission_id)
    webp = picture_webp(service.database, submission_id, f"{config}/{number}", kind)
    if webp is None:
        raise HTTPException(404, "there is no such picture of this view")
    return Response(webp, media_type="image/webp", headers={"Cache-Control": _cache_control(record.public)})


@router.get("/compare")
def compare_page(request: Request, service: ServiceDep, a: _IdQuery, b: _IdQuery) -> HTMLResponse:
    """Return the comparison of two scored submissions, which anyone who knows their ids may read.

    Every metric has the paired difference and its 95 % interval. Raises status 404 if one has no result or the
    ground truth is hidden, and 422 if they cannot be compared.
    """
    records = [get_submission(service, submission_id) for submission_id in (a, b)]
    if service.settings.hidden_truth:
        raise HTTPException(404, "the ground truth is hidden; submissions are not compared view by view")
    contents = [result_json(service.database, record.id) for record in records]
    if None in contents:
        raise HTTPException(404, "the submission is not scored")
    try:
        first, other = (read_result(content or b"", "the submission") for content in contents)
        comparison = compare(first, other)
    except InputError as error:
        raise HTTPException(422, str(error)) from None
    return render(
        request,
        "comparison.html.j2",
        cache=_cache_control(all(record.public for record in records)),
        pair=records,
        compared=[
            (printable(config), views_note(differences), [comparison_cells(one) for one in differences])
            for config, differences in comparison.configs.items()
        ],
        note=COMPARISON_NOTE,
    )


def _cache_control(public: bool) -> str:
    return REVALIDATE if public else NO_STORE


def _details(record: SubmissionModel) -> dict[str, Any]:
    """Return what the submitter says about the method, with texts by heading."""
    declared = Declaration(record.inputs, record.uses_ground_truth)
    details = {**dict.fromkeys(MethodDetails.model_fields), **json.loads(record.details)}
    parameters, seconds = details["parameters"], details.get("seconds_per_view")
    digits = ".3g" if seconds is None or seconds < 100 else ",.0f"
    texts = {
        "Inputs": inputs_text(declared),
        "Ground truth": ground_truth_text(declared),
        "Training data": clean_text(details["training_data"]),
        "Parameters": f"{parameters:,}" if isinstance(parameters, int) else printable(str(parameters or "")),
        "Runtime per view": "" if seconds is None else f"{seconds:{digits}} s",
        "Licence": printable(details["licence"] or ""),
    }
    return {**details, "texts": {name: text for name, text in texts.items() if text}}


def _result_context(service: Service, record: SubmissionModel, full_config: str | None) -> dict[str, Any]:
    data = result_json(service.database, record.id)
    if data is None:  # Deleted since its row was read.
        raise HTTPException(404, "no such submission")
    context = {"scored": True, "ranks": _entries(service, record)}
    try:
        if service.settings.hidden_truth:
            disclosed = read_disclosed(data, record.id)
            return {
                **context,
                "names": list(map(printable, disclosed.tables)),
                "disclosed": disclosed.tables,
                "shown_columns": DISCLOSED_COLUMNS,
            }
        result = read_result(data, record.id)
    except InputError:
        return {"scored": False, "reason": _UNREADABLE, "names": [], "ranks": {}}
    views = views_by_config(result)
    listed = {name: worst_first(scores) for name, scores in views.items() if name == full_config}
    return {
        **context,
        "names": list(map(printable, result.tables)),
        "pictured": _pictured_views(service, record.id, result),
        "notes": result_notes(service.database, record.id),
        "others": _others(service, record),
        "depth_bar": colour_bar_uri(DEPTH_COLOURS[::-1]),
        "error_bar": colour_bar_uri(ERROR_COLOURS),
        **results_context(result, views),
        **paper_context(result),
        **views_context(views, listed),
    }


def _entries(service: Service, record: SubmissionModel) -> dict[str, LeaderboardEntry]:
    """Return the ranked rows of a public submission by config."""
    if not record.public:
        return {}
    entries = {config: service.rankings.of(config).by_id.get(record.id) for config in service.folder.configs}
    return {config: entry for config, entry in entries.items() if entry is not None and entry.rank is not None}


def _others(service: Service, record: SubmissionModel) -> list[LeaderboardEntry]:
    """Return the best other submissions of the first config in which this one is ranked, for a comparison."""
    config = next(iter(_entries(service, record)), None)
    entries = service.rankings.of(config).entries if config else ()
    return [entry for entry in entries if entry.id != record.id][:MAX_OTHERS]


def _pictured_views(service: Service, submission_id: str, result: Result) -> list[dict[str, Any]]:
    """Return the views with pictures, grouped by config and sorted worst first."""
    pictures = picture_facts(service.database, submission_id)
    views = [view for view in result.views if view.view_id in pictures]
    order = {config: index for index, config in enumerate(result.tables)}
    views.sort(key=lambda view: (order[config_of(view.view_id)], -view.error))
    return [
        {
            "score": view,
            "facts": facts,
            "kinds": [kind for kind in PICTURE_TITLES if kind in kinds],
        }
        for view in views
        for facts, kinds in [pictures[view.view_id]]
    ]
