"""The web application: routes, the gate before them, errors as JSON or, for browsers, as pages."""

from __future__ import annotations

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException

from leaderboard.api import boards, operations, submissions
from leaderboard.gate import Gate
from leaderboard.page import how_to, routes, static_files
from leaderboard.page.refusals import refusal_page, wants_page
from leaderboard.page.rendering import make_templates
from leaderboard.service import Service
from rebar_depth_bench.version import software_version

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
    settings = service.settings
    app.add_middleware(Gate, reads=settings.reads, writes=settings.writes, meters=service.meters)
    for router in (submissions, boards, operations, routes, how_to, static_files):
        app.include_router(router.router)
    app.add_exception_handler(HTTPException, _refusal)
    app.add_exception_handler(RequestValidationError, _invalid)
    return app


async def _refusal(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    if wants_page(request):
        return refusal_page(request, error.status_code, str(error.detail))
    content = error.detail if isinstance(error.detail, dict) else {"detail": error.detail}
    return JSONResponse(content, error.status_code, error.headers)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    problems = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    if wants_page(request):
        return refusal_page(request, 422, "\n".join(problems))
    return JSONResponse({"detail": "the request is malformed", "problems": problems}, 422)
