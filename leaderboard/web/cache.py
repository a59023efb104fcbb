"""Answers that are kept as long as what they show is the same, so that a board is rendered once and not for each
reader. What is shown is read from the database for every request: other processes may have changed it.
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
from leaderboard.db.rankings import Stamp, stamps

T = TypeVar("T")
Key = tuple[Hashable, ...]
Made = tuple[Key, bytes]
FRESH = "no-cache"
"""What all may see: kept by browsers, but asked for again each time."""
PRIVATE = "no-store"
"""What stands on no board: kept nowhere."""
MOST_BYTES = 32 << 20


@dataclass(frozen=True)
class Body:
    """An answer's bytes and what tells them from others."""

    content: bytes
    etag: str


class KeptBodies:
    """The bodies asked for last, ``most`` bytes of them. Threads share it."""

    def __init__(self, most: int = MOST_BYTES) -> None:
        self._bodies: OrderedDict[Key, Body] = OrderedDict()
        self._most, self._size = most, 0
        self._lock = threading.Lock()

    def get(self, key: Key, make: Callable[[], Made]) -> Body:
        """Return the body of ``key``; where it is not kept, ``make`` it.

        ``make`` returns the key of what it found, and the body: a change since ``key`` was read makes it another.
        """
        if body := self.found(key):
            return body
        made, content = make()
        body = Body(content, f'"{hashlib.sha256(content).hexdigest()[:32]}"')
        self._keep(made, body)
        return body

    def found(self, key: Key) -> Body | None:
        """Return the body of ``key``, None where it is not kept."""
        with self._lock:
            if key in self._bodies:
                self._bodies.move_to_end(key)
            return self._bodies.get(key)

    def _keep(self, key: Key, body: Body) -> None:
        with self._lock:
            known = self._bodies.pop(key, None)
            self._size += len(body.content) - (len(known.content) if known else 0)
            self._bodies[key] = body
            while self._size > self._most:
                self._size -= len(self._bodies.popitem(last=False)[1].content)


class SharedRead(Generic[T]):
    """A read of the database that requests share: who asks while one is under way waits for the next one.

    So whatever is returned was read after it was asked for, and hundreds who ask at once cost one query.
    """

    def __init__(self, read: Callable[[], T]) -> None:
        self._read = read
        self._running: asyncio.Task[T] | None = None
        self._next: asyncio.Task[T] | None = None

    async def get(self) -> T:
        """Return what is read next; raise what reading raises."""
        if self._next is None:
            self._next = asyncio.create_task(self._read_after(self._running))
        return await asyncio.shield(self._next)  # who asks may go away, others wait on

    async def _read_after(self, running: asyncio.Task[T] | None) -> T:
        if running is not None and not running.done():
            await asyncio.wait([running])
        self._running, self._next = self._next, None  # from now on it is too late to join
        return await to_thread.run_sync(self._read)


@dataclass(frozen=True)
class Shelf:
    """What the boards' routes share: the stamps as they are now, the bodies made of them, and who may make one."""

    stamps: SharedRead[dict[str, Stamp]]
    bodies: KeptBodies
    makers: CapacityLimiter


def new_shelf(database: Database) -> Shelf:
    """Return an empty shelf for the boards of a database."""
    return Shelf(SharedRead(lambda: stamps(database)), KeptBodies(), CapacityLimiter(1))


def shelf_of(request: Request) -> Shelf:
    """Return the application's shelf."""
    shelf: Shelf = request.app.state.shelf
    return shelf


async def public_body(request: Request, configs: Sequence[str], asked: Key, make: Callable[[], Made]) -> Body:
    """Return the body of what is ``asked`` of the configs' public rows; ``make`` as in ``KeptBodies.get``.

    Its key is ``asked`` and the stamp of each config. Only what is not kept takes a thread of its own.
    """
    shelf = shelf_of(request)
    now = await shelf.stamps.get()
    key = (*asked, *(now.get(name, Stamp()) for name in configs))
    return await shelved(shelf, key, make)


async def shelved(shelf: Shelf, key: Key, make: Callable[[], Made]) -> Body:
    """Return the body of ``key``, made where it is not kept; of many who want the same, one makes it."""
    if body := shelf.bodies.found(key):
        return body
    # One at a time: who waits, and takes no thread meanwhile, finds it made.
    return await to_thread.run_sync(shelf.bodies.get, key, make, limiter=shelf.makers)


def answer(request: Request, body: Body, media_type: str, headers: Mapping[str, str]) -> Response:
    """Return a body as a response, 304 without it where the client has it."""
    told = {"ETag": body.etag, **headers}
    if body.etag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=told)
    return Response(body.content, media_type=media_type, headers=told)
