"""Endpoints ``/api/v1/leaderboard`` (JSON) and ``/api/v1/leaderboard.csv``: the rows of a config."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

from anyio import to_thread
from fastapi import APIRouter, HTTPException, Query, Request, Response

from leaderboard.db.models import TokenModel
from leaderboard.db.rankings import LeaderboardEntry, entries_of_class, leaderboard_entries, ranking_version
from leaderboard.web.api.auth import WITHOUT_TOKEN, OptionalToken, service_of
from leaderboard.web.api.schemas import (
    COMMON_RESPONSES,
    MALFORMED_RESPONSE,
    UNKNOWN_TOKEN_RESPONSE,
    ErrorResponse,
    Leaderboard,
    Responses,
    row_schema,
)
from leaderboard.web.cache import NO_STORE, REVALIDATE, RenderedBody, cached_public_body, conditional_response
from rebar_depth_bench.reporting.tables import csv_text
from rebar_depth_bench.scoring.disclosure import DisclosedTable
from rebar_depth_bench.scoring.frames import TABLE_COLUMNS, table_values
from rebar_depth_bench.scoring.protocol import PROTOCOL


def entries_to_csv(rows: Sequence[LeaderboardEntry], hidden_truth: bool = False) -> str:
    """Return rows as CSV: ranks, id, method, submitter, declarations, config, then the command line's columns.

    If the ground truth is hidden, the last columns are those of the disclosed table. Undefined numbers are empty
    cells.
    """
    columns = tuple(DisclosedTable.model_fields) if hidden_truth else TABLE_COLUMNS
    header = ["rank", "class_rank", "id", "method", "submitter", "inputs", "uses_ground_truth", "config"]
    cells = (
        [
            *(row.rank, row.class_rank, row.submission_id, row.method, row.submitter),
            *(row.inputs, row.uses_ground_truth, row.config),
            *(json.loads(row.table_json).values() if hidden_truth else table_values(json.loads(row.table_json))),
        ]
        for row in rows
    )
    return csv_text([[*header, *columns], *cells])


router = APIRouter(prefix="/api/v1", tags=["leaderboard"], responses=COMMON_RESPONSES)

CSV = "text/csv; charset=utf-8"
ConfigName = Annotated[str, Query(max_length=100, description="name of the config", examples=["lattice"])]
_ERROR_RESPONSES: Responses = {
    **UNKNOWN_TOKEN_RESPONSE,
    404: {"model": ErrorResponse, "description": "the dataset has no such config"},
    **MALFORMED_RESPONSE,
}
_CSV_RESPONSE: Responses = {200: {"content": {"text/csv": {"schema": {"type": "string"}}}}}


InputsQuery = Annotated[
    Literal["rgb", "rgb+K", "stereo", "multi-view", "lidar"] | None,
    Query(description="only the rows that declare this input class"),
]


@router.get("/leaderboard", response_model=Leaderboard, responses=_ERROR_RESPONSES, openapi_extra=WITHOUT_TOKEN)
async def leaderboard(
    config: ConfigName, request: Request, token: OptionalToken, inputs: InputsQuery = None
) -> Response:
    """Return the public rows of a config and, with a token, those of its owner."""
    folder = service_of(request).folder

    def serialise(rows: list[LeaderboardEntry]) -> bytes:
        dataset = {"digest": folder.digest, "version": folder.version}
        models = [row_schema(row) for row in rows]
        response = Leaderboard(config=config, protocol=PROTOCOL, dataset=dataset, rows=models)
        return response.model_dump_json().encode()

    return await _leaderboard_response(request, config, inputs, token, "application/json", serialise)


@router.get(
    "/leaderboard.csv",
    responses={**_ERROR_RESPONSES, **_CSV_RESPONSE},
    response_class=Response,
    openapi_extra=WITHOUT_TOKEN,
)
async def leaderboard_csv(
    config: ConfigName, request: Request, token: OptionalToken, inputs: InputsQuery = None
) -> Response:
    """Return the rows of a config as CSV."""

    def serialise(rows: list[LeaderboardEntry]) -> bytes:
        return entries_to_csv(rows, service_of(request).settings.hidden_truth).encode()

    return await _leaderboard_response(request, config, inputs, token, CSV, serialise)


async def _leaderboard_response(
    request: Request,
    config: str,
    inputs: str | None,
    token: TokenModel | None,
    media_type: str,
    serialise: Callable[[list[LeaderboardEntry]], bytes],
) -> Response:
    """Return the serialised rows of ``config`` with declared ``inputs`` (None: all), cached without a token.

    Raises status 404 for an unknown config.
    """
    service = service_of(request)
    if config not in service.folder.configs:
        known = ", ".join(service.folder.configs)
        raise HTTPException(404, f"the dataset has no config {config!r}, expected one of {known}")
    if token is not None:
        content = await to_thread.run_sync(
            lambda: serialise(entries_of_class(leaderboard_entries(service.database, config, token), inputs))
        )
        return Response(content, media_type=media_type, headers={"Cache-Control": NO_STORE})

    def make() -> RenderedBody:
        rows = leaderboard_entries(service.database, config)
        return (media_type, config, inputs, ranking_version(rows)), serialise(entries_of_class(rows, inputs))

    body = await cached_public_body(request, [config], (media_type, config, inputs), make)
    return conditional_response(request, body, media_type, {"Cache-Control": REVALIDATE})
