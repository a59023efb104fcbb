"""HTTP/1.1 load generator on plain asyncio streams, with low overhead so that the server is the bottleneck."""

from __future__ import annotations

import asyncio
import json
import random
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

WRITE_CHUNK_BYTES = 1 << 16
_STREAM_LIMIT_BYTES = 1 << 22


@dataclass(frozen=True)
class Response:
    """HTTP response: status, headers with lower-case names, and body."""

    status: int
    headers: Mapping[str, str]
    body: bytes


@dataclass(frozen=True)
class LoadPlan:
    """Definition of a load: readers that request random ``targets`` (route, path), and one uploader per token.

    ``pause_s`` and ``upload_pause_s`` are the seconds between the response to a reader or an uploader and its next
    request. ``archives`` are uploaded one after the other. ``conditional`` readers send ``If-None-Match`` with the
    last entity tag of the path.
    """

    host: str
    port: int
    targets: Sequence[tuple[str, str]]
    readers: int
    seconds: float
    pause_s: float = 0.0
    conditional: bool = False
    archives: Iterator[bytes] = field(default_factory=lambda: iter(()))
    tokens: Sequence[str] = ()
    upload_pause_s: float = 0.0


@dataclass
class LoadResult:
    """Measurements of a load: response times by route, errors, and the client's CPU use in cores."""

    read_s: dict[str, list[float]] = field(default_factory=dict)
    upload_s: list[float] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    unchanged: int = 0
    wall_s: float = 0.0
    client_cores: float = 0.0

    @property
    def all_read_s(self) -> list[float]:
        """Response times of all reads, in seconds."""
        return [seconds for route_seconds in self.read_s.values() for seconds in route_seconds]


def run_load(plan: LoadPlan, seed: int) -> LoadResult:
    """Send the requests of a plan and return the measurements."""
    result = LoadResult({route: [] for route, _ in plan.targets})
    start, start_cpu_s = time.perf_counter(), _cpu_s()
    asyncio.run(_send_all(plan, result, seed))
    result.wall_s = time.perf_counter() - start
    result.client_cores = (_cpu_s() - start_cpu_s) / result.wall_s
    return result


async def _send_all(plan: LoadPlan, result: LoadResult, seed: int) -> None:
    end = time.perf_counter() + plan.seconds
    readers = [_run_reader(plan, result, random.Random(seed + index), end) for index in range(plan.readers)]
    uploaders = [_run_uploader(plan, result, token, end) for token in plan.tokens]
    await asyncio.gather(*readers, *uploaders)


async def _run_reader(plan: LoadPlan, result: LoadResult, rng: random.Random, end: float) -> None:
    """Request random targets one after the other on one persistent connection until ``end``."""
    etags: dict[str, str] = {}
    async with _Connection(plan.host, plan.port) as connection:
        while time.perf_counter() < end:
            route, path = rng.choice(plan.targets)
            if_none_match = f"If-None-Match: {etags[path]}\r\n" if path in etags else ""
            start = time.perf_counter()
            try:
                response = await connection.send_request(
                    f"GET {path} HTTP/1.1\r\nHost: {plan.host}\r\n{if_none_match}\r\n".encode()
                )
            except (OSError, EOFError, ValueError) as error:
                result.errors.append(f"GET {route}: {error!r}")
                return
            result.read_s[route].append(time.perf_counter() - start)
            result.unchanged += response.status == 304
            if response.status not in (200, 304):
                result.errors.append(f"GET {route}: {response.status} {response.body[:200]!r}")
            if plan.conditional and "etag" in response.headers:
                etags[path] = response.headers["etag"]
            if plan.pause_s:
                await asyncio.sleep(plan.pause_s * (0.5 + rng.random()))


async def _run_uploader(plan: LoadPlan, result: LoadResult, token: str, end: float) -> None:
    """Upload archives until ``end``, each time on a new connection as real clients do."""
    while time.perf_counter() < end:
        content = next(plan.archives)
        start = time.perf_counter()
        try:
            async with _Connection(plan.host, plan.port) as connection:
                response = await connection.send_request(*_upload_request(plan.host, token, content))
        except (OSError, EOFError, ValueError) as error:
            result.errors.append(f"PUT: {error!r}")
        else:
            result.upload_s.append(time.perf_counter() - start)
            if response.status != 202 or json.loads(response.body)["status"] != "queued":
                result.errors.append(f"PUT: {response.status} {response.body[:200]!r}")
        await asyncio.sleep(plan.upload_pause_s)


def _upload_request(host: str, token: str, content: bytes) -> tuple[bytes, ...]:
    """Return head and body of an upload."""
    head = (
        f"PUT /api/v1/submissions HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n"
        f"Content-Length: {len(content)}\r\n\r\n"
    ).encode()
    return head, content


class _Connection:
    """Persistent HTTP/1.1 connection."""

    def __init__(self, host: str, port: int) -> None:
        self._host, self._port = host, port

    async def __aenter__(self) -> _Connection:
        self._reader, self._writer = await asyncio.open_connection(
            self._host, self._port, limit=_STREAM_LIMIT_BYTES
        )
        return self

    async def __aexit__(self, *_: object) -> None:
        self._writer.close()

    async def send_request(self, *parts: bytes) -> Response:
        """Send a request and return its response. Raises ``EOFError`` or ``OSError`` on a closed connection."""
        for part in parts:
            view = memoryview(part)
            for start in range(0, len(view), WRITE_CHUNK_BYTES):
                self._writer.write(view[start : start + WRITE_CHUNK_BYTES])
                await self._writer.drain()
        head = (await self._reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:])}
        status = int(head[0].split()[1])
        if status in (204, 304):
            return Response(status, headers, b"")
        return Response(status, headers, await self._reader.readexactly(int(headers["content-length"])))


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime
