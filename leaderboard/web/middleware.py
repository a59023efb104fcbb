"""ASGI middleware: security headers and access log, and status 304 for pages that have not changed."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping

import structlog
from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database

CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
SECURITY_HEADERS = {
    "Cache-Control": "no-store",  # Responses that may be stored have their own.
    "Content-Security-Policy": CONTENT_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",  # The URL of an unpublished submission gives access to it.
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
REVALIDATE = "no-cache"
"""Cache-Control of public responses: stored by browsers, which must revalidate each time."""
NO_STORE = "no-store"
"""Cache-Control of responses with unpublished content: not stored anywhere."""
MAX_HOST_CHARACTERS = 300
_LOG = structlog.get_logger("http")


class RequestMiddleware:
    """ASGI middleware for security headers and access log."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, method = time.perf_counter(), 500, scope["method"]

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if len(Headers(scope=scope).get("host", "")) > MAX_HOST_CHARACTERS:  # Addresses of pages contain it.
            response = PlainTextResponse("the Host header is too long", 400)
            await response(scope, receive, send_with_headers)
            return
        # The server leaves out the body of responses to HEAD; FastAPI routes of GET do not take HEAD themselves.
        scope = {**scope, "method": "GET"} if method == "HEAD" else scope
        try:
            await self._app(scope, receive, send_with_headers)
        finally:
            self._log_request(method, scope, status, time.perf_counter() - start)

    def _log_request(self, method: str, scope: Mapping[str, object], status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # Not the path, which may contain a private id.
        _LOG.info("request", method=method, route=route, status=status, ms=round(1000 * seconds, 1))


class ETagMiddleware:
    """ASGI middleware that names the version of public pages in ``ETag``, and answers 304 if the client has it.

    A page depends on the content version in the database, which other processes increment too, and on
    ``identity``: software, settings, dataset. Public are responses to GET without a token whose Cache-Control is
    ``REVALIDATE``.
    """

    def __init__(self, app: ASGIApp, *, database: Database, identity: str) -> None:
        self._app, self._database = app, database
        self._identity = hashlib.sha256(identity.encode()).hexdigest()[:16]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        headers = Headers(scope=scope) if scope["type"] == "http" else Headers()
        if scope["type"] != "http" or scope["method"] != "GET" or "authorization" in headers:
            await self._app(scope, receive, send)
            return
        try:
            version = await to_thread.run_sync(self._database.content_version)
        except DATABASE_UNAVAILABLE:  # The application reports it.
            await self._app(scope, receive, send)
            return
        etag = f'W/"{self._identity}-{version}"'
        if etag in headers.get("if-none-match", ""):
            fields = {"etag": etag, "cache-control": REVALIDATE, "vary": "Accept-Encoding"}
            unchanged = [(name.encode(), value.encode()) for name, value in fields.items()]
            await send({"type": "http.response.start", "status": 304, "headers": unchanged})
            await send({"type": "http.response.body", "body": b""})
            return

        async def send_with_etag(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == 200:
                answer = MutableHeaders(scope=message)
                if answer.get("cache-control") == REVALIDATE:
                    answer["etag"] = etag
            await send(message)

        await self._app(scope, receive, send_with_etag)
