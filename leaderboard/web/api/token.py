"""Endpoint ``/api/v1/token``: the token of a request, its quota and the limits of the service."""

from __future__ import annotations

from fastapi import APIRouter

from leaderboard.db.submissions import quota_used
from leaderboard.web.api.auth import RequiredToken, ServiceDep
from leaderboard.web.api.schemas import COMMON_RESPONSES, MISSING_TOKEN_RESPONSE, Token

router = APIRouter(prefix="/api/v1", tags=["token"], responses=COMMON_RESPONSES)


@router.get("/token", responses=MISSING_TOKEN_RESPONSE)
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
        read_rate_limit=settings.read_rate_limit,
        write_rate_limit=settings.write_rate_limit,
    )
