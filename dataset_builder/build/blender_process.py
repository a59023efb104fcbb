"""Blender in a process of its own: one task in, events out, and nothing that Blender prints.

The task is pickled to the process's standard input, which then stays open: the process ends itself when it
closes, so no render outlives its parent. Events come back as JSON lines on its standard output. Whatever
Blender or its libraries print goes to a log that is shown only when the process fails.

What a Blender process can be asked to do. Plain values: they are pickled to the process.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from dataset_builder.config.rigs import Camera
from dataset_builder.config.specs import ConfigSpec
import json
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from types import TracebackType
from typing import Any
from rebar_depth_bench.errors import BuildError, InputError, RebarDepthError, RenderProcessError

@dataclass(frozen=True)
class RenderTask:
    """Render views of one shard of a config into ``staging``; views already staged are not done again.

    Idempotent: the same task gives the same bytes, however often it is interrupted. Where ``mesh_sha256`` is
    known, a scene whose mesh has another digest is refused before anything is rendered.
    """

    config: ConfigSpec
    shard: int
    indices: tuple[int, ...]
    staging: Path
    threads: int
    mesh_sha256: str | None = None


@dataclass(frozen=True)
class DepthTask:
    """Render Cycles' own planar depth of a mesh file from some cameras; one float32 .npy each into ``out``."""

    mesh: Path
    cameras: tuple[Camera, ...]
    out: Path
    threads: int


Task = RenderTask | DepthTask


Event = Mapping[str, Any]
_ERRORS: Mapping[str, type[RebarDepthError]] = {"input_error": InputError, "build_error": BuildError}
"""The events that end a task, and what each is raised as."""
ATTEMPTS = 2
_LOG_TAIL_LINES = 15


class BlenderProcesses:
    """Runs tasks in Blender processes; on leaving the context whatever still runs is killed."""

    def __init__(self) -> None:
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._closed = False

    def __enter__(self) -> BlenderProcesses:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._closed = True
            for process in self._running:
                process.kill()

    def run(self, task: Task, what: str, log: Path, on_event: Callable[[Event], None]) -> None:
        """Run ``task``; a process that dies is started once more, then ``RenderProcessError`` names ``what``.

        Raises ``InputError`` in the process's own words where it found the input at fault, ``BuildError``
        where it refused to go on.
        """
        for attempt in range(1, ATTEMPTS + 1):
            status = self._run_once(task, log, on_event)
            if status == 0:
                return
            if self._closed or attempt == ATTEMPTS:
                raise RenderProcessError(_failure(what, status, attempt, log))

    def _run_once(self, task: Task, log: Path, on_event: Callable[[Event], None]) -> int:
        log.parent.mkdir(parents=True, exist_ok=True)
        with self._start(log) as process:
            try:
                return _talk(process, task, on_event)
            except BaseException:
                process.kill()
                raise
            finally:
                with self._lock:
                    self._running.discard(process)

    def _start(self, log: Path) -> subprocess.Popen[bytes]:
        with self._lock:
            if self._closed:
                raise RenderProcessError("the build is ending, no further render process is started")
            process = subprocess.Popen(
                [sys.executable, "-m", "dataset_builder.blender", str(log)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,
            )
            self._running.add(process)
            return process


def _talk(process: subprocess.Popen[bytes], task: Task, on_event: Callable[[Event], None]) -> int:
    """Hand the task over, pass the events on, and return the process's exit status."""
    assert process.stdin is not None
    assert process.stdout is not None
    _send(process.stdin, task)
    for line in process.stdout:
        if not line.endswith(b"\n"):
            break  # it died in the middle of a word
        _pass_on(json.loads(line), on_event)
    return process.wait()


def _send(stream: Any, task: Task) -> None:
    try:
        stream.write(pickle.dumps(task))
        stream.flush()
    except BrokenPipeError:  # the process died at once; its exit status and log say why
        with suppress(BrokenPipeError):
            stream.close()  # what it could not be told must not be tried again when the process is left


def _pass_on(event: Event, on_event: Callable[[Event], None]) -> None:
    for name, error in _ERRORS.items():
        if name in event:
            raise error(event[name])
    on_event(event)


def _failure(what: str, status: int, attempts: int, log: Path) -> str:
    reason = f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
    tail = log.read_text(errors="replace").splitlines()[-_LOG_TAIL_LINES:] if log.is_file() else []
    said = "\n".join(f"  | {line}" for line in tail) or "  | (it printed nothing)"
    return f"the render process for {what} died {attempts} times, last by {reason}; the end of {log}:\n{said}"
