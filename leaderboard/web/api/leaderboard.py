"""``/api/v1/leaderboard``: a config's rows as JSON and CSV.

A board as CSV, with the columns of the command line's.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, HTTPException, Query, Request, Response

from leaderboard.db.models import TokenRecord
from leaderboard.db.rankings import BoardRow, board, stamp_of
from leaderboard.web.api.auth import WITHOUT_TOKEN, OptionalToken, service_of
from leaderboard.web.api.schemas import (
    ANY_TIME,
    MALFORMED,
    UNKNOWN_TOKEN,
    Answers,
    Leaderboard,
    Problem,
    row_model,
)
from leaderboard.web.cache import FRESH, PRIVATE, Made, answer, public_body
from rebar_depth_bench.reporting.tables import csv_cell, number_cells, number_heads
from rebar_depth_bench.scoring.protocol import PROTOCOL


def board_csv(rows: Sequence[BoardRow]) -> str:
    """Return the rows as CSV: rank, who and what, then the table's numbers; undefined ones are empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["rank", "id", "method", "submitter", "config", *number_heads()])
    for row in rows:
        cells = [row.rank, row.submission_id, row.method, row.submitter, row.config, *number_cells(row.table)]
        writer.writerow([csv_cell(cell) for cell in cells])
    return out.getvalue()


router = APIRouter(prefix="/api/v1", tags=["leaderboard"], responses=ANY_TIME)

CSV = "text/csv; charset=utf-8"
Config = Annotated[str, Query(max_length=100, description="the config's name", examples=["lattice"])]
_REFUSALS: Answers = {
    **UNKNOWN_TOKEN,
    404: {"model": Problem, "description": "the dataset has no such config"},
    **MALFORMED,
}
_CSV: Answers = {200: {"content": {"text/csv": {"schema": {"type": "string"}}}}}


@router.get("/leaderboard", response_model=Leaderboard, responses=_REFUSALS, openapi_extra=WITHOUT_TOKEN)
async def leaderboard(config: Config, request: Request, token: OptionalToken) -> Response:
    """Return a config's rows: public ones and, with a token, its own."""
    folder = service_of(request).folder

    def written(rows: list[BoardRow]) -> bytes:
        dataset = {"digest": folder.digest, "version": folder.version}
        models = [row_model(row) for row in rows]
        found = Leaderboard(config=config, protocol=PROTOCOL, dataset=dataset, rows=models)
        return found.model_dump_json().encode()

    return await _answer(request, config, token, "application/json", written)


@router.get(
    "/leaderboard.csv",
    responses={**_REFUSALS, **_CSV},
    response_class=Response,
    openapi_extra=WITHOUT_TOKEN,
)
async def leaderboard_csv(config: Config, request: Request, token: OptionalToken) -> Response:
    """Return the same rows as CSV."""
    return await _answer(request, config, token, CSV, lambda rows: board_csv(rows).encode())


async def _answer(
    request: Request,
    config: str,
    token: TokenRecord | None,
    media_type: str,
    written: Callable[[list[BoardRow]], bytes],
) -> Response:
    """Return the rows as they are ``written``: kept for all where nobody in particular asks."""
    service = service_of(request)
    if config not in service.folder.configs:
        known = ", ".join(service.folder.configs)
        raise HTTPException(404, f"no config {config!r}, expected one of {known}")
    if token is not None:
        own = await to_thread.run_sync(lambda: written(board(service.database, config, token)))
        return Response(own, media_type=media_type, headers={"Cache-Control": PRIVATE})

    def make() -> Made:
        rows = board(service.database, config)
        return (media_type, config, stamp_of(rows)), written(rows)

    body = await public_body(request, [config], (media_type, config), make)
    return answer(request, body, media_type, {"Cache-Control": FRESH})
