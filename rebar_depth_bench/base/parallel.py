"""Progress callbacks, and a map over threads in order, with bounded memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

from rebar_depth_bench.base.errors import InputError

_Item = TypeVar("_Item")
_Done = TypeVar("_Done")
Progress = Callable[[str, int, int], None]
"""Callback with the arguments: name of the task, number of steps done, total number of steps."""


def silent(task: str, done: int, total: int) -> None:
    """Ignore progress; the default callback."""


def map_in_threads(
    work: Callable[[_Item], _Done],
    items: Iterable[_Item],
    total: int,
    task: str,
    *,
    workers: int | None = None,
    progress: Progress = silent,
) -> Iterator[_Done]:
    """Yield ``work(item)`` of each of ``total`` items, in order, on ``workers`` threads; None means one per core.

    Each result is a step of ``task`` in ``progress``. At most two items per thread are taken ahead of the next
    result, so that few items are in memory at a time. Exceptions of ``work`` propagate. Raises ``InputError`` if
    ``workers`` is less than 1.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}, expected 1 or more")
    threads = workers or os.cpu_count() or 1
    source = iter(items)
    pending: deque[Future[_Done]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for done in range(1, total + 1):
            pending.extend(pool.submit(work, item) for item in islice(source, 2 * threads - len(pending)))
            yield pending.popleft().result()
            progress(task, done, total)
    finally:
        pool.shutdown(cancel_futures=True)
