"""For operators: ``/healthz`` and ``/metrics``."""

from __future__ import annotations

from fastapi import APIRouter, Response
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest

from leaderboard.web.api.auth import ServiceDep
from leaderboard.web.api.schemas import AWAY
from leaderboard.web.metrics import Meters
from rebar_depth_bench.version import software_version

router = APIRouter(tags=["operations"], responses=AWAY)


@router.get("/healthz")
def healthz(service: ServiceDep) -> dict[str, str]:
    """Say that the service answers and its database does."""
    with service.database.read() as session:
        session.connection().exec_driver_sql("SELECT 1")
    return {"status": "ok", "version": software_version(), "dataset": service.folder.digest}


router.add_api_route("/healthz", healthz, methods=["HEAD"], include_in_schema=False)


@router.get(
    "/metrics",
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    response_class=Response,
)
def metrics(service: ServiceDep) -> Response:
    """Return counters and gauges in Prometheus' text format."""
    meters: Meters = service.meters
    meters.read_queue(service.database)
    return Response(generate_latest(meters.registry), media_type=CONTENT_TYPE_LATEST)
