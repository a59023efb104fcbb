"""Errors as pages, for those who asked for a page."""

from __future__ import annotations

from fastapi import Request, Response

from leaderboard.page.rendering import PRIVATE, render
from leaderboard.page.spelling import lines

_TITLES = {404: "There is no such page", 405: "That cannot be done here", 422: "The address is malformed"}


def wants_page(request: Request) -> bool:
    """Return whether an error is told as a page: a browser asks, and not the API."""
    return not request.url.path.startswith("/api/") and "text/html" in request.headers.get("accept", "")


def refusal_page(request: Request, status: int, detail: str) -> Response:
    """Return the page of an error."""
    title = _TITLES.get(status, "That did not work")
    said = "" if detail in ("Not Found", "Method Not Allowed") else lines(detail)
    return render(request, "refusal.html.j2", status_code=status, cache=PRIVATE, title=title, detail=said)
