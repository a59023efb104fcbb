"""Function calls in a process of their own, with limits of time and memory, to read untrusted archives.

What crashes, hangs or needs too much memory there concerns a single archive. The process runs with the rights of
the service: it is no barrier against code that an archive would manage to run.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Generic, TypeVar

from rebar_depth_bench.base.errors import Problem, ProblemCode, RebarDepthError, SubmissionError
from rebar_depth_bench.base.system import limit_process

NICENESS = 10
MIN_MEMORY_BYTES = 1 << 30
"""Minimum memory limit: interpreter, libraries and thread stacks alone take several hundred megabytes."""
EXIT_S = 10.0
"""Time, seconds, in which a process ends that has closed its pipe; after it, the exit status is not known."""
_SPAWN = multiprocessing.get_context("spawn")
_CHILDREN_LOCK = threading.Lock()
"""Held while a process is started or waited for.

``multiprocessing`` polls all child processes when it starts one. If this reaps a process that another thread
waits for, that thread gets no exit status: it takes the process for running, and a sound archive for a bad one.
"""

T = TypeVar("T")


class UnavailableError(Exception):
    """Raised if the work of a function is impossible for now."""


class ProcessEndedError(Exception):
    """Raised when the process has ended without a value.

    ``status`` is its exit status, ``was_killed`` tells whether something outside has ended it, and ``details`` is
    the traceback of an unexpected error.
    """

    def __init__(self, status: int | None, details: str = "") -> None:
        self.status, self.was_killed, self.details = status, status == -signal.SIGKILL, details
        super().__init__(status, details)

    def __str__(self) -> str:
        return f"the process exited with status {self.status}"


class TimeLimitError(Exception):
    """Raised when the process has reached its time limit."""


@dataclass(frozen=True)
class IsolatedCall(Generic[T]):
    """A function that runs in a process of its own until ``deadline``, in seconds of ``time.monotonic``."""

    process: SpawnProcess
    receiver: Connection
    deadline: float

    def wait(self, seconds: float) -> bool:
        """Wait for the value for at most ``seconds`` seconds; return whether ``value`` has it.

        Raises ``TimeLimitError`` after the deadline.
        """
        if self.receiver.poll(min(seconds, max(0.0, self.deadline - time.monotonic()))):
            return True
        if time.monotonic() >= self.deadline:
            raise TimeLimitError
        return False

    def value(self) -> T:
        """Return the value of the function, for which it waits.

        Raises ``ProcessEndedError``; ``SubmissionError`` if the function does, or needs more memory; and
        ``UnavailableError`` for its other errors.
        """
        try:
            found: T | UnavailableError | SubmissionError | ProcessEndedError = self.receiver.recv()
        except EOFError:
            with _CHILDREN_LOCK:
                self.process.join(EXIT_S)
                status = self.process.exitcode
            raise ProcessEndedError(status) from None
        if isinstance(found, UnavailableError | SubmissionError | ProcessEndedError):
            raise found
        return found


@contextmanager
def isolated_call(
    function: Callable[..., T], *arguments: object, memory: int, time_limit_s: float
) -> Iterator[IsolatedCall[T]]:
    """Start ``function(*arguments)`` in a new process, and kill the process at the end of the block.

    ``memory`` is its limit in bytes. Raises ``UnavailableError`` if no process can be started.
    """
    receiver, sender = _SPAWN.Pipe(duplex=False)
    process = _SPAWN.Process(target=_run, args=(sender, memory, os.getpid(), function, arguments))
    with receiver:
        with sender:  # Closed here, so that the end of the other process is noticed.
            # A terminal or systemd signals the children too, for which the parent decides. The mask is inherited.
            former = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
            try:
                with _CHILDREN_LOCK:
                    process.start()
            except OSError as error:  # Out of memory or processes.
                raise UnavailableError(str(error)) from None
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, former)
        try:
            yield IsolatedCall(process, receiver, time.monotonic() + time_limit_s)
        finally:
            with _CHILDREN_LOCK:
                process.kill()
                process.join()
                process.close()


def _run(
    sender: Connection, memory: int, parent: int, function: Callable[..., object], arguments: tuple[Any, ...]
) -> None:
    """Send the value or the error of the function.

    The output of the process is discarded, because it could fill the log. Its priority is lowered, so that it does
    not slow down the server.
    """
    with open(os.devnull, "w") as null:  # noqa: PTH123
        for stream in (1, 2):
            os.dup2(null.fileno(), stream)
    os.nice(NICENESS)
    limit_process(parent, max(memory, MIN_MEMORY_BYTES))
    value: object
    try:
        value = function(*arguments)
    except SubmissionError as error:
        value = error
    except MemoryError:
        value = archive_error("size", "the archive needs more memory than this service allows")
    except (RebarDepthError, OSError) as error:  # Dataset, cache or disk, not the archive.
        value = UnavailableError(str(error))
    except Exception:
        value = ProcessEndedError(1, traceback.format_exc())
    sender.send(value)


def archive_error(code: ProblemCode, found: str, location: str = "", expected: str = "") -> SubmissionError:
    """Return the error of an archive with one problem."""
    return SubmissionError.from_problems("the archive", [Problem(code, location, found, expected)])
