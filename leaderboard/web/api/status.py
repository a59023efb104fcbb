"""Endpoints ``/api/v1/token``, the limits of a submitter, and ``/healthz`` for operators."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse

from leaderboard.db.submissions import quota_used
from leaderboard.health import service_problems
from leaderboard.web.api.errors import errors
from leaderboard.web.dependencies import RequiredToken, ServiceDep
from rebar_depth_bench import software_version
from rebar_depth_bench.remote.models import Token

router = APIRouter()


@router.get("/api/v1/token", tags=["token"], responses=errors(401, 503))
def token(service: ServiceDep, token: RequiredToken) -> Token:
    """Return the name of a token, its quota and what remains of it today (UTC), and the service limits."""
    settings = service.settings
    with service.database.read() as session:
        used = quota_used(session, token)
    return Token(
        name=token.name,
        quota=settings.quota,
        quota_left=max(0, settings.quota - used.submissions),
        quota_bytes=settings.quota_bytes,
        quota_bytes_left=max(0, settings.quota_bytes - used.size),
        max_upload_bytes=settings.max_upload,
    )


@router.get("/healthz", tags=["operations"], responses=errors(503))
def healthz(service: ServiceDep) -> Any:
    """Check database, dataset, archive folder, disk and workers; status 503 and `problems` if one is unusable."""
    problems = service_problems(service)
    content = {"status": "ok", "version": software_version(), "dataset": service.folder.digest}
    return JSONResponse({**content, "status": "failing", "problems": problems}, 503) if problems else content
