"""The web application: routes, the gate before them, errors as JSON or, for browsers, as pages."""

from __future__ import annotations

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from leaderboard.db.engine import AWAY
from leaderboard.uploads.accept import RefusedError
from leaderboard.uploads.multipart import MOST_ELSE
from leaderboard.web.api import health, leaderboard, submissions
from leaderboard.web.cache import new_shelf
from leaderboard.web.context import Service
from leaderboard.web.middleware import Drain, Gate
from leaderboard.web.pages import routes, static, submit
from leaderboard.web.pages.rendering import make_templates, refusal
from rebar_depth_bench.version import software_version

DATABASE_AWAY = "the database does not answer; try again in a while"
_LOG = structlog.get_logger("http")
DESCRIPTION = """Takes prediction archives and scores them exactly as `rebar-bench score` does.

Upload with a bearer token; the archive is checked before it is accepted, and a refused one costs no quota. A
submission's id cannot be guessed and opens it to whoever has it, also while its rows are not on the board."""


def make_app(service: Service) -> FastAPI:
    """Return the application that serves ``service``."""
    app = FastAPI(
        title=service.settings.title,
        version=software_version(),
        description=DESCRIPTION,
        docs_url=None,  # their pages load scripts from elsewhere
        redoc_url=None,
    )
    app.state.service = service
    app.state.templates = make_templates()
    app.state.shelf = new_shelf(service.database)
    settings = service.settings
    app.add_middleware(Gate, reads=settings.reads, writes=settings.writes, meters=service.meters)
    for router in (submissions, leaderboard, health, routes, submit, static):
        app.include_router(router.router)
    app.add_middleware(Drain, most=settings.max_upload + MOST_ELSE)
    app.add_exception_handler(HTTPException, _refusal)
    app.add_exception_handler(RefusedError, _refused)
    app.add_exception_handler(ClientDisconnect, _gone)
    for kind in AWAY:
        app.add_exception_handler(kind, _away)
    app.add_exception_handler(RequestValidationError, _invalid)
    return app


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, RefusedError)
    headers = {"Retry-After": "60"} if error.status == 503 else None
    return refusal(request, error.status, error.detail, headers, error.problems)


async def _refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = _allowed(request) if error.status_code == 405 else None
    return refusal(request, error.status_code, str(error.detail), headers or error.headers)


def _allowed(request: Request) -> dict[str, str] | None:
    """Return the methods of the API's path at hand: Starlette names those of the path's first operation alone."""
    paths = request.app.openapi()["paths"]
    operations = paths.get(getattr(request.scope.get("route"), "path", ""))
    return operations and {"Allow": ", ".join(sorted(method.upper() for method in operations))}


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    problems = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    return refusal(request, 422, "the request is malformed", problems=problems)


async def _away(request: Request, error: Exception) -> Response:
    _LOG.warning("database away", error=" ".join(str(getattr(error, "orig", error)).split()))
    return refusal(request, 503, DATABASE_AWAY, {"Retry-After": "10"})


async def _gone(_: Request, __: Exception) -> Response:
    return Response(status_code=400)  # nobody reads it
