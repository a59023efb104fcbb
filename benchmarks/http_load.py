"""A load of HTTP/1.1 requests, light enough to leave the server the bottleneck: bare asyncio streams."""

from __future__ import annotations

import asyncio
import json
import random
import resource
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

PIECE = 1 << 16
_LIMIT = 1 << 22


@dataclass(frozen=True)
class Answer:
    """A response: its status, its headers with small names, its body."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True)
class Plan:
    """What is sent: readers that ask for ``targets``, each (route, path), and uploaders with a token each.

    ``pause_s`` and ``upload_pause_s`` pass between a reader's or an uploader's answer and its next request.
    """

    host: str
    port: int
    targets: Sequence[tuple[str, str]]
    readers: int
    seconds: float
    pause_s: float = 0.0
    conditional: bool = False
    archive: Path | None = None
    tokens: Sequence[str] = ()
    upload_pause_s: float = 0.0


@dataclass
class Tally:
    """What came of a load: seconds by route, what went wrong, and the share of a core the client itself took."""

    read_s: dict[str, list[float]] = field(default_factory=dict)
    upload_s: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    unchanged: int = 0
    wall_s: float = 0.0
    client_cores: float = 0.0

    @property
    def all_read_s(self) -> list[float]:
        """Seconds of all reads."""
        return [seconds for one in self.read_s.values() for seconds in one]


def run_load(plan: Plan, seed: int) -> Tally:
    """Send what is planned and return what came of it."""
    tally = Tally({route: [] for route, _ in plan.targets})
    start, start_cpu_s = time.perf_counter(), _cpu_s()
    asyncio.run(_send_all(plan, tally, seed))
    tally.wall_s = time.perf_counter() - start
    tally.client_cores = (_cpu_s() - start_cpu_s) / tally.wall_s
    return tally


async def _send_all(plan: Plan, tally: Tally, seed: int) -> None:
    end = time.perf_counter() + plan.seconds
    readers = [_read(plan, tally, random.Random(seed + place), end) for place in range(plan.readers)]
    uploaders = [_upload(plan, tally, token, end) for token in plan.tokens]
    await asyncio.gather(*readers, *uploaders)


async def _read(plan: Plan, tally: Tally, rng: random.Random, end: float) -> None:
    """Be one reader: a connection that is kept, a request after the other, targets by chance."""
    tags: dict[str, str] = {}
    async with _Connection(plan.host, plan.port) as connection:
        while time.perf_counter() < end:
            route, path = rng.choice(plan.targets)
            tag = f"If-None-Match: {tags[path]}\r\n" if path in tags else ""
            start = time.perf_counter()
            try:
                answer = await connection.ask(f"GET {path} HTTP/1.1\r\nHost: {plan.host}\r\n{tag}\r\n".encode())
            except (OSError, EOFError, ValueError) as error:
                tally.errors.append(f"GET {route}: {error!r}")
                return
            tally.read_s[route].append(time.perf_counter() - start)
            tally.unchanged += answer.status == 304
            if answer.status not in (200, 304):
                tally.errors.append(f"GET {route}: {answer.status} {answer.body[:200]!r}")
            if plan.conditional and "etag" in answer.headers:
                tags[path] = answer.headers["etag"]
            if plan.pause_s:
                await asyncio.sleep(plan.pause_s * (0.5 + rng.random()))


async def _upload(plan: Plan, tally: Tally, token: str, end: float) -> None:
    """Be one uploader: the archive again and again, each time on a connection of its own, as clients do."""
    assert plan.archive is not None
    content = plan.archive.read_bytes()
    while time.perf_counter() < end:
        start = time.perf_counter()
        try:
            async with _Connection(plan.host, plan.port) as connection:
                answer = await connection.ask(*_form(plan.host, token, content))
        except (OSError, EOFError, ValueError) as error:
            tally.errors.append(f"POST: {error!r}")
        else:
            tally.upload_s.append(time.perf_counter() - start)
            if answer.status != 202 or json.loads(answer.body)["status"] != "queued":
                tally.errors.append(f"POST: {answer.status} {answer.body[:200]!r}")
        await asyncio.sleep(plan.upload_pause_s)


def _form(host: str, token: str, content: bytes) -> tuple[bytes, ...]:
    """Return an upload's request: its head, the form's parts."""
    boundary = secrets.token_hex(16)
    before = (
        f'--{boundary}\r\nContent-Disposition: form-data; name="archive"; filename="a.zip"\r\n'
        "Content-Type: application/zip\r\n\r\n"
    ).encode()
    after = f"\r\n--{boundary}--\r\n".encode()
    head = (
        f"POST /api/v1/submissions HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n"
        f"Content-Type: multipart/form-data; boundary={boundary}\r\n"
        f"Content-Length: {len(before) + len(content) + len(after)}\r\n\r\n"
    ).encode()
    return head, before, content, after


class _Connection:
    """A connection that is kept between requests."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port

    async def __aenter__(self) -> _Connection:
        self._reader, self._writer = await asyncio.open_connection(self._host, self._port, limit=_LIMIT)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._writer.close()

    async def ask(self, *parts: bytes) -> Answer:
        """Send a request and return its answer. Raises ``EOFError`` or ``OSError`` where the connection is cut."""
        for part in parts:
            view = memoryview(part)
            for start in range(0, len(view), PIECE):
                self._writer.write(view[start : start + PIECE])
                await self._writer.drain()
        head = (await self._reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:])}
        status = int(head[0].split()[1])
        if status in (204, 304):
            return Answer(status, headers, b"")
        return Answer(status, headers, await self._reader.readexactly(int(headers["content-length"])))


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime
