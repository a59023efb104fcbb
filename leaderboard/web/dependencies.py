"""Dependencies of routes (the service, the token of a request), and the checks and addresses that routes share.

The dependencies are coroutines, because FastAPI runs other functions in worker threads, which takes longer than
what they do.
"""

from __future__ import annotations

from typing import Annotated, Any

from anyio import to_thread
from fastapi import Depends, HTTPException, Path, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.tokens import find_token
from leaderboard.refusals import RefusedError, too_large
from leaderboard.service import Service
from leaderboard.uploads import MAX_OVERHEAD_BYTES

MAX_PATCH_BYTES = 32 << 10
"""Maximum size in bytes of a change of a submission."""
_BEARER = HTTPBearer(auto_error=False, description="A token created by `rebar-leaderboard token NAME`.")
_Credentials = Annotated[HTTPAuthorizationCredentials | None, Depends(_BEARER)]


def service_of(request: Request) -> Service:
    """Return the service of the application that handles ``request``."""
    service: Service = request.app.state.service
    return service


async def _service(request: Request) -> Service:
    return service_of(request)


ServiceDep = Annotated[Service, Depends(_service)]


async def optional_token(request: Request, credentials: _Credentials) -> TokenModel | None:
    """Return the token of a request, or None if it has none. Raises status 401 for an unknown token."""
    if credentials is None:
        return None
    token = await to_thread.run_sync(find_token, service_of(request).database, credentials.credentials)
    if token is None:
        raise _unauthorised("the token is unknown or revoked; ask the operator for a new one")
    return token


async def required_token(token: Annotated[TokenModel | None, Depends(optional_token)]) -> TokenModel:
    """Return the token of a request. Raises status 401 if it has none or an unknown one."""
    if token is None:
        raise _unauthorised("no token, expected the header 'Authorization: Bearer TOKEN'")
    return token


def _unauthorised(detail: str) -> HTTPException:
    return HTTPException(401, detail, headers={"WWW-Authenticate": "Bearer"})


WITHOUT_TOKEN: dict[str, Any] = {"security": [{}]}
"""OpenAPI extra of operations with an optional token, which FastAPI would document as required."""

OptionalToken = Annotated[TokenModel | None, Depends(optional_token)]
RequiredToken = Annotated[TokenModel, Depends(required_token)]

SubmissionId = Annotated[str, Path(description="id of the submission, the last part of its URL")]


def check_config(service: Service, config: str) -> None:
    """Raise ``RefusedError`` (404) if the dataset has no such config."""
    if config not in service.folder.configs:
        known = ", ".join(service.folder.configs)
        raise RefusedError(404, f"the dataset has no config {config!r}, expected one of {known}")


def check_length(request: Request) -> None:
    """Raise ``RefusedError`` (413) if the body is declared to be larger than that of any upload.

    A client that waits for 100 Continue then sends nothing of it.
    """
    length, max_upload = request.headers.get("content-length", ""), service_of(request).settings.max_upload
    if length.isdecimal() and int(length) > max_upload + MAX_OVERHEAD_BYTES:
        raise too_large(max_upload)


def page_url(request: Request, record: SubmissionModel) -> str:
    """Return the URL of a submission's page, below the public URL if the settings have one."""
    url = service_of(request).settings.public_url
    if url:
        return f"{url}/submissions/{record.id}"
    return str(request.url_for("submission_page", submission_id=record.id))
