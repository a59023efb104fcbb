"""Pages of submissions: status, tables, views sorted worst first, and comparisons of two."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import HTMLResponse

from leaderboard.changes import get_submission
from leaderboard.db.models import TokenModel
from leaderboard.db.rankings import queue_position
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, result_content, shown_results
from leaderboard.web.dependencies import ServiceDep, SubmissionId
from leaderboard.web.middleware import NO_STORE, REVALIDATE
from leaderboard.web.pages.rendering import render
from rebar_depth_bench.base.errors import InputError, printable
from rebar_depth_bench.reporting.html.page import (
    paper_context,
    results_context,
    views_by_config,
    views_context,
)
from rebar_depth_bench.reporting.html.views import worst_first
from rebar_depth_bench.reporting.tables import COMPARISON_NOTE, comparison_cells, views_note
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.formatting import counted
from rebar_depth_bench.scoring.reading import read_result

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

MAX_OTHERS = 50
"""Number of submissions offered for a comparison."""
_UNREADABLE = "The stored result was written by another version of this software, which must show it."


@router.get("/submissions/{submission_id}", name="submission_page")
def submission_page(
    submission_id: SubmissionId, request: Request, service: ServiceDep, views: str | None = None
) -> HTMLResponse:
    """Return the page of a submission, which anyone who knows its URL may read.

    All views of the config ``views`` are listed, and the worst views of the others.
    """
    database = service.database
    record = get_submission(service, submission_id)
    with database.read() as session:
        token = session.get_one(TokenModel, record.token_id)
    shown = shown_results(database, [record], service.folder.digest).get(record.id)
    content = None if shown is None else result_content(database, record.id, shown)
    reason, notes, tables = record.reason, list[str](), dict[str, Any]()
    if content is not None:
        try:
            result, notes = read_result(content[0], record.id), content[1]
        except InputError:
            reason = _UNREADABLE
        else:
            of_config = views_by_config(result)
            listed = {name: worst_first(scores) for name, scores in of_config.items() if name == views}
            tables = {
                **results_context(result, of_config),
                **paper_context(result),
                **views_context(of_config, listed),
            }
    rankings = {config: service.rankings.of(config) for config in service.folder.configs}
    ranked_in = {config: ranking for config, ranking in rankings.items() if record.id in ranking.by_id}
    others = next((ranking.entries for ranking in ranked_in.values()), ())
    return render(
        request,
        "submission.html.j2",
        cache=REVALIDATE if record.public and record.status == SCORED else NO_STORE,
        record=record,
        details=json.loads(record.details),
        token=token,
        waits=record.status in (QUEUED, SCORING),
        place=queue_position(database, record),
        reason=reason,
        shown=shown,
        ranked_in=ranked_in,
        notes=notes,
        others=[entry for entry in others if entry.id != record.id][:MAX_OTHERS],
        has_tables=bool(tables),
        **tables,
    )


@router.get("/compare")
def compare_page(
    request: Request, service: ServiceDep, ids: Annotated[Sequence[str], Query(alias="id")] = ()
) -> HTMLResponse:
    """Return the comparison of two scored submissions, which anyone who knows their ids may read.

    Every metric has the paired difference and its 95 % interval. Raises status 404 if one has no result, and 422
    if there are not two or they cannot be compared.
    """
    chosen = list(dict.fromkeys(ids))
    if len(chosen) != 2:
        raise HTTPException(
            422, f"{counted(len(chosen), 'row')} ticked, expected two: go back and tick two rows of a table"
        )
    records = [get_submission(service, submission_id) for submission_id in chosen]
    shown = shown_results(service.database, records, service.folder.digest)
    results = []
    try:
        for record in records:
            name = printable(record.method)
            content = record.id in shown and result_content(service.database, record.id, shown[record.id])
            if not content:
                raise HTTPException(404, f"{name} has no result")
            results.append(read_result(content[0], name))
        comparison = compare(*results)
    except InputError as error:
        raise HTTPException(422, str(error)) from None
    return render(
        request,
        "comparison.html.j2",
        cache=REVALIDATE if all(record.public for record in records) else NO_STORE,
        pair=records,
        compared=[
            (printable(config), views_note(differences), [comparison_cells(one) for one in differences])
            for config, differences in comparison.configs.items()
        ],
        note=COMPARISON_NOTE,
    )
