"""Refusal of a request, which the application turns into a response."""

from __future__ import annotations

from collections.abc import Sequence

from rebar_depth_bench.base.errors import Problem


class RefusedError(Exception):
    """Refusal of a request.

    Holds the HTTP status, the detail message and, for status 422 only, all problems.
    """

    def __init__(self, status: int, detail: str, problems: Sequence[Problem] = ()) -> None:
        self.status, self.detail = status, detail
        self.problems = (problems or (Problem("syntax", "", detail),)) if status == 422 else ()
        super().__init__(detail)


def too_large(max_bytes: int) -> RefusedError:
    """Return the rejection of an archive of more than ``max_bytes`` bytes."""
    return RefusedError(413, f"the archive is larger than {max_bytes} bytes, the limit of this service")
