"""Who asks: the bearer token of a request."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, HTTPException, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from leaderboard.db.models import TokenRecord
from leaderboard.db.tokens import find_token
from leaderboard.web.context import Service

_BEARER = HTTPBearer(auto_error=False, description="A token made by `rebar-leaderboard token NAME`.")
_Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]


def service_of(request: Request) -> Service:
    """Return the service that the application was made with."""
    service: Service = request.app.state.service
    return service


ServiceDep = Annotated[Service, Depends(service_of)]


def optional_token(service: ServiceDep, credentials: _Credentials) -> TokenRecord | None:
    """Return the request's token, None where it has none; 401 for an unknown one."""
    if credentials is None:
        return None
    token = find_token(service.database, credentials.credentials)
    if token is None:
        raise _unauthorised("the token is unknown")
    return token


def required_token(token: Annotated[TokenRecord | None, Depends(optional_token)]) -> TokenRecord:
    """Return the request's token; 401 where it has none."""
    if token is None:
        raise _unauthorised("no token, expected the header 'Authorization: Bearer TOKEN'")
    return token


def _unauthorised(detail: str) -> HTTPException:
    return HTTPException(401, detail, headers={"WWW-Authenticate": "Bearer"})


WITHOUT_TOKEN: dict[str, Any] = {"security": [{}]}
"""For the OpenAPI document: what takes a token may be done without one; FastAPI tells of the first half alone."""

OptionalToken = Annotated[TokenRecord | None, Depends(optional_token)]
RequiredToken = Annotated[TokenRecord, Depends(required_token)]
