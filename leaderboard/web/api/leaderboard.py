"""Endpoints of rows: those of a config (``leaderboard``, JSON and CSV), and those of all configs (``overall``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from leaderboard.db.models import TokenModel
from leaderboard.db.rankings import LeaderboardEntry, overall_ranking
from leaderboard.web.api.errors import Responses, errors
from leaderboard.web.dependencies import WITHOUT_TOKEN, OptionalToken, ServiceDep, check_config
from leaderboard.web.middleware import NO_STORE, REVALIDATE
from rebar_depth_bench.remote.models import (
    Leaderboard,
    LeaderboardRow,
    OverallRanking,
    OverallRow,
    SubmissionOfRow,
)
from rebar_depth_bench.scoring.columns import at_place
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.spreadsheet import csv_text, table_places
from rebar_depth_bench.submission.declaration import METRIC, InputClass


def entries_to_csv(rows: Sequence[LeaderboardEntry]) -> str:
    """Return rows as CSV: ranks, id, method, submitter, declarations, config, then the command line's columns.

    Undefined numbers are empty cells.
    """
    header = ["rank", "class_rank", "id", "method", "submitter", "baseline", "inputs", "uses_ground_truth"]
    places = table_places(METRIC)
    cells = (
        [
            *(row.rank, row.class_rank, row.id, row.method, row.submitter, row.baseline, row.inputs),
            *(row.uses_ground_truth, row.declared.get("seconds_per_view"), row.config),
            *(at_place(row.table, place) for place in places.values()),
        ]
        for row in rows
    )
    return csv_text([[*header, "seconds_per_view", "config", *places], *cells])


router = APIRouter(prefix="/api/v1", tags=["leaderboard"], responses=errors(503))

CSV = "text/csv; charset=utf-8"
ConfigName = Annotated[str, Query(max_length=100, description="name of the config", examples=["lattice"])]
_ERROR_RESPONSES = errors(401, 404, 422)
_CSV_RESPONSE: Responses = {200: {"content": {"text/csv": {"schema": {"type": "string"}}}}}
BestQuery = Annotated[
    bool,
    Query(description="only the best row of each submitter and method name, with ranks among these rows"),
]


def _rows(
    config: ConfigName,
    service: ServiceDep,
    token: OptionalToken,
    inputs: Annotated[InputClass | None, Query(description="only the rows that declare this input class")] = None,
    best: BestQuery = False,
) -> list[LeaderboardEntry]:
    """Return the rows of a config. Raises status 404 for an unknown config."""
    check_config(service, config)
    ranking = service.rankings.of(config, token)
    return list(ranking.best(inputs).entries) if best else ranking.of_class(inputs)


_Rows = Annotated[list[LeaderboardEntry], Depends(_rows)]


@router.get("/leaderboard", response_model=Leaderboard, responses=_ERROR_RESPONSES, openapi_extra=WITHOUT_TOKEN)
def leaderboard(request: Request, service: ServiceDep, token: OptionalToken, rows: _Rows) -> Response:
    """Return the public rows of a config and, with a token, those of its owner."""
    dataset = {"digest": service.folder.digest, "version": service.folder.version}
    shown = [LeaderboardRow.model_validate(row) for row in rows]
    content = Leaderboard(config=request.query_params["config"], protocol=PROTOCOL, dataset=dataset, rows=shown)
    return _response(content.model_dump_json(), "application/json", token)


@router.get(
    "/leaderboard.csv",
    responses={**_ERROR_RESPONSES, **_CSV_RESPONSE},
    response_class=Response,
    openapi_extra=WITHOUT_TOKEN,
)
def leaderboard_csv(token: OptionalToken, rows: _Rows) -> Response:
    """Return the rows of a config as CSV."""
    return _response(entries_to_csv(rows), CSV, token)


@router.get("/overall", response_model=OverallRanking, responses=errors(422))
def overall(service: ServiceDep, best: BestQuery = False) -> Response:
    """Return the public submissions in order of their mean rank error over all configs."""
    configs = service.folder.configs
    entries = overall_ranking([(config, service.rankings.of(config)) for config in configs], best=best)
    rows = [
        OverallRow(
            rank=one.rank,
            mean_rank_error=one.mean,
            rank_errors={name: one.entries[name].rank_error if name in one.entries else None for name in configs},
            **{name: getattr(one.first, name) for name in SubmissionOfRow.model_fields},
        )
        for one in entries
    ]
    dataset = {"digest": service.folder.digest, "version": service.folder.version}
    content = OverallRanking(protocol=PROTOCOL, dataset=dataset, rows=rows)
    return _response(content.model_dump_json(), "application/json", None)


def _response(content: str, media_type: str, token: TokenModel | None) -> Response:
    cache = REVALIDATE if token is None else NO_STORE
    return Response(content, media_type=media_type, headers={"Cache-Control": cache})
