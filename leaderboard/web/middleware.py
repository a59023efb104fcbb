"""Before and after every request: rate limits, security headers, a log line, a count.

Refusals that arrive: a client that is still sending when its upload is refused would see a cut connection.
"""

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

from leaderboard.web.metrics import Meters
from leaderboard.web.pages.rendering import refusal

CONTENT_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": CONTENT_POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
    "Referrer-Policy": "no-referrer",  # the address of a private submission is its key
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
TOO_MANY = "too many requests from this address"
_READS = ("GET", "HEAD", "OPTIONS")
_METHODS = (*_READS, "POST", "PUT", "PATCH", "DELETE")
_FREE = ("/healthz", "/metrics")
_LOG = structlog.get_logger("http")


class Gate:
    """ASGI middleware. Addresses are the connection's; behind a proxy uvicorn takes them from its headers."""

    def __init__(self, app: ASGIApp, *, reads: str, writes: str, meters: Meters) -> None:
        self._app, self._meters = app, meters
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._reads, self._writes = parse(reads), parse(writes)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or refuse it with 429."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, status = time.perf_counter(), 500

        async def send_dressed(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                _dress(message)
            await send(message)

        try:
            if self._admits(scope):
                await self._app(scope, receive, send_dressed)
            else:
                await refusal(Request(scope), 429, TOO_MANY, {"Retry-After": "60"})(scope, receive, send_dressed)
        finally:
            self._note(scope, status, time.perf_counter() - start)

    def _admits(self, scope: Scope) -> bool:
        if scope["path"] in _FREE:
            return True
        limit, kind = (self._reads, "read") if scope["method"] in _READS else (self._writes, "write")
        address = (scope.get("client") or ("unknown",))[0]
        return self._limiter.hit(limit, kind, address)

    def _note(self, scope: Scope, status: int, seconds: float) -> None:
        route = getattr(scope.get("route"), "path", "none")  # never the path itself: it may hold a private id
        # Any word may come, and each would be counted for itself, for good.
        method = scope["method"] if scope["method"] in _METHODS else "other"
        self._meters.requests.labels(method, route, str(status)).inc()
        self._meters.seconds.labels(method, route).observe(seconds)
        _LOG.info("request", method=method, route=route, status=status, ms=round(1000 * seconds, 1))


def _dress(message: MutableMapping[str, Any]) -> None:
    headers = MutableHeaders(scope=message)
    for name, value in HEADERS.items():
        headers.setdefault(name, value)


SILENCE_S = 5.0
MOST_S = 600.0


class Drain:
    """ASGI middleware. Before a refusal is sent, what the client still sends is read, ``most`` bytes of it.

    A client that falls silent, be it that it never sends what it has announced, is told after ``SILENCE_S``.
    """

    def __init__(self, app: ASGIApp, *, most: int) -> None:
        self._app, self._most = app, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        # A client that waits for 100 Continue has sent nothing yet, and sends nothing once it is refused.
        is_sending = "expect" not in Headers(scope=scope)
        more = True

        async def receive_watched() -> Message:
            nonlocal is_sending, more
            message = await receive()
            is_sending = True
            more = message["type"] == "http.request" and message.get("more_body", False)
            return message

        async def send_after(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] >= 400:
                left = self._most
                with move_on_after(MOST_S):
                    while more and is_sending and left > 0:
                        with move_on_after(SILENCE_S) as silence:
                            left -= len((await receive_watched()).get("body", b""))
                        if silence.cancelled_caught:
                            break
            await send(message)

        await self._app(scope, receive_watched, send_after)
