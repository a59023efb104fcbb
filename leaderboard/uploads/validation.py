"""Archives checked before they are accepted, in processes of their own: one that crashes takes nothing with it."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import TracebackType
from typing import Self

from leaderboard.scoring.process_limits import confine
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import SubmissionError
from rebar_depth_bench.submission import SubmissionMeta, open_submission

PROCESSES = 2
CRASHED = "the archive cannot be read: reading it ends the reader, which a sound archive does not do"
NO_MEMORY = "the archive cannot be read in the memory that this service allows"

Verdict = SubmissionMeta | tuple[str, ...]
"""What ``submission.json`` says, or every problem."""


class Checker:
    """A pool of checking processes; ``memory`` bytes for each. Checks at most ``PROCESSES`` archives at once."""

    def __init__(self, data: str, memory: int) -> None:
        self._data, self._memory = data, memory
        self._pool = self._new_pool()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    async def check(self, archive: Path) -> Verdict:
        """Return what the archive says of itself, or all that is wrong with it."""
        pool = self._pool
        try:
            return await asyncio.wrap_future(pool.submit(_check, str(archive), self._data))
        except BrokenProcessPool:
            if self._pool is pool:
                self._pool = self._new_pool()
            return await self._check_alone(archive)

    async def _check_alone(self, archive: Path) -> Verdict:
        """Check in a pool of its own: a pool that broke does not tell which of its archives broke it."""
        with ProcessPoolExecutor(1, _context(), confine, (self._memory, os.getpid())) as alone:
            try:
                return await asyncio.wrap_future(alone.submit(_check, str(archive), self._data))
            except BrokenProcessPool:
                return (CRASHED,)

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(PROCESSES, _context(), confine, (self._memory, os.getpid()))


def _context() -> multiprocessing.context.SpawnContext:
    return multiprocessing.get_context("spawn")  # a fork would carry the server's threads' locks


def _check(archive: str, data: str) -> Verdict:
    try:
        with open_submission(archive, open_folder(data).expected_views()) as submission:
            problems = tuple(submission.problems())
            if submission.meta is None or problems:
                return problems
            return submission.meta
    except SubmissionError as error:
        return error.problems
    except MemoryError:
        return (NO_MEMORY,)
