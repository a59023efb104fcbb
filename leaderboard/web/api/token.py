"""Endpoint ``/api/v1/token``: the token of a request, its quota and the limits of the service."""

from __future__ import annotations

from fastapi import APIRouter

from leaderboard.uploads.accept import quota_used
from leaderboard.web.api.auth import RequiredToken, ServiceDep
from leaderboard.web.api.schemas import COMMON_RESPONSES, MISSING_TOKEN_RESPONSE, Token

router = APIRouter(prefix="/api/v1", tags=["token"], responses=COMMON_RESPONSES)


@router.get("/token", responses=MISSING_TOKEN_RESPONSE)
def token(service: ServiceDep, token: RequiredToken) -> Token:
    """Return the name of a token, its quota and what remains of it today (UTC), and the service limits."""
    settings = service.settings
    return Token(
        name=token.name,
        quota=settings.quota,
        quota_left=max(0, settings.quota - quota_used(service, token)),
        max_upload_bytes=settings.max_upload,
        read_rate_limit=settings.read_rate_limit,
        write_rate_limit=settings.write_rate_limit,
    )
