"""``/api/v1/leaderboard``: a config's rows as JSON and CSV."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, HTTPException, Query, Response

from leaderboard.api.access import OptionalToken, ServiceDep
from leaderboard.api.models import Leaderboard, Problem, row_model
from leaderboard.board import BoardRow, board
from leaderboard.board_csv import board_csv
from leaderboard.records import TokenRecord
from leaderboard.service import Service
from rebar_depth_bench.protocol import PROTOCOL

router = APIRouter(prefix="/api/v1", tags=["leaderboard"])

Config = Annotated[str, Query(max_length=100, description="the config's name", examples=["lattice"])]
_UNKNOWN = {404: {"model": Problem, "description": "the dataset has no such config"}, 401: {"model": Problem}}


@router.get("/leaderboard", responses=_UNKNOWN)  # type: ignore[arg-type]
def leaderboard(config: Config, service: ServiceDep, token: OptionalToken) -> Leaderboard:
    """Return a config's rows: public ones and, with a token, its own."""
    rows = _rows(service, config, token)
    dataset = {"digest": service.folder.digest, "version": service.folder.version}
    return Leaderboard(config=config, protocol=PROTOCOL, dataset=dataset, rows=[row_model(row) for row in rows])


@router.get(
    "/leaderboard.csv",
    responses={**_UNKNOWN, 200: {"content": {"text/csv": {"schema": {"type": "string"}}}}},  # type: ignore[dict-item]
    response_class=Response,
)
def leaderboard_csv(config: Config, service: ServiceDep, token: OptionalToken) -> Response:
    """Return the same rows as CSV."""
    return Response(board_csv(_rows(service, config, token)), media_type="text/csv; charset=utf-8")


def _rows(service: Service, config: str, token: TokenRecord | None) -> list[BoardRow]:
    if config not in service.folder.configs:
        known = ", ".join(service.folder.configs)
        raise HTTPException(404, f"no config {config!r}, expected one of {known}")
    return board(service.database, config, token)
