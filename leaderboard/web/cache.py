"""Cache of responses, which are valid until the content version in the database changes.

The version is looked up for every request, because other processes change the content, too. A response is rendered
and compressed once per version, and a browser that has the current version gets status 304. Cached responses do
not pass through the routing of the application.

The first request for a response after a change renders it and waits. Requests that arrive meanwhile get the
previous response, which was current at most ``MAX_OUTDATED_S`` ago, so that a change does not delay all readers.
"""

from __future__ import annotations

import gzip
import hashlib
import time
from collections import defaultdict
from dataclasses import dataclass
from typing import Any

from anyio import Lock, to_thread
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from leaderboard.db.engine import DATABASE_UNAVAILABLE
from leaderboard.db.versions import VersionReader

REVALIDATE = "no-cache"
"""Cache-Control of public responses: stored here, and by browsers, which must revalidate each time."""
NO_STORE = "no-store"
"""Cache-Control of responses with unpublished content: not stored anywhere."""
MAX_CACHE_BYTES = 32 << 20
MAX_OUTDATED_S = 2.0
"""Time after which a previous response is no longer sent while the current one is rendered."""
_GZIP_LEVEL = 5
_RawHeaders = list[tuple[bytes, bytes]]
_Key = tuple[bytes, bytes, str, str]


@dataclass(frozen=True)
class _CachedResponse:
    """A response as sent and compressed; ``route`` is that of the request, for the access log."""

    content: bytes
    compressed: bytes
    headers: _RawHeaders
    route: Any


class CacheMiddleware:
    """ASGI middleware that keeps responses to GET without a token whose Cache-Control is ``REVALIDATE``.

    ``identity`` names what responses depend on besides the content: software, settings, dataset. At most
    ``max_bytes`` bytes of each of the last two versions are kept. Simultaneous requests for the same response
    render it once.
    """

    def __init__(
        self, app: ASGIApp, *, versions: VersionReader, identity: str, max_bytes: int = MAX_CACHE_BYTES
    ) -> None:
        self._app, self._max_bytes = app, max_bytes
        self._versions, self._reading = versions, Lock()
        self._identity = hashlib.sha256(identity.encode()).hexdigest()[:16]
        self._rendering = defaultdict[_Key, Lock](Lock)
        self._responses: dict[_Key, _CachedResponse] = {}
        self._outdated: dict[_Key, _CachedResponse] = {}
        self._version, self._size = -1, 0
        self._current_at_s = self._outdated_since_s = 0.0

    async def _read_version(self) -> int:
        """Return the current version; requests that have to read it take turns, not to take all threads."""
        if (version := self._versions.unchanged()) is not None:
            return version
        async with self._reading:
            version = self._versions.unchanged()
            return await to_thread.run_sync(self._versions.read) if version is None else version

    def _set_version(self, version: int) -> None:
        if version != self._version:
            if self._responses:
                self._outdated, self._outdated_since_s = self._responses, self._current_at_s
            self._version, self._size, self._responses = version, 0, {}
        self._current_at_s = time.monotonic()

    def _available(self, key: _Key) -> _CachedResponse | None:
        """Return the current response, or, while another request renders that, the previous one."""
        may_be_outdated = key in self._rendering and time.monotonic() - self._outdated_since_s < MAX_OUTDATED_S
        return self._responses.get(key) or (self._outdated.get(key) if may_be_outdated else None)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        if scope["type"] != "http" or scope["method"] != "GET":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        if "authorization" in headers:
            await self._app(scope, receive, send)
            return
        try:
            version = await self._read_version()
        except DATABASE_UNAVAILABLE:  # The application reports it.
            await self._app(scope, receive, send)
            return
        self._set_version(version)
        # Without a public URL, pages contain the address that the client has used.
        key = (scope["raw_path"], scope["query_string"], headers.get("host", ""), scope["root_path"])
        response = self._available(key)
        if response is None:
            try:
                async with self._rendering[key]:
                    response = self._responses.get(key) or await self._render(key, scope, receive, send)
            finally:
                self._rendering.pop(key, None)
        if response is not None:
            scope["route"] = response.route
            await _send_response(response, headers, send)

    async def _render(self, key: _Key, scope: Scope, receive: Receive, send: Send) -> _CachedResponse | None:
        """Return the response of the application, or pass it on and return None if it must not be kept."""
        version, messages = self._version, list[Message]()

        async def collect(message: Message) -> None:
            messages.append(message)

        await self._app(scope, receive, collect)
        start, *bodies = messages
        headers = Headers(raw=start["headers"])
        if start["status"] != 200 or headers.get("cache-control") != REVALIDATE:
            for message in messages:
                await send(message)
            return None
        content = b"".join(message.get("body", b"") for message in bodies)
        etag = f'W/"{self._identity}-{version}"'.encode()
        raw = [(name, value) for name, value in start["headers"] if name != b"content-length"]
        raw += [(b"etag", etag), (b"vary", b"Accept-Encoding")]
        compressed = await to_thread.run_sync(gzip.compress, content, _GZIP_LEVEL)
        response = _CachedResponse(content, compressed, raw, scope.get("route"))
        if version == self._version:
            self._store(key, response)
        return response

    def _store(self, key: _Key, response: _CachedResponse) -> None:
        size = len(response.content) + len(response.compressed)
        if self._size + size > self._max_bytes:
            self._responses, self._size = {}, 0
        self._responses[key] = response
        self._size += size


async def _send_response(response: _CachedResponse, request_headers: Headers, send: Send) -> None:
    """Send the response, compressed if the client accepts that, or status 304 if it has it already."""
    headers, status, content = response.headers, 200, response.content
    if dict(headers)[b"etag"].decode() in request_headers.get("if-none-match", ""):
        status, content = 304, b""
    elif "gzip" in request_headers.get("accept-encoding", ""):
        content, headers = response.compressed, [*headers, (b"content-encoding", b"gzip")]
    if status == 200:
        headers = [*headers, (b"content-length", str(len(content)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content})
