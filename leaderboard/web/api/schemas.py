"""Pydantic models of API responses, with examples, and error responses that several operations document.

The docstrings of the models are part of the OpenAPI document.
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from rebar_depth_bench.base.errors import Problem

_ID = "5f0c9a7e2b4d4c1f8e6a3d2b1c0f9e8d"
_PROBLEM = Problem("invalid", "lattice/0042.npy", "the dtype is <i4", "float16, float32 or float64")


class ErrorResponse(BaseModel):
    """Reason why a request is rejected."""

    model_config = ConfigDict(json_schema_extra={"example": {"detail": "no such submission"}})

    detail: str


class RejectedResponse(BaseModel):
    """RejectedResponse of a malformed request, or of a rejected upload, which does not count against the quota.

    Of a rejected upload, the first 20 problems are listed; ``problems`` then ends with the number of the others.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "detail": "the archive is invalid: 1 problem",
                "problems": [str(_PROBLEM)],
                "problem_details": [asdict(_PROBLEM)],
            }
        }
    )

    detail: str
    problems: list[str] = Field(description="the problems as text")
    problem_details: list[Problem] = Field(description="the listed problems, in the same order")


class Submission(BaseModel):
    """Submission with its status; ``result`` is the JSON of ``rebar-bench score`` once it is scored.

    If the ground truth is hidden, it is only the rank error and the coverage of each config, rounded.
    """

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
                "archive_bytes": 1234567,
                "archive_kept": True,
                "result": None,
            }
        }
    )

    id: str
    status: Literal["queued", "scoring", "scored", "failed"]
    url: str = Field(description="URL of its page, which anyone who knows the URL can read")
    method: str
    description: str | None = None
    method_url: str | None = Field(None, description="page or paper of the method")
    code_url: str | None = None
    licence: str | None = None
    training_data: str | None = None
    parameters: float | str | None = Field(None, description="number of learned parameters, or text")
    seconds_per_view: float | None = Field(None, description="runtime as the submitter declares it")
    inputs: str | None = Field(None, description="input class, as declared by the submitter")
    uses_ground_truth: bool | None = None
    public: bool = Field(description="whether its rows are shown on the leaderboard")
    created_at: datetime
    finished_at: datetime | None
    reason: str | None = Field(description="reason of the failure; null if it has not failed")
    archive_sha256: str
    archive_bytes: int
    archive_kept: bool = Field(description="whether the archive is kept; without it nothing is scored again")
    outdated: str | None = Field(None, description="why the result is of another dataset; null if it is not")
    result: dict[str, Any] | None = None


class SubmissionList(BaseModel):
    """Submissions of a token, newest first, without their results."""

    submissions: list[Submission]


class Token(BaseModel):
    """Name of a token, its quota and the limits of the service."""

    name: str = Field(description="name of the submitter, shown on the leaderboard")
    quota: int = Field(description="accepted submissions per day (UTC)")
    quota_left: int
    quota_bytes: int = Field(description="bytes of accepted archives per day (UTC)")
    quota_bytes_left: int
    max_upload_bytes: int
    read_rate_limit: str = Field(examples=["600/minute"])
    write_rate_limit: str = Field(examples=["60/minute"])


class SubmissionOfRow(BaseModel):
    """What a row states of its submission."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    method: str
    submitter: str
    url: str | None
    inputs: str | None = Field(description="input class, as declared by the submitter")
    uses_ground_truth: bool | None = Field(description="as declared; such rows are not ranked")
    created_at: datetime
    public: bool


class LeaderboardRow(SubmissionOfRow):
    """Leaderboard row; ``table`` is the table of the config in the result JSON of the submission."""

    rank: int | None = Field(description="rank by rank error, shared by equal errors; null if not ranked")
    rank_range: tuple[int, int] | None = Field(
        description="first and last rank that the paired 95 % differences of the rank error allow"
    )
    class_rank: int | None = Field(description="rank among the rows with the same declared inputs")
    table: dict[str, Any]


class Leaderboard(BaseModel):
    """Rows of a config, ranked ones first."""

    config: str
    protocol: str
    dataset: dict[str, str]
    rows: list[LeaderboardRow]


class OverallRow(SubmissionOfRow):
    """A submission and its mean rank error over all configs; a config that it lacks, null, counts 1."""

    rank: int | None = Field(description="rank by mean rank error, shared by equal errors; null if not ranked")
    mean_rank_error: float
    rank_errors: dict[str, float | None] = Field(description="rank error by config")


class OverallRanking(BaseModel):
    """Submissions by mean rank error, ranked ones first."""

    protocol: str
    dataset: dict[str, str]
    rows: list[OverallRow]


Responses = dict[int | str, dict[str, Any]]
"""OpenAPI ``responses`` by status, as FastAPI expects them."""
DATABASE_UNAVAILABLE_MESSAGE = "the database is unavailable; try again later"
_ERRORS = {
    400: "the body is not valid UTF-8",
    401: "the token is missing or unknown",
    403: "you are not the owner of this submission",
    404: "there is no such submission or config",
    408: "the client sent nothing for too long",
    413: "the archive is too large",
    422: "the request is malformed, or the archive is invalid; it does not count against the quota",
    429: "too many requests, or the daily quota is used up",
    503: DATABASE_UNAVAILABLE_MESSAGE,
}


def errors(*statuses: int) -> Responses:
    """Return the OpenAPI responses of errors."""
    return {
        status: {
            "model": RejectedResponse if status == 422 else ErrorResponse,
            "description": _ERRORS[status],
        }
        for status in statuses
    }
