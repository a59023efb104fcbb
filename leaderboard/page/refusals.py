"""Refusals: JSON, or a page for those who asked for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fastapi import Request, Response
from fastapi.responses import JSONResponse

from leaderboard.kept import PRIVATE
from leaderboard.page.rendering import render
from leaderboard.page.spelling import lines

_TITLES = {404: "There is no such page", 405: "That cannot be done here", 422: "The address is malformed"}


def refusal(
    request: Request,
    status: int,
    detail: str,
    headers: Mapping[str, str] | None = None,
    problems: Sequence[str] | None = None,
) -> Response:
    """Return the answer that refuses a request: a page where a browser asks, and not the API; JSON else."""
    if not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", ""):
        return _page(request, status, "\n".join(problems or (detail,)), headers)
    content = {"detail": detail} if problems is None else {"detail": detail, "problems": list(problems)}
    return JSONResponse(content, status, headers)


def _page(request: Request, status: int, detail: str, headers: Mapping[str, str] | None) -> Response:
    title = _TITLES.get(status, "That did not work")
    said = "" if detail in ("Not Found", "Method Not Allowed") else lines(detail)
    shown = {"title": title, "detail": said}
    return render(request, "refusal.html.j2", status_code=status, cache=PRIVATE, headers=headers, **shown)
