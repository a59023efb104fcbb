"""Benchmark of the leaderboard: its speed beside a bare FastAPI app, and reads during uploads and scoring.

python -m benchmarks.leaderboard ROOT ARCHIVE [--rows N] [--seconds S] [--repeats N] [--uploaders N] [--db URL]

The real server runs in a process of its own, with scored submissions that differ from the result of ARCHIVE by a
factor of their errors. The bare app returns the same bytes from memory, without middleware; both are measured by
turns. Then 50 readers send their next request immediately after a response, alone and beside uploaders, so that
the rates are the maximum throughput. ``--db`` names an empty database, which is filled; default: SQLite.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import random
import re
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, print_markdown
from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import QUEUED, SCORED, SCORING, Quota, Upload
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import read_settings
from rebar_depth_bench.submission import SubmissionMeta

CLIENTS = (1, 50)
START_S, UPLOAD_PAUSE_S = 120.0, 5.0
WITHOUT_LIMIT = 1_000_000_000
_STREAM_LIMIT_BYTES = 1 << 22
_BARE_APP = """
import socket
import sys
from pathlib import Path
import uvicorn
from fastapi import FastAPI
from fastapi.responses import Response

app = FastAPI()

def add_route(number: int, content: bytes) -> None:
    @app.get(f"/{number}")
    async def get() -> Response:
        return Response(content, media_type="text/html")

for number, path in enumerate(sorted(Path(sys.argv[1]).iterdir())):
    add_route(number, path.read_bytes())
listener = socket.create_server(("127.0.0.1", 0), backlog=512)
listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # As asyncio does for its own sockets.
print(f"http://127.0.0.1:{listener.getsockname()[1]}", file=sys.stderr, flush=True)
uvicorn.Server(uvicorn.Config(app, http="h11", access_log=False, log_level="warning")).run(sockets=[listener])
"""


@dataclass(frozen=True)
class Served:
    """Running server: its port on this machine and its process id."""

    port: int
    pid: int

    def cpu_s(self) -> float:
        """Return the user and system CPU seconds of the server process (Linux only)."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def body(self, path: str) -> bytes:
        """Return the body of a page."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}") as response:
            content: bytes = response.read()
        return content


@dataclass
class Load:
    """Measurements of a load: response times, wall-clock and server CPU seconds, and submissions scored."""

    read_s: list[float] = field(default_factory=list)
    upload_s: list[float] = field(default_factory=list)
    wall_s: float = 0.0
    server_cpu_s: float = 0.0
    scored: int = 0

    @property
    def reads_per_s(self) -> float:
        """Return the reads per second."""
        return len(self.read_s) / self.wall_s

    @property
    def cpu_ms(self) -> float:
        """Return the processor time of the server for a read in milliseconds."""
        return 1000 * self.server_cpu_s / len(self.read_s)

    def read_ms(self, share: float) -> float:
        """Return a quantile of the response times in milliseconds, by nearest rank."""
        ordered = sorted(self.read_s)
        return 1000 * ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser("python -m benchmarks.leaderboard")
    parser.add_argument("data", type=Path, metavar="ROOT", help="a dataset folder")
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="an archive of it")
    parser.add_argument("--rows", type=int, default=200, help="scored rows on the leaderboard")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a measurement")
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each kind, by turns")
    parser.add_argument("--uploaders", type=int, default=4)
    parser.add_argument("--db", default="", metavar="URL", help="an empty database; default: SQLite")
    options = parser.parse_args(arguments)
    print(f"{options.rows} rows; {machine_description()}; medians of {options.repeats}")
    with tempfile.TemporaryDirectory() as scratch:
        state, bodies = Path(scratch) / "state", Path(scratch) / "bodies"
        state.mkdir(mode=0o700)
        bodies.mkdir()
        result = json.loads(rdb.score(options.archive, options.data).to_json())
        settings = read_settings(None, {"data": str(options.data), "state_dir": state, "db": options.db})
        with closing(Database(settings.database_url)) as database:
            database.migrate()
            if _count(database):
                sys.exit("the database holds submissions, expected an empty one")
            ids = add_scored_submissions(database, result, options.rows)
            config = next(iter(result["tables"]))
            targets = ("/", f"/?config={config}", f"/api/v1/leaderboard?config={config}", f"/submissions/{ids[0]}")
            with leaderboard(options.data, state, options.db) as served:
                for number, path in enumerate(targets):
                    (bodies / f"{number:02d}").write_bytes(served.body(path))
                with started([sys.executable, "-c", _BARE_APP, str(bodies)], state / "bare.log") as bare:
                    _print_overhead(served, bare, targets, options)
                _print_reads(served, database, targets, ids, options)


def _print_overhead(served: Served, bare: Served, targets: Sequence[str], options: argparse.Namespace) -> None:
    """Print the rate of each page beside that of the bare app."""
    rows = []
    for number, path in enumerate(targets):
        size = len(bare.body(f"/{number}"))
        for clients in CLIENTS:
            loads: dict[Served, list[Load]] = {served: [], bare: []}
            for _ in range(options.repeats):
                for server, page in ((served, path), (bare, f"/{number}")):
                    loads[server].append(run_load(server, [page], clients, options.seconds))
            rates = [statistics.median(load.reads_per_s for load in of_one) for of_one in loads.values()]
            times_ms = [statistics.median(load.cpu_ms for load in of_one) for of_one in loads.values()]
            cells = (*(f"{rate:.0f}" for rate in rates), f"{rates[0] / rates[1]:.0%}")
            cells += (*(f"{ms:.2f}" for ms in times_ms), f"{times_ms[1] / times_ms[0]:.0%}")
            rows.append((f"`{path}`", f"{size / 1000:.0f}", clients, *cells))
    heads = ["page", "kB", "clients", "leaderboard/s", "bare/s", "share"]
    print()
    print_markdown([*heads, "leaderboard ms", "bare ms", "share by processor time"], rows)


def _print_reads(
    served: Served, database: Database, targets: Sequence[str], ids: Sequence[str], options: argparse.Namespace
) -> None:
    """Print the reads of 50 readers, alone and beside uploads and scoring."""
    tokens = [_new_token(database)[0] for _ in range(options.uploaders)]
    archives = _distinct(options.archive.read_bytes())
    loads: dict[str, list[Load]] = {"alone": [], "with uploads and scoring": []}
    for _ in range(options.repeats):
        for name, uploading in zip(loads, ([], tokens), strict=True):
            before = _count(database, SCORED)
            load = run_load(served, targets, CLIENTS[-1], options.seconds, uploading, archives)
            load.scored = _count(database, SCORED) - before
            _remove_others(database, ids)
            loads[name].append(load)
    columns = {
        "reads a second": lambda load: load.reads_per_s,
        "p50 ms": lambda load: load.read_ms(0.5),
        "p99 ms": lambda load: load.read_ms(0.99),
        "max ms": lambda load: load.read_ms(1.0),
        "uploads a minute": lambda load: 60 * len(load.upload_s) / load.wall_s,
        "scored a minute": lambda load: 60 * load.scored / load.wall_s,
    }
    print()
    print_markdown(
        ["reads", *columns],
        [
            (name, *(f"{statistics.median(map(of_load, windows)):.0f}" for of_load in columns.values()))
            for name, windows in loads.items()
        ],
    )


def add_scored_submissions(database: Database, result: dict[str, Any], rows: int) -> list[str]:
    """Add ``rows`` scored submissions with varied errors, in the way a scoring worker does; return their ids."""
    rng = random.Random(0)
    token = _new_token(database)[1]
    ids = []
    for number in range(rows):
        submission_id, method = submissions.new_id(), f"method {number:04d}"
        meta = SubmissionMeta(method=method, url="https://example.org/method" if number % 2 else None)
        upload = Upload(meta, f"{number:064x}", 1, result["dataset"]["digest"])
        submissions.accept(database, submission_id, token, upload, Quota(WITHOUT_LIMIT, WITHOUT_LIMIT), True)
        jobs.claim(database, "benchmark", 60.0)
        varied = _with_errors(result, rng.uniform(0.2, 5.0))
        varied["submission"]["method"] = method
        jobs.finish(database, submission_id, "benchmark", Outcome(json.dumps(varied).encode()))
        ids.append(submission_id)
    return ids


def _with_errors(part: Any, factor: float, name: str = "") -> Any:
    """Return part of a result with the ratio of its rank errors to 1 - rank error multiplied by ``factor``."""
    if isinstance(part, dict):
        return {key: _with_errors(value, factor, key) for key, value in part.items()}
    if isinstance(part, list):
        return [_with_errors(value, factor, name) for value in part]
    return part * factor / (1 - part + part * factor) if name == "rank_error" and part is not None else part


def _new_token(database: Database) -> tuple[str, TokenModel]:
    token = create_token(database, f"benchmark {random.getrandbits(64)}")
    record = find_token(database, token)
    assert record is not None
    return token, record


def _count(database: Database, *statuses: str) -> int:
    """Return the number of submissions with one of the statuses, or of all submissions if none is given."""
    query = select(func.count()).select_from(SubmissionModel)
    with database.read() as session:
        return session.scalar(query.where(SubmissionModel.status.in_(statuses)) if statuses else query) or 0


def _remove_others(database: Database, ids: Sequence[str]) -> None:
    """Remove uploaded submissions, so that each measurement has the same rows; running ones end before."""
    for status in (QUEUED, SCORED):
        while _count(database, SCORING):
            time.sleep(0.2)
        with database.read() as session:
            found = session.scalars(select(SubmissionModel.id).where(SubmissionModel.status == status)).all()
        for submission_id in set(found) - set(ids):
            submissions.remove(database, submission_id)


@contextmanager
def leaderboard(data: Path, state: Path, db: str) -> Iterator[Served]:
    """Run ``rebar-leaderboard serve`` with one worker, and rate limits and quota too high to take effect."""
    command = [sys.executable, "-m", "leaderboard", "serve", "--data", str(data), "--state-dir", str(state)]
    command += ["--port", "0", "--quota", str(WITHOUT_LIMIT), "--quota-bytes", "1TiB"]
    command += ["--max-connections-per-address", "0", *(["--db", db] if db else [])]
    command += ["--read-rate-limit", f"{WITHOUT_LIMIT}/minute", "--write-rate-limit", f"{WITHOUT_LIMIT}/minute"]
    with started(command, state / "log") as served:
        yield served


@contextmanager
def started(command: Sequence[str], log: Path) -> Iterator[Served]:
    """Run a server, which prints its address to standard error, until the block ends."""
    with log.open("w") as stream:
        process = subprocess.Popen(command, stderr=stream)
    try:
        deadline = time.monotonic() + START_S
        while (address := re.search(r"^http://\S+:(\d+)$", log.read_text(), re.MULTILINE)) is None:
            if process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the server did not start:\n{log.read_text()}")
            time.sleep(0.05)
        yield Served(int(address[1]), process.pid)
    finally:
        process.terminate()
        process.wait()


def run_load(
    server: Served,
    paths: Sequence[str],
    readers: int,
    seconds: float,
    tokens: Sequence[str] = (),
    archives: Iterator[bytes] | None = None,
) -> Load:
    """Send requests for random ``paths`` by ``readers``, and uploads of ``archives`` by an uploader per token.

    The requests are written to plain streams, so that the server, not the client, limits the rate.
    """
    load = Load()
    start, cpu_s = time.perf_counter(), server.cpu_s()
    end = start + seconds

    async def read(number: int) -> None:
        choose = random.Random(number)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=_STREAM_LIMIT_BYTES)
        while (sent := time.perf_counter()) < end:
            writer.write(f"GET {choose.choice(paths)} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            assert await _status(reader) == 200
            load.read_s.append(time.perf_counter() - sent)
        writer.close()

    async def upload(token: str) -> None:
        while (sent := time.perf_counter()) < end:
            assert archives is not None
            content = next(archives)
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            head = f"PUT /api/v1/submissions HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n"
            writer.write(f"{head}Content-Length: {len(content)}\r\n\r\n".encode() + content)
            await writer.drain()
            assert await _status(reader) == 202
            load.upload_s.append(time.perf_counter() - sent)
            writer.close()
            await asyncio.sleep(UPLOAD_PAUSE_S)

    async def send() -> None:
        await asyncio.gather(*map(read, range(readers)), *map(upload, tokens))

    asyncio.run(send())
    load.wall_s, load.server_cpu_s = time.perf_counter() - start, server.cpu_s() - cpu_s
    return load


async def _status(reader: asyncio.StreamReader) -> int:
    """Return the status of a response, after its body was read."""
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    length = re.search(r"\r\ncontent-length: (\d+)\r\n", head, re.IGNORECASE)
    assert length is not None, head
    await reader.readexactly(int(length[1]))
    return int(head.split()[1])


def _distinct(archive: bytes) -> Iterator[bytes]:
    """Yield copies of an archive that differ in the comment of the zip file, so that each is scored."""
    assert archive[-2:] == b"\0\0", "the archive has a comment"
    number = 0
    while True:
        comment = f"copy {number}".encode()
        yield archive[:-2] + len(comment).to_bytes(2, "little") + comment
        number += 1


if __name__ == "__main__":
    main()
