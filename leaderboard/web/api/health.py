"""Endpoints for operators: ``/healthz`` and ``/metrics``."""

from __future__ import annotations

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from leaderboard.metrics import ServiceMetrics
from leaderboard.web.api.auth import ServiceDep
from leaderboard.web.api.schemas import DATABASE_UNAVAILABLE_RESPONSE
from rebar_depth_bench.version import software_version

router = APIRouter(tags=["operations"], responses=DATABASE_UNAVAILABLE_RESPONSE)


@router.get("/healthz")
def healthz(service: ServiceDep) -> dict[str, str]:
    """Check the database connection; return the status, the software version and the dataset digest."""
    with service.database.read() as session:
        session.connection().exec_driver_sql("SELECT 1")
    return {"status": "ok", "version": software_version(), "dataset": service.folder.digest}


@router.get(
    "/metrics",
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    response_class=Response,
)
def metrics(service: ServiceDep) -> Response:
    """Return counters and gauges in Prometheus' text format."""
    service_metrics: ServiceMetrics = service.metrics
    service_metrics.update_queue_gauges(service.database)
    return Response(generate_latest(service_metrics.registry), media_type=CONTENT_TYPE_LATEST)
