"""A dask scheduler and its workers, each a process of its own, started as an operator starts them."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.leaderboard.watching import wait_until


@dataclass
class Cluster:
    """``folder`` holds logs and scratch files; ``port`` is kept by a scheduler that goes and comes again."""

    folder: Path
    port: int
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        """Start a scheduler and wait until it listens."""
        options = ("--host", "127.0.0.1", "--port", str(self.port), "--no-dashboard")
        return self._start("scheduler", "Scheduler at", *options)

    def start_worker(self) -> subprocess.Popen[bytes]:
        """Start a worker and wait until the scheduler knows it; it runs in a folder of its own."""
        options = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(self.folder))
        return self._start("worker", "Registered to", self.address, *options)

    def logs(self) -> str:
        """Return all that scheduler and workers wrote."""
        return "\n".join(path.read_text() for path in sorted(self.folder.glob("*.log")))

    def _start(self, role: str, ready: str, *arguments: str) -> subprocess.Popen[bytes]:
        path = self.folder / f"{role}-{len(self.processes)}.log"
        with path.open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", role, *arguments], cwd=self.folder, stdout=log, stderr=log
            )
        self.processes.append(process)
        wait_until(lambda: ready in path.read_text() or process.poll() is not None, f"the {role} is ready")
        assert process.poll() is None, path.read_text()
        return process


@contextmanager
def new_cluster(folder: Path) -> Iterator[Cluster]:
    """Yield a cluster without a scheduler yet; what was started is killed at the end."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    cluster = Cluster(folder, port)
    try:
        yield cluster
    finally:
        for process in cluster.processes:
            process.kill()
            process.wait()
