"""``/api/v1/leaderboard``: a config's rows as JSON and CSV."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from anyio import to_thread
from fastapi import APIRouter, HTTPException, Query, Request, Response

from leaderboard.api.access import WITHOUT_TOKEN, OptionalToken, service_of
from leaderboard.api.answers import ANY_TIME, MALFORMED, UNKNOWN_TOKEN, Answers
from leaderboard.api.models import Leaderboard, Problem, row_model
from leaderboard.board import BoardRow, board, stamp_of
from leaderboard.board_csv import board_csv
from leaderboard.kept import FRESH, PRIVATE, Made, answer, public_body
from leaderboard.records import TokenRecord
from rebar_depth_bench.protocol import PROTOCOL

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
