"""Supervisor of local workers: starts, restarts and stops worker processes together with the server."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from typing import Self

import structlog

from leaderboard.settings import Settings

CHECK_INTERVAL_S = 0.5
RESTART_DELAY_S = 2.0
STOP_TIMEOUT_S = 15.0
_LOG = structlog.get_logger("supervisor")


class WorkerSupervisor:
    """Context manager in which ``count`` worker processes run; workers that die are restarted."""

    def __init__(self, settings: Settings, count: int) -> None:
        self._settings = settings
        self._stopping = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="supervisor", daemon=True)
        self._workers: list[subprocess.Popen[bytes] | None] = [None] * count

    def __enter__(self) -> Self:
        self._watcher.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._watcher.join()

    def running(self) -> int:
        """Return the number of running workers."""
        return sum(worker is not None and worker.poll() is None for worker in self._workers)

    def _watch(self) -> None:
        workers = self._workers
        while True:
            for index, worker in enumerate(workers):
                if worker is not None and worker.poll() is not None:
                    _LOG.warning("worker exited unexpectedly; restarting", status=worker.returncode)
                    self._stopping.wait(RESTART_DELAY_S)
                if (worker is None or worker.returncode is not None) and not self._stopping.is_set():
                    workers[index] = self._start()
            if self._stopping.wait(CHECK_INTERVAL_S):
                break
        running = [worker for worker in workers if worker is not None]
        for worker in running:
            worker.terminate()
        for worker in running:
            try:
                worker.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                worker.kill()
                worker.wait()

    def _start(self) -> subprocess.Popen[bytes] | None:
        command = [sys.executable, "-P", "-m", "leaderboard.scoring", str(os.getpid())]
        try:
            worker = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
        except OSError as error:  # Out of memory or processes: try again later.
            _LOG.warning("worker not started; retrying", error=str(error))
            return None
        assert worker.stdin is not None
        try:
            worker.stdin.write(self._settings.model_dump_json().encode())
            worker.stdin.close()
        except BrokenPipeError:
            pass  # It has died already and will be restarted.
        return worker
