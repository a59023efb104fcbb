"""Blender process: runs one pickled task from stdin, writes events as JSON lines and Blender's output to a log."""

from __future__ import annotations

import json
import os
import pickle
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, BinaryIO

from dataset_builder.pipeline.blender_process import ERRORS, DepthTask, DevicesTask, RenderTask
from rebar_depth_bench.base.writing import WRITE_ERRORS, write_error

Report = Callable[[Mapping[str, Any]], None]
"""Function that sends one event to the parent process."""


def main() -> int:
    """Run the task pickled on standard input and return exit code 0; ``sys.argv[1]`` is the path of the log.

    ``InputError``, ``BuildError``, ``OutputError`` and errors of a machine that cannot write are reported as
    events; other exceptions are raised.
    """
    report = _event_writer()
    task = pickle.load(sys.stdin.buffer)  # noqa: S301 -- The parent process is this program.
    _exit_with_parent(sys.stdin.buffer)
    try:
        _redirect_output(sys.argv[1])
        _runner_for(task)(task, report)
    except tuple(ERRORS.values()) as error:
        report({name: str(error) for name, kind in ERRORS.items() if isinstance(error, kind)})
    except OSError as error:
        if error.errno not in WRITE_ERRORS:
            raise
        report({"output_error": str(write_error(error.filename or "a file of the render process", error))})
    return 0


def _runner_for(task: object) -> Callable[[Any, Report], None]:
    """Return the function that runs a task.

    The import is local because Blender's output on import must go to the log.
    """
    from dataset_builder.blender.tasks import run_depth_task, run_devices_task, run_render_task

    runners: Mapping[type, Callable[[Any, Report], None]] = {
        RenderTask: run_render_task,
        DepthTask: run_depth_task,
        DevicesTask: run_devices_task,
    }
    return runners[type(task)]


def _event_writer() -> Report:
    """Return a function that writes events to the present standard output."""
    events = os.fdopen(os.dup(1), "w", buffering=1)
    return lambda event: print(json.dumps(event), file=events, flush=True)


def _redirect_output(log: str) -> None:
    """Redirect file descriptors 1 and 2 to the log."""
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    os.close(descriptor)


def _exit_with_parent(stream: BinaryIO) -> None:
    """Start a thread that ends this process when its standard input closes, as the parent has then ended."""

    def watch_stdin() -> None:
        while stream.read(1):
            pass
        os._exit(1)

    threading.Thread(target=watch_stdin, daemon=True).start()


if __name__ == "__main__":
    status = main()
    with suppress(OSError):  # The disk with the log may be full.
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)  # Skip Blender's teardown, which can crash after the task is done.
