"""Work on many views by a few threads, with only a few views in memory."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from rebar_depth_bench.errors import InputError

_Item = TypeVar("_Item")
_Done = TypeVar("_Done")


def ordered_map(work: Callable[[_Item], _Done], items: Iterable[_Item], workers: int | None) -> Iterator[_Done]:
    """Yield ``work(item)`` in the order of ``items``, on ``workers`` threads (None: one a core).

    No more than two items a thread are taken ahead of what was yielded, so that memory stays flat however many
    there are. What ``items`` or ``work`` raises is raised here. Raises ``InputError`` for fewer than one thread.
    """
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}, expected 1 or more")
    threads = workers or os.cpu_count() or 1
    waiting: deque[Future[_Done]] = deque()
    pool = ThreadPoolExecutor(threads)
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) >= 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        pool.shutdown(cancel_futures=True)
