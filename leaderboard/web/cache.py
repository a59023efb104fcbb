"""Cache of responses, which are valid until the content version in the database changes.

The version is looked up for every request, because other processes change the content, too. A response is rendered
once per version, and once more for clients without gzip, and a browser that has the current version gets status
304. Cached responses do not pass through the routing of the application.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

from anyio import CapacityLimiter, Lock, to_thread
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.db.engine import DATABASE_UNAVAILABLE, Database

REVALIDATE = "no-cache"
"""Cache-Control of public responses: stored here, and by browsers, which must revalidate each time."""
NO_STORE = "no-store"
"""Cache-Control of responses with unpublished content: not stored anywhere."""
MAX_CACHE_BYTES = 64 << 20
_Key = tuple[bytes, bytes, str, str, bool]


@dataclass(frozen=True)
class _CachedResponse:
    """A response as it was sent; ``route`` is that of the request, for the access log."""

    headers: list[tuple[bytes, bytes]]
    content: bytes
    etag: str
    route: Any


class CacheMiddleware:
    """ASGI middleware that keeps responses to GET without a token whose Cache-Control is ``REVALIDATE``.

    The application compresses its responses. ``identity`` names what they depend on besides the content: software,
    settings, dataset. At most ``max_bytes`` bytes are kept. Simultaneous requests for the same response render it
    once.
    """

    def __init__(
        self, app: ASGIApp, *, database: Database, identity: str, max_bytes: int = MAX_CACHE_BYTES
    ) -> None:
        self._app, self._database, self._max_bytes = app, database, max_bytes
        self._reading = CapacityLimiter(1)
        self._identity = hashlib.sha256(identity.encode()).hexdigest()[:16]
        self._rendering = defaultdict[_Key, Lock](Lock)
        self._responses: dict[_Key, _CachedResponse] = {}
        self._version, self._size = -1, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        headers = Headers(scope=scope) if scope["type"] == "http" else Headers()
        if scope["type"] != "http" or scope["method"] != "GET" or "authorization" in headers:
            await self._app(scope, receive, send)
            return
        try:
            version = await self._read_version()
        except DATABASE_UNAVAILABLE:  # The application reports it.
            await self._app(scope, receive, send)
            return
        if version != self._version:
            self._version, self._size, self._responses = version, 0, {}
        # Without a public URL, pages contain the address that the client has used.
        address = (scope["raw_path"], scope["query_string"], headers.get("host", ""), scope["root_path"])
        key = (*address, "gzip" in headers.get("accept-encoding", ""))
        response = self._responses.get(key)
        if response is None:
            try:
                async with self._rendering[key]:
                    response = self._responses.get(key) or await self._render(key, scope, receive, send)
            finally:
                self._rendering.pop(key, None)
        if response is not None:
            scope["route"] = response.route
            await _send_response(response, headers, send)

    async def _read_version(self) -> int:
        """Return the current version; requests to a server take turns, not to take all threads."""
        if self._database.file is not None:  # This takes less time than a change of threads.
            return self._database.content_version()
        return await to_thread.run_sync(self._database.content_version, limiter=self._reading)

    async def _render(self, key: _Key, scope: Scope, receive: Receive, send: Send) -> _CachedResponse | None:
        """Return the response of the application, or pass it on and return None if it must not be kept."""
        version, messages = self._version, list[Message]()

        async def collect(message: Message) -> None:
            messages.append(message)

        await self._app(scope, receive, collect)
        start, *bodies = messages
        if start["status"] != 200 or Headers(raw=start["headers"]).get("cache-control") != REVALIDATE:
            for message in messages:
                await send(message)
            return None
        etag = f'W/"{self._identity}-{version}"'
        headers = [*start["headers"], (b"etag", etag.encode())]
        content = b"".join(message.get("body", b"") for message in bodies)
        response = _CachedResponse(headers, content, etag, scope.get("route"))
        if version == self._version:
            if self._size + len(content) > self._max_bytes:
                self._responses, self._size = {}, 0
            self._responses[key] = response
            self._size += len(content)
        return response


async def _send_response(response: _CachedResponse, request_headers: Headers, send: Send) -> None:
    """Send the response, or status 304 if the client has it already."""
    headers, status, content = response.headers, 200, response.content
    if response.etag in request_headers.get("if-none-match", ""):
        of_body = (b"content-length", b"content-encoding")
        headers, status, content = [header for header in headers if header[0] not in of_body], 304, b""
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})
