"""ASGI middleware: rate limits, security headers, access log, and early responses to uploads."""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Mapping

import structlog
from anyio import move_on_after
from limits import parse
from limits.storage import MemoryStorage
from limits.strategies import SlidingWindowCounterRateLimiter
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
_RAW_HEADERS = [(name.lower().encode(), value.encode()) for name, value in SECURITY_HEADERS.items()]
TOO_MANY_REQUESTS = "too many requests from this address"
BODY_IDLE_S = 60.0
"""Time without a byte of the body after which a request is regarded as given up."""
_HEALTH_CHECKS = parse("600/minute")
_READ_METHODS = ("GET", "HEAD", "OPTIONS")
_LOG = structlog.get_logger("http")


class RequestMiddleware:
    """ASGI middleware for rate limits, security headers and access log.

    Rate limits are per client address, that of the connection; behind a proxy uvicorn takes it from the headers.
    ``reads`` and ``writes`` are limits such as ``600/minute``.
    """

    def __init__(self, app: ASGIApp, *, reads: str, writes: str) -> None:
        self._app = app
        self._limiter = SlidingWindowCounterRateLimiter(MemoryStorage())
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
                headers = list(message["headers"])
                present = {name for name, _ in headers}
                headers += [header for header in _RAW_HEADERS if header[0] not in present]
                message = {**message, "headers": headers}
            await send(message)

        async def receive_in_time() -> Message:
            with move_on_after(BODY_IDLE_S):
                return await receive()
            return {"type": "http.disconnect"}

        # The server leaves out the body of responses to HEAD; FastAPI routes of GET do not take HEAD themselves.
        scope = {**scope, "method": "GET"} if method == "HEAD" else scope
        try:
            if self._is_allowed(scope):
                await self._app(scope, receive_in_time, send_with_headers)
            else:
                await error_response(Request(scope), 429, TOO_MANY_REQUESTS, {"Retry-After": "60"})(
                    scope, receive, send_with_headers
                )
        finally:
            self._log_request(method, scope, status, time.perf_counter() - start)

    def _is_allowed(self, scope: Scope) -> bool:
        limit, kind = (self._reads, "read") if scope["method"] in _READ_METHODS else (self._writes, "write")
        if scope["path"] == "/healthz":  # A reader who exceeds the limit must not make the service look broken.
            limit, kind = _HEALTH_CHECKS, "health"
        return self._limiter.hit(limit, client_network(scope), kind)

    def _log_request(self, method: str, scope: Mapping[str, object], status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # Not the path, which may contain a private id.
        _LOG.info("request", method=method, route=route, status=status, ms=round(1000 * seconds, 1))


def client_network(scope: Mapping[str, object]) -> str:
    """Return what identifies a client: its IPv4 address, or the /64 network of its IPv6 address."""
    client = scope.get("client")
    address = str(client[0]) if isinstance(client, list | tuple) and client else ""
    if ":" not in address:
        return address
    try:
        return str(ipaddress.ip_network(f"{address.partition('%')[0]}/64", strict=False))
    except ValueError:
        return address


IDLE_TIMEOUT_S = 5.0
MAX_DRAIN_S = 60.0


class EarlyResponseMiddleware:
    """ASGI middleware that sends an error response at once and then reads the rest of the request body.

    A client that is still uploading sees the response if it looks for one; without the reading, other clients
    would see a broken connection instead. Reading ends after ``MAX_DRAIN_S``, or when the client has sent nothing
    for ``IDLE_TIMEOUT_S``.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        # A client that waits for 100 Continue has sent nothing yet, and sends nothing after an error response.
        has_more = "expect" not in headers and ("transfer-encoding" in headers or "content-length" in headers)
        is_refused = False

        async def receive_tracked() -> Message:
            nonlocal has_more
            message = await receive()
            has_more = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def send_early(message: Message) -> None:
            nonlocal is_refused
            if message["type"] == "http.response.start":
                is_refused = message["status"] >= 400 and has_more
                if is_refused:
                    message = {**message, "headers": [*message["headers"], (b"connection", b"close")]}
                await send(message)
            elif is_refused and not message.get("more_body", False):
                await send({**message, "more_body": True})
                with move_on_after(MAX_DRAIN_S):
                    while has_more:
                        with move_on_after(IDLE_TIMEOUT_S) as idle:
                            await receive_tracked()
                        if idle.cancelled_caught:
                            break
                await send({"type": "http.response.body", "body": b"", "more_body": False})
            else:
                await send(message)

        await self._app(scope, receive_tracked, send_early)
