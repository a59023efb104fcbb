"""In-memory cache of rendered leaderboard responses, keyed by a version of the underlying rows.

A leaderboard is rendered once per version instead of once per request. The version is read from the database for
every request, because other processes may change the rows.
"""

from __future__ import annotations

import asyncio
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi import Request, Response

from leaderboard.db.engine import Database
from leaderboard.db.rankings import RankingVersion, ranking_versions

T = TypeVar("T")
CacheKey = tuple[Hashable, ...]
RenderedBody = tuple[CacheKey, bytes]
"""A rendered body and the key of the content that it was rendered from."""
REVALIDATE = "no-cache"
"""Cache-Control of public responses: browsers may store them but must revalidate each time."""
NO_STORE = "no-store"
"""Cache-Control of responses with unpublished content: not stored anywhere."""
MAX_CACHE_BYTES = 32 << 20
"""Default limit for the total size of cached bodies."""


@dataclass(frozen=True)
class CachedBody:
    """The bytes of a response body and their ETag."""

    content: bytes
    etag: str


class ResponseCache:
    """Thread-safe LRU cache of response bodies, limited to ``max_bytes`` bytes in total."""

    def __init__(self, max_bytes: int = MAX_CACHE_BYTES) -> None:
        self._bodies: OrderedDict[CacheKey, CachedBody] = OrderedDict()
        self._max_bytes, self._size = max_bytes, 0
        self._lock = threading.Lock()

    def get(self, key: CacheKey, make: Callable[[], RenderedBody]) -> CachedBody:
        """Return the cached body of ``key``, or render it with ``make`` and store it.

        ``make`` returns the body's own key and the body. The body is stored under its own key, which differs from
        ``key`` if the rows have changed since ``key`` was read.
        """
        if body := self.lookup(key):
            return body
        rendered_key, content = make()
        body = CachedBody(content, f'"{hashlib.sha256(content).hexdigest()[:32]}"')
        self._store(rendered_key, body)
        return body

    def lookup(self, key: CacheKey) -> CachedBody | None:
        """Return the cached body of ``key``, or None."""
        with self._lock:
            if key in self._bodies:
                self._bodies.move_to_end(key)
            return self._bodies.get(key)

    def _store(self, key: CacheKey, body: CachedBody) -> None:
        with self._lock:
            previous = self._bodies.pop(key, None)
            self._size += len(body.content) - (len(previous.content) if previous else 0)
            self._bodies[key] = body
            while self._size > self._max_bytes:
                self._size -= len(self._bodies.popitem(last=False)[1].content)


class CoalescedRead(Generic[T]):
    """Database read shared by concurrent requests: calls during a running read wait for the next one.

    A returned value was therefore read after the call, and hundreds of concurrent calls cost one query.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read = read
        self._running: asyncio.Task[T] | None = None
        self._next: asyncio.Task[T] | None = None

    async def get(self) -> T:
        """Return the value of the next read, or raise its exception."""
        if self._next is None:
            self._next = asyncio.create_task(self._read_after(self._running))
        return await asyncio.shield(self._next)  # A cancelled request must not cancel the others.

    async def _read_after(self, running: asyncio.Task[T] | None) -> T:
        if running is not None and not running.done():
            await asyncio.wait([running])
        self._running, self._next = self._next, None  # Later calls wait for the next read.
        return await to_thread.run_sync(self._read)


@dataclass(frozen=True)
class CacheState:
    """Cache shared by the routes: current versions by config, cached bodies, and the limit on rendering."""

    versions: CoalescedRead[dict[str, RankingVersion]]
    bodies: ResponseCache
    render_limiter: CapacityLimiter


def new_cache_state(database: Database) -> CacheState:
    """Return an empty cache for the leaderboards of ``database``."""
    return CacheState(CoalescedRead(lambda: ranking_versions(database)), ResponseCache(), CapacityLimiter(1))


def cache_state_of(request: Request) -> CacheState:
    """Return the cache of the application that handles ``request``."""
    cache_state: CacheState = request.app.state.cache_state
    return cache_state


async def cached_public_body(
    request: Request, configs: Sequence[str], key_prefix: CacheKey, make: Callable[[], RenderedBody]
) -> CachedBody:
    """Return the response body for the public rows of ``configs``; ``make`` is as in ``ResponseCache.get``.

    The cache key is ``key_prefix`` followed by the version of each config. A worker thread is used only if the
    body is not cached.
    """
    cache_state = cache_state_of(request)
    versions = await cache_state.versions.get()
    key = (*key_prefix, *(versions.get(name, RankingVersion()) for name in configs))
    return await get_or_render(cache_state, key, make)


async def get_or_render(cache_state: CacheState, key: CacheKey, make: Callable[[], RenderedBody]) -> CachedBody:
    """Return the cached body of ``key``, or render it; concurrent requests for the same key render it once."""
    if body := cache_state.bodies.lookup(key):
        return body
    # Rendering is serial: requests that wait, without occupying a thread, find the body cached.
    return await to_thread.run_sync(cache_state.bodies.get, key, make, limiter=cache_state.render_limiter)


def conditional_response(
    request: Request, body: CachedBody, media_type: str, headers: Mapping[str, str]
) -> Response:
    """Return the response with ``body``, or 304 without content if the client's ETag matches."""
    all_headers = {"ETag": body.etag, **headers}
    if body.etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=all_headers)
    return Response(body.content, media_type=media_type, headers=all_headers)
