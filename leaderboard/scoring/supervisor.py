"""The scorers that a server starts itself: processes that are started again when they die, and stop with it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from types import TracebackType
from typing import Self

import structlog

from leaderboard.settings import Settings

CHECK_S = 0.5
RESTART_S = 2.0
STOP_S = 15.0
_LOG = structlog.get_logger("crew")


class Crew:
    """A context in which ``count`` scorers run."""

    def __init__(self, settings: Settings, count: int) -> None:
        self._settings, self._count = settings, count
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, name="crew", daemon=True)

    def __enter__(self) -> Self:
        self._watcher.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._watcher.join()

    def _watch(self) -> None:
        scorers: list[subprocess.Popen[bytes] | None] = [None] * self._count
        while True:
            for place, scorer in enumerate(scorers):
                if scorer is not None and scorer.poll() is not None:
                    _LOG.warning("scorer died", status=scorer.returncode)
                    self._ended.wait(RESTART_S)
                if (scorer is None or scorer.returncode is not None) and not self._ended.is_set():
                    scorers[place] = self._start()
            if self._ended.wait(CHECK_S):
                break
        running = [scorer for scorer in scorers if scorer is not None]
        for scorer in running:
            scorer.terminate()
        for scorer in running:
            try:
                scorer.wait(STOP_S)
            except subprocess.TimeoutExpired:
                scorer.kill()
                scorer.wait()

    def _start(self) -> subprocess.Popen[bytes] | None:
        command = [sys.executable, "-m", "leaderboard.scoring", str(os.getpid())]
        try:
            scorer = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
        except OSError as error:  # the machine is out of memory or processes: later
            _LOG.warning("scorer not started", error=str(error))
            return None
        assert scorer.stdin is not None
        try:
            scorer.stdin.write(self._settings.model_dump_json().encode())
            scorer.stdin.close()
        except BrokenPipeError:
            pass  # it is dead already, and will be started again
        return scorer
