"""ASGI middleware: rate limits, security headers, access log and metrics, and draining of rejected uploads."""

from __future__ import annotations

import time
from collections.abc import MutableMapping
from typing import Any

import structlog
from anyio import move_on_after
from limits import parse
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.metrics import ServiceMetrics
from leaderboard.web.pages.rendering import error_response

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
TOO_MANY_REQUESTS = "too many requests from this address"
_READ_METHODS = ("GET", "HEAD", "OPTIONS")
_KNOWN_METHODS = (*_READ_METHODS, "POST", "PUT", "PATCH", "DELETE")
_UNLIMITED_PATHS = ("/healthz", "/metrics")
_LOG = structlog.get_logger("http")


class RequestMiddleware:
    """ASGI middleware for rate limits, security headers, access log and metrics.

    Rate limits are per client address, that of the connection; behind a proxy uvicorn takes it from the headers.
    ``reads`` and ``writes`` are limits such as ``600/minute``.
    """

    def __init__(self, app: ASGIApp, *, reads: str, writes: str, metrics: ServiceMetrics) -> None:
        self._app, self._metrics = app, metrics
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._reads, self._writes = parse(reads), parse(writes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, or reject it with status 429."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status, method = time.perf_counter(), 500, scope["method"]

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                _add_security_headers(message)
            await send(message)

        # The server leaves out the body of responses to HEAD; FastAPI routes of GET do not take HEAD themselves.
        scope = {**scope, "method": "GET"} if scope["method"] == "HEAD" else scope
        try:
            if self._is_allowed(scope):
                await self._app(scope, receive, send_with_headers)
            else:
                await error_response(Request(scope), 429, TOO_MANY_REQUESTS, {"Retry-After": "60"})(
                    scope, receive, send_with_headers
                )
        finally:
            self._log_request(method, scope, status, time.perf_counter() - start)

    def _is_allowed(self, scope: Scope) -> bool:
        if scope["path"] in _UNLIMITED_PATHS:
            return True
        limit, kind = (self._reads, "read") if scope["method"] in _READ_METHODS else (self._writes, "write")
        address = (scope.get("client") or ("unknown",))[0]
        return self._limiter.hit(limit, kind, address)

    def _log_request(self, method: str, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # Not the path, which may contain a private id.
        # Clients can send any method name, and each label value would create a permanent time series.
        method = method if method in _KNOWN_METHODS else "other"
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.request_seconds.labels(method, route).observe(seconds)
        _LOG.info("request", method=method, route=route, status=status, ms=round(1000 * seconds, 1))


def _add_security_headers(message: MutableMapping[str, Any]) -> None:
    headers = MutableHeaders(scope=message)
    for name, value in SECURITY_HEADERS.items():
        headers.setdefault(name, value)


IDLE_TIMEOUT_S = 5.0
MAX_DRAIN_S = 600.0


class DrainRequestBodyMiddleware:
    """ASGI middleware that reads the rest of the request body before an error response is sent.

    Otherwise a client that is still uploading would see a broken connection instead of the response. At most
    ``max_bytes`` bytes are read, for at most ``MAX_DRAIN_S``; reading stops when the client has sent nothing for
    ``IDLE_TIMEOUT_S``.
    """

    def __init__(self, app: ASGIApp, *, max_bytes: int) -> None:
        self._app, self._max_bytes = app, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # A client that waits for 100 Continue has sent nothing yet, and sends nothing after an error response.
        is_sending = "expect" not in Headers(scope=scope)
        has_more = True

        async def receive_tracked() -> Message:
            nonlocal is_sending, has_more
            message = await receive()
            is_sending = True
            has_more = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def send_after_drain(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] >= 400:
                remaining = self._max_bytes
                with move_on_after(MAX_DRAIN_S):
                    while has_more and is_sending and remaining > 0:
                        with move_on_after(IDLE_TIMEOUT_S) as idle:
                            remaining -= len((await receive_tracked()).get("body", b""))
                        if idle.cancelled_caught:
                            break
            await send(message)

        await self._app(scope, receive_tracked, send_after_drain)
