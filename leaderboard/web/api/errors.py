"""Error responses that several operations of the API document."""

from __future__ import annotations

from typing import Any

from rebar_depth_bench.remote.models import ErrorResponse, RejectedResponse

Responses = dict[int | str, dict[str, Any]]
"""OpenAPI ``responses`` by status, as FastAPI expects them."""
DATABASE_UNAVAILABLE_MESSAGE = "the database is unavailable; try again later"
_ERRORS = {
    400: "the body is not valid UTF-8",
    401: "the token is missing or unknown",
    403: "you are not the owner of this submission",
    404: "there is no such submission or config",
    413: "the archive is too large",
    422: "the request is malformed, or the archive is invalid; it does not count against the quota",
    429: "the daily quota is used up",
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
