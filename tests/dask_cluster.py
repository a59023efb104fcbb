"""Local dask scheduler and workers, each started as a separate process with the ``dask`` command line."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.processes import wait_until


@dataclass
class Cluster:
    """Dask cluster; ``folder`` holds logs and scratch files, and restarted schedulers reuse ``port``."""

    folder: Path
    port: int
    processes: list[subprocess.Popen[bytes]] = field(default_factory=list)
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"tcp://127.0.0.1:{self.port}"

    def start_scheduler(self) -> subprocess.Popen[bytes]:
        """Start a scheduler and wait until it listens."""
        return self._start("scheduler", "Scheduler at", "--host", "127.0.0.1", "--port", str(self.port))

    def start_worker(self, **environment: str) -> subprocess.Popen[bytes]:
        """Start a worker with its own scratch folder and wait until it is registered with the scheduler."""
        scratch = self.folder / f"worker-{len(self.processes)}"
        scratch.mkdir()
        options = (self.address, "--nthreads", "1", "--no-nanny", "--local-directory", str(scratch))
        worker = self._start("worker", "Registered to", *options, **environment)
        self.workers.append(worker)
        return worker

    def _start(self, role: str, ready: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        path = self.folder / f"{role}-{len(self.processes)}.log"
        with path.open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", role, *arguments, "--no-dashboard"],
                cwd=self.folder,
                env={**os.environ, **environment},
                stdout=log,
                stderr=log,
            )
        self.processes.append(process)
        wait_until(lambda: ready in path.read_text() or process.poll() is not None, f"the {role} is ready")
        assert process.poll() is None, path.read_text()
        return process


NewCluster = Callable[[Path], AbstractContextManager[Cluster]]


@contextmanager
def new_cluster(folder: Path) -> Iterator[Cluster]:
    """Yield a cluster without a scheduler; all processes that were started are killed at the end."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    cluster = Cluster(folder, port)
    try:
        yield cluster
    finally:
        for process in cluster.processes:
            process.kill()
            process.wait()
