"""Time limit on a call that may never return: an inference, or a request to a server."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from threading import Thread
from typing import TypeVar

_Result = TypeVar("_Result")
_GRACE_S = 2.0
"""Time that a cancelled call has to end, seconds."""


class DeadlineError(Exception):
    """Call that did not return in time."""


def call_within(
    seconds: float, function: Callable[[], _Result], cancel: Callable[[], object] = lambda: None
) -> _Result:
    """Return ``function()``. Raises ``DeadlineError`` if it takes longer than ``seconds``."""
    end = time.monotonic() + seconds
    return call_until(lambda: end, function, cancel)


def call_until(
    end: Callable[[], float], function: Callable[[], _Result], cancel: Callable[[], object] = lambda: None
) -> _Result:
    """Return ``function()``. Raises ``DeadlineError`` once ``time.monotonic()`` has reached ``end()``.

    The function runs in another thread. ``cancel`` is called to stop it at the deadline or on Ctrl-C. A function
    that does not end soon after is abandoned: its thread does not keep the process alive.
    """
    future: Future[_Result] = Future()
    Thread(target=_run, args=(future, function), daemon=True).start()
    try:
        while not future.done() and (remaining_s := end() - time.monotonic()) > 0:
            wait([future], remaining_s)
        if not future.done():
            raise DeadlineError
    except BaseException:  # Ctrl-C, too.
        cancel()
        # A thread that returns from native code while Python exits would abort the process.
        wait([future], _GRACE_S)
        raise
    return future.result()


def _run(future: Future[_Result], function: Callable[[], _Result]) -> None:
    try:
        future.set_result(function())
    except BaseException as error:
        future.set_exception(error)
