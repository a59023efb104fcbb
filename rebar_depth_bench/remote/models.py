"""Pydantic models of the answers of a leaderboard's API, with examples.

The service builds and documents its answers with them, and the client validates what it receives. The docstrings
of the models are part of the OpenAPI document.
"""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, Strict

from rebar_depth_bench.base.errors import Problem
from rebar_depth_bench.base.validation import Expected, StrictModel, whole_number
from rebar_depth_bench.submission.declaration import HttpUrl

_ID = "5f0c9a7e2b4d4c1f8e6a3d2b1c0f9e8d"
_PROBLEM = Problem("invalid", "lattice/0042.npy", "the dtype is <i4", "float16, float32 or float64")
_Id = Annotated[str, Field(pattern="^[A-Za-z0-9_-]{1,100}$"), Expected("an id of letters, digits, _ and -")]
"""Id of a submission, which becomes part of URLs."""
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$"), Expected("64 hex digits")]
_Count = Annotated[int, whole_number(0, 2**63 - 1)]
_Time = Annotated[datetime, Strict(False)]
"""Time, as ISO 8601 in JSON."""


class Answer(StrictModel, extra="ignore"):
    """Base class of answers: types are strict, and keys of newer services are ignored."""


class ErrorResponse(Answer):
    """Reason why a request is rejected."""

    model_config = ConfigDict(json_schema_extra={"example": {"detail": "no such submission"}})

    detail: str


class RejectedResponse(Answer):
    """Rejection of a malformed request, or of an uploaded archive, which does not count against the quota.

    Of a rejected archive, the first 20 problems are listed; ``problems`` then ends with the number of the others.
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


class Submission(Answer):
    """Submission with its status; ``result`` is the JSON of ``rebar-bench score`` once it is scored."""

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

    id: _Id
    status: Literal["queued", "scoring", "scored", "failed"]
    url: HttpUrl = Field(description="URL of its page, which anyone who knows the URL can read")
    method: str
    description: str | None = None
    method_url: str | None = Field(None, description="page or paper of the method")
    code_url: str | None = None
    licence: str | None = None
    training_data: str | None = None
    parameters: int | float | str | None = Field(None, description="number of learned parameters, or text")
    seconds_per_view: float | None = Field(None, description="runtime as the submitter declares it")
    inputs: str | None = Field(None, description="input class, as declared by the submitter")
    uses_ground_truth: bool | None = None
    public: bool = Field(description="whether its rows are shown on the leaderboard")
    created_at: _Time
    finished_at: _Time | None
    reason: str | None = Field(description="reason why scoring failed; null otherwise")
    archive_sha256: _Sha256
    archive_bytes: _Count
    archive_kept: bool = Field(description="whether the archive is kept; without it nothing is scored again")
    outdated: str | None = Field(
        None, description="why the result is not of the dataset and protocol that are served; null if it is"
    )
    result: dict[str, Any] | None = None


class SubmissionList(Answer):
    """Submissions of a token, newest first, without their results."""

    submissions: list[Submission]


class Token(Answer):
    """Name of a token, its quota and the size limit of the service."""

    name: str = Field(description="name of the submitter, shown on the leaderboard")
    quota: _Count = Field(description="accepted submissions per day (UTC)")
    quota_left: _Count
    quota_bytes: _Count = Field(description="bytes of accepted archives per day (UTC)")
    quota_bytes_left: _Count
    max_upload_bytes: Annotated[int, whole_number(1, 2**63 - 1)]


class SubmissionOfRow(Answer):
    """What a row states of its submission."""

    model_config = ConfigDict(from_attributes=True)

    id: _Id
    method: str
    submitter: str
    baseline: bool = Field(description="whether the organiser of the leaderboard submitted it")
    url: str | None
    inputs: str | None = Field(description="input class, as declared by the submitter")
    uses_ground_truth: bool | None = Field(description="as declared; such rows are not ranked")
    created_at: _Time
    public: bool


class LeaderboardRow(SubmissionOfRow):
    """Leaderboard row; ``table`` is the table of the config in the result JSON of the submission."""

    rank: int | None = Field(description="rank by rank error, shared by equal errors; null if not ranked")
    class_rank: int | None = Field(description="rank among the rows with the same declared inputs")
    table: dict[str, Any]


class Leaderboard(Answer):
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


class OverallRanking(Answer):
    """Submissions by mean rank error, ranked ones first."""

    protocol: str
    dataset: dict[str, str]
    rows: list[OverallRow]
