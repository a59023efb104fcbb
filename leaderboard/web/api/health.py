"""Endpoint ``/healthz`` for operators."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from fastapi.responses import JSONResponse

from leaderboard.checks import service_problems
from leaderboard.web.api.auth import ServiceDep
from leaderboard.web.api.schemas import DATABASE_UNAVAILABLE_RESPONSE
from rebar_depth_bench.version import software_version

router = APIRouter(tags=["operations"], responses=DATABASE_UNAVAILABLE_RESPONSE)


@router.get("/healthz")
def healthz(service: ServiceDep) -> Any:
    """Check database, dataset, disk and local workers; status 503 and ``problems`` if one of them is unusable."""
    problems = service_problems(service)
    content = {"status": "ok", "version": software_version(), "dataset": service.folder.digest}
    return JSONResponse({**content, "status": "failing", "problems": problems}, 503) if problems else content
