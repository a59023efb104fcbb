"""FastAPI application: routers, middleware and error handlers that respond with JSON or, to browsers, a page."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import GZipMiddleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import ClientDisconnect
from starlette.staticfiles import StaticFiles

from leaderboard.db.engine import DATABASE_UNAVAILABLE
from leaderboard.refusals import RefusedError
from leaderboard.service import Service
from leaderboard.web.api import leaderboard, status, submissions
from leaderboard.web.api.errors import DATABASE_UNAVAILABLE_MESSAGE
from leaderboard.web.middleware import ETagMiddleware, RequestMiddleware
from leaderboard.web.pages import account, ranking, submission_page
from leaderboard.web.pages.rendering import error_response, make_templates
from rebar_depth_bench import software_version
from rebar_depth_bench.base.errors import Problem, RebarDepthError

_LOG = structlog.get_logger("http")
DESCRIPTION = """Accepts prediction archives and scores them exactly as `rebar-bench score` does.

Uploads require a bearer token. An archive is validated before it is accepted; a rejected archive does not count
against the quota. The id of a submission is random. Anyone who knows the id can read the submission, even if its
rows are not on the leaderboard."""

_LOCAL_HOSTS = ("localhost", "127.0.0.1", "[::1]")
"""Hosts that are always allowed: health checks of the machine itself name them."""
_MIN_GZIP_BYTES = 1024
_STATIC_FOLDERS: list[str | tuple[str, str]] = [
    ("leaderboard.web.pages", "static"),
    ("rebar_depth_bench.reporting.html", "static"),
]
"""Packages and their folders with style sheets, scripts and the icon: of the pages, and of the report."""


class _StaticFiles(StaticFiles):
    """Files that browsers keep, and ask for again each time; status 304 if they have not changed."""

    def file_response(self, *arguments: Any, **options: Any) -> Response:
        response = super().file_response(*arguments, **options)
        response.headers["Cache-Control"] = "public, no-cache"  # Not REVALIDATE: files have their own ETag.
        return response


def make_app(service: Service) -> FastAPI:
    """Return the application that serves ``service``."""
    settings = service.settings
    app = FastAPI(
        title=settings.title,
        version=software_version(),
        description=DESCRIPTION,
        docs_url=None,  # These pages load scripts from other hosts.
        redoc_url=None,
        root_path=urlsplit(settings.public_url).path,
    )
    app.state.service = service
    app.state.templates = make_templates()
    for router in (submissions, leaderboard, status, ranking, submission_page, account):
        app.include_router(router.router)
    app.mount("/static", _StaticFiles(packages=_STATIC_FOLDERS))
    dataset = (service.folder.digest, service.folder.version, service.dataset_name, service.dataset_licence)
    identity = f"{software_version()} {dataset} {settings.model_dump_json(exclude={'db'})}"
    app.add_middleware(GZipMiddleware, minimum_size=_MIN_GZIP_BYTES, compresslevel=5)
    app.add_middleware(ETagMiddleware, database=service.database, identity=identity)
    if host := urlsplit(settings.public_url).hostname:
        app.add_middleware(TrustedHostMiddleware, allowed_hosts=[host, *_LOCAL_HOSTS], www_redirect=False)
    app.add_middleware(RequestMiddleware)
    app.add_exception_handler(HTTPException, _handle_http_exception)
    app.add_exception_handler(RefusedError, _handle_refusal)
    app.add_exception_handler(ClientDisconnect, _handle_client_disconnect)
    for error_type in DATABASE_UNAVAILABLE:
        app.add_exception_handler(error_type, _handle_database_unavailable)
    app.add_exception_handler(RequestValidationError, _handle_validation_error)
    app.add_exception_handler(RebarDepthError, _handle_unusable_data)
    return app


async def _handle_refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, RefusedError)
    headers = {"Retry-After": "60"} if error.status == 503 else None
    return error_response(request, error.status, error.detail, headers, error.problems)


async def _handle_http_exception(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    headers = _allow_header(request) if error.status_code == 405 else None
    return error_response(request, error.status_code, str(error.detail), headers or error.headers)


def _allow_header(request: Request) -> dict[str, str] | None:
    """Return the Allow header with all methods of the requested API path, or None for other paths.

    Starlette lists only the methods of the path's first operation.
    """
    paths = request.app.openapi()["paths"]
    operations = paths.get(getattr(request.scope.get("route"), "path", ""))
    return operations and {"Allow": ", ".join(sorted(method.upper() for method in operations))}


async def _handle_validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    problems = [
        Problem(
            "missing" if details["type"] == "missing" else "invalid",
            ".".join(map(str, details["loc"])),
            details["msg"],
        )
        for details in error.errors()
    ]
    return error_response(request, 422, "the request is malformed", problems=problems)


async def _handle_database_unavailable(request: Request, error: Exception) -> Response:
    _LOG.warning("database unavailable", error=" ".join(str(getattr(error, "orig", error)).split()))
    return error_response(request, 503, DATABASE_UNAVAILABLE_MESSAGE, {"Retry-After": "10"})


async def _handle_unusable_data(request: Request, error: Exception) -> Response:
    _LOG.error("dataset or stored data unusable", error=str(error))
    return error_response(request, 503, "the service cannot read its data at the moment", {"Retry-After": "60"})


async def _handle_client_disconnect(_: Request, __: Exception) -> Response:
    return Response(status_code=400)  # The client has disconnected.
