"""What the API answers, as Pydantic models with examples for its OpenAPI document.

Refusals that several operations share, for the OpenAPI document: by status, the model and when it comes.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from leaderboard.db.models import SubmissionRecord
from leaderboard.db.rankings import BoardRow

_ID = "5f0c9a7e2b4d4c1f8e6a3d2b1c0f9e8d"


class Problem(BaseModel):
    """Why a request is refused."""

    model_config = ConfigDict(json_schema_extra={"example": {"detail": "no such submission"}})

    detail: str


class Problems(BaseModel):
    """Why an upload is refused: every problem in words. The quota is not charged."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "detail": "the archive is refused: 1 problem",
                "problems": ["lattice/0042.npy: missing, expected all 504 views of the config"],
            }
        }
    )

    detail: str
    problems: list[str]


class Submission(BaseModel):
    """A submission and what became of it; ``result`` is the command line's JSON once it is scored."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": _ID,
                "status": "queued",
                "url": f"https://example.org/submissions/{_ID}",
                "method": "my-model",
                "public": False,
                "created_at": "2026-01-31T12:00:00Z",
                "finished_at": None,
                "reason": None,
                "archive_sha256": "9f" * 32,
                "result": None,
            }
        }
    )

    id: str
    status: Literal["queued", "scoring", "scored", "failed"]
    url: str = Field(description="its page; whoever knows the address may read it")
    method: str
    public: bool = Field(description="whether its rows are on the board")
    created_at: datetime
    finished_at: datetime | None
    reason: str | None = Field(description="why it failed")
    archive_sha256: str
    result: dict[str, Any] | None = None


class Publication(BaseModel):
    """Whether a submission's rows are on the board."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"example": {"public": True}})

    public: bool


class LeaderboardRow(BaseModel):
    """A row of the board; ``table`` is the config's table of the result's JSON."""

    rank: int | None = Field(description="by native AbsRel; null where the protocol does not rank the row")
    id: str
    method: str
    submitter: str
    url: str | None
    uses_intrinsics: bool | None
    created_at: datetime
    public: bool
    table: dict[str, Any]


class Leaderboard(BaseModel):
    """A config's rows, ranked ones first."""

    config: str
    protocol: str
    dataset: dict[str, str]
    rows: list[LeaderboardRow]


def submission_model(record: SubmissionRecord, url: str, result: dict[str, Any] | None = None) -> Submission:
    """Return the model of a submission's record."""
    return Submission(
        id=record.id,
        status=record.status,  # type: ignore[arg-type]
        url=url,
        method=record.method,
        public=record.public,
        created_at=_time(record.created_at),
        finished_at=None if record.finished_at is None else _time(record.finished_at),
        reason=record.reason,
        archive_sha256=record.archive_sha256,
        result=result,
    )


def row_model(row: BoardRow) -> LeaderboardRow:
    """Return the model of a board's row."""
    return LeaderboardRow(
        rank=row.rank,
        id=row.submission_id,
        method=row.method,
        submitter=row.submitter,
        url=row.url,
        uses_intrinsics=row.uses_intrinsics,
        created_at=_time(row.created_at),
        public=row.public,
        table=dict(row.table),
    )


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


Answers = dict[int | str, dict[str, Any]]

AWAY: Answers = {503: {"model": Problem, "description": "the database does not answer; try again in a while"}}
ANY_TIME: Answers = {429: {"model": Problem, "description": "too many requests"}, **AWAY}
MALFORMED: Answers = {422: {"model": Problems, "description": "the request is malformed"}}
UNKNOWN_TOKEN: Answers = {401: {"model": Problem, "description": "an unknown token"}}
NO_TOKEN: Answers = {401: {"model": Problem, "description": "no token, or an unknown one"}}
