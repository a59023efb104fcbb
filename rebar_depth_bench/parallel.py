"""Progress callbacks, and an ordered parallel map over threads with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from rebar_depth_bench.errors import InputError

Progress = Callable[[str, int, int], None]
"""Callback with the arguments: name of the task, number of steps done, total number of steps."""


def silent(task: str, done: int, total: int) -> None:
    """Ignore progress; the default callback."""


_Item = TypeVar("_Item")
_Done = TypeVar("_Done")


def ordered_map(work: Callable[[_Item], _Done], items: Iterable[_Item], workers: int | None) -> Iterator[_Done]:
    """Yield ``work(item)`` in the order of ``items``, computed on ``workers`` threads (None: one per core).

    At most two items per thread are taken ahead of the result being yielded, so memory use does not grow with the
    number of items. Exceptions of ``items`` and ``work`` propagate. Raises ``InputError`` if ``workers`` is less
    than 1.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}, expected 1 or more")
    threads = workers or os.cpu_count() or 1
    pending: deque[Future[_Done]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            pending.append(pool.submit(work, item))
            if len(pending) >= 2 * threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)


def map_with_progress(
    work: Callable[[_Item], _Done],
    items: Iterable[_Item],
    workers: int | None,
    progress: Progress,
    task: str,
    total: int,
) -> list[_Done]:
    """Return the results of ``ordered_map``, and report each of the ``total`` items as a step of ``task``."""
    results = []
    for done, result in enumerate(ordered_map(work, items, workers), start=1):
        results.append(result)
        progress(task, done, total)
    return results
