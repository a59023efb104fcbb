"""Benchmark of the leaderboard: the first page after a change, and reads beside a large upload.

python -m benchmarks.leaderboard ROOT ARCHIVE [--rows N] [--seconds S] [--repeats N] [--db URL]

The real server runs in a process of its own, with scored submissions that differ from the result of ARCHIVE by a
factor of their errors. The first request for a page after a change of a submission renders it; the times are
medians. Then 50 readers send their next request immediately after a response, alone and while ARCHIVE is uploaded
again and again, so that the rates are the maximum throughput. ``--db`` names an empty database, which is filled;
default: SQLite.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
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

from sqlalchemy import select

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, print_markdown
from leaderboard.db import jobs, submissions
from leaderboard.db.engine import Database
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DELETED, QUEUED
from leaderboard.db.tokens import create_token, find_token
from leaderboard.scoring.sandbox import Outcome
from leaderboard.settings import read_settings

READERS = 50
START_S = 120.0
WITHOUT_LIMIT = 1_000_000_000
_STREAM_LIMIT_BYTES = 1 << 22


@dataclass(frozen=True)
class Served:
    """Running server: its port on this machine and its process id."""

    port: int
    pid: int

    def body(self, path: str) -> bytes:
        """Return the body of a page."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}") as response:
            content: bytes = response.read()
        return content


@dataclass
class Load:
    """Measurements of a load: response times, wall-clock seconds, uploads, and responses with another status."""

    read_s: list[float] = field(default_factory=list)
    upload_s: list[float] = field(default_factory=list)
    wall_s: float = 0.0
    errors: int = 0

    @property
    def reads_per_s(self) -> float:
        """Return the reads per second."""
        return len(self.read_s) / self.wall_s

    def read_ms(self, share: float) -> float:
        """Return a quantile of the response times in milliseconds, by nearest rank."""
        ordered = sorted(self.read_s)
        return 1000 * ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser("python -m benchmarks.leaderboard")
    parser.add_argument("data", type=Path, metavar="ROOT", help="a dataset folder")
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="an archive of it")
    parser.add_argument("--rows", type=int, default=1000, help="scored rows on the leaderboard")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a measurement")
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each kind, by turns")
    parser.add_argument("--db", default="", metavar="URL", help="an empty database; default: SQLite")
    options = parser.parse_args(arguments)
    print(f"{options.rows} rows; {machine_description()}; medians of {options.repeats}")
    with tempfile.TemporaryDirectory() as scratch:
        state = Path(scratch) / "state"
        state.mkdir(mode=0o700)
        result = json.loads(rdb.score(options.archive, options.data).to_json())
        settings = read_settings(None, {"data": str(options.data), "state_dir": state, "db": options.db})
        with closing(Database(settings.database_url)) as database:
            database.create_schema()
            if _ids(database):
                sys.exit("the database holds submissions, expected an empty one")
            jobs.serve_dataset(database, result["dataset"]["digest"], rescore=False)
            ids = add_scored_submissions(database, result, options.rows)
            config = next(iter(result["tables"]))
            targets = ("/", f"/?config={config}", f"/api/v1/leaderboard?config={config}", f"/submissions/{ids[0]}")
            with leaderboard(options.data, state, options.db) as served:
                _print_first_pages(served, database, targets, ids, options.repeats)
                _print_reads(served, database, targets, ids, options)


def _print_first_pages(
    served: Served, database: Database, targets: Sequence[str], ids: Sequence[str], repeats: int
) -> None:
    """Print the time of the first request for each page after a change, and of the next one."""
    rows = []
    for path in targets:
        size = len(served.body(path))
        times_ms: list[list[float]] = [[], []]
        for _ in range(max(repeats, 5)):
            submissions.change(database, ids[-1], {"public": True})
            for of_turn in times_ms:
                start = time.perf_counter()
                served.body(path)
                of_turn.append(1000 * (time.perf_counter() - start))
        rows.append((f"`{path[:40]}`", f"{size / 1000:.0f}", *(f"{statistics.median(ms):.0f}" for ms in times_ms)))
    print()
    print_markdown(["page", "kB", "first after a change, ms", "next, ms"], rows)


def _print_reads(
    served: Served, database: Database, targets: Sequence[str], ids: Sequence[str], options: argparse.Namespace
) -> None:
    """Print the reads of 50 readers, alone and beside uploads of a large archive."""
    token = _new_token(database)[0]
    archive = options.archive.read_bytes()
    archives = _distinct(archive)
    loads: dict[str, list[Load]] = {"alone": [], f"beside uploads of {len(archive) / 1e6:.0f} MB": []}
    for _ in range(options.repeats):
        for name, sender in zip(loads, ("", token), strict=True):
            loads[name].append(run_load(served, targets, options.seconds, sender, archives))
            for submission_id in set(_ids(database)) - set(ids):
                submissions.remove(database, submission_id)
    columns = {
        "reads a second": lambda load: load.reads_per_s,
        "p50 ms": lambda load: load.read_ms(0.5),
        "p99 ms": lambda load: load.read_ms(0.99),
        "max ms": lambda load: load.read_ms(1.0),
        "errors": lambda load: load.errors,
        "uploads": lambda load: len(load.upload_s),
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
        with database.write() as session:
            session.add(
                SubmissionModel(
                    id=submission_id,
                    token_id=token.id,
                    method=method,
                    details=json.dumps({"url": "https://example.org/method"} if number % 2 else {}),
                    archive_sha256=f"{number:064x}",
                    archive_bytes=1,
                    archive_deleted_at=1.0,
                    public=True,
                    created_at=time.time(),
                    queued_at=time.time(),
                    status=QUEUED,
                    attempts=0,
                )
            )
        jobs.claim(database, "benchmark", 60.0)
        varied = _with_errors(result, rng.uniform(0.2, 5.0))
        varied["submission"]["method"] = method
        outcome = Outcome(result["dataset"]["digest"], json.dumps(varied).encode())
        jobs.finish(database, submission_id, "benchmark", outcome)
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


def _ids(database: Database) -> list[str]:
    """Return the ids of all submissions that are not deleted."""
    with database.read() as session:
        return list(session.scalars(select(SubmissionModel.id).where(SubmissionModel.status != DELETED)))


@contextmanager
def leaderboard(data: Path, state: Path, db: str) -> Iterator[Served]:
    """Run ``rebar-leaderboard serve`` without workers, with a quota too high to take effect."""
    command = [sys.executable, "-m", "leaderboard", "serve", "--data", str(data), "--state-dir", str(state)]
    command += ["--port", "0", "--quota", str(WITHOUT_LIMIT), "--quota-bytes", "1TiB", "--workers", "0"]
    command += ["--db", db] if db else []
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


def run_load(server: Served, paths: Sequence[str], seconds: float, token: str, archives: Iterator[bytes]) -> Load:
    """Send requests for random ``paths`` by ``READERS`` readers, and uploads of ``archives`` if there is a token.

    The requests are written to plain streams, so that the server, not the client, limits the rate.
    """
    load = Load()
    start = time.perf_counter()
    end = start + seconds

    async def read(number: int) -> None:
        choose = random.Random(number)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=_STREAM_LIMIT_BYTES)
        while (sent := time.perf_counter()) < end:
            writer.write(f"GET {choose.choice(paths)} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode())
            load.errors += await _status(reader) != 200
            load.read_s.append(time.perf_counter() - sent)
        writer.close()

    async def upload() -> None:
        while token and (sent := time.perf_counter()) < end:
            content = next(archives)
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            head = f"PUT /api/v1/submissions HTTP/1.1\r\nHost: 127.0.0.1\r\nAuthorization: Bearer {token}\r\n"
            writer.write(f"{head}Content-Length: {len(content)}\r\n\r\n".encode())
            for offset in range(0, len(content), 1 << 20):
                writer.write(content[offset : offset + (1 << 20)])
                await writer.drain()
            load.errors += await _status(reader) != 202
            load.upload_s.append(time.perf_counter() - sent)
            writer.close()

    async def send() -> None:
        await asyncio.gather(*map(read, range(READERS)), upload())

    asyncio.run(send())
    load.wall_s = time.perf_counter() - start
    return load


async def _status(reader: asyncio.StreamReader) -> int:
    """Return the status of a response, after its body was read."""
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
    length = re.search(r"\r\ncontent-length: (\d+)\r\n", head, re.IGNORECASE)
    assert length is not None, head
    await reader.readexactly(int(length[1]))
    return int(head.split()[1])


def _distinct(archive: bytes) -> Iterator[bytes]:
    """Yield copies of an archive that differ in the comment of the zip file, so that each is checked."""
    assert archive[-2:] == b"\0\0", "the archive has a comment"
    for number in itertools.count():
        comment = f"copy {number}".encode()
        yield archive[:-2] + len(comment).to_bytes(2, "little") + comment


if __name__ == "__main__":
    main()
