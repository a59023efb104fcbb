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
        scorers = [self._start() for _ in range(self._count)]
        while not self._ended.wait(CHECK_S):
            for place, scorer in enumerate(scorers):
                if scorer.poll() is not None:
                    _LOG.warning("scorer died", status=scorer.returncode)
                    if not self._ended.wait(RESTART_S):
                        scorers[place] = self._start()
        for scorer in scorers:
            scorer.terminate()
        for scorer in scorers:
            try:
                scorer.wait(STOP_S)
            except subprocess.TimeoutExpired:
                scorer.kill()
                scorer.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "leaderboard.scorer_process", str(os.getpid())]
        scorer = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)
        assert scorer.stdin is not None
        try:
            scorer.stdin.write(self._settings.model_dump_json().encode())
            scorer.stdin.close()
        except BrokenPipeError:
            pass  # it is dead already, and will be started again
        return scorer
