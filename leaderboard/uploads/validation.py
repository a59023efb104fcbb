"""Archive validation before acceptance, in separate processes so that a crash does not affect the server."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Self

from leaderboard.scoring.process_limits import limit_process
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import Problem
from rebar_depth_bench.submission import SubmissionMeta, open_submission
from rebar_depth_bench.view_ids import TEST_SPLIT

POOL_PROCESSES = 2
CRASHED = Problem("damaged", "", "the archive cannot be read: the process that reads it crashed")
NO_MEMORY = Problem("size", "", "the archive cannot be read: this needs more memory than this service allows")

Verdict = SubmissionMeta | tuple[Problem, ...]
"""The content of ``submission.json`` if the archive is valid, otherwise all problems."""


class ArchiveChecker:
    """Pool of ``POOL_PROCESSES`` validation processes, each limited to ``memory`` bytes.

    ``data`` is the dataset folder or Hub repository id.
    """

    def __init__(self, data: str, memory: int) -> None:
        self._data, self._memory = data, memory
        self._pool = self._new_pool(POOL_PROCESSES)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    async def check(self, archive: Path) -> Verdict:
        """Validate an archive; return its metadata or all problems."""
        pool = self._pool
        try:
            return await asyncio.wrap_future(pool.submit(_check_archive, str(archive), self._data))
        except BrokenProcessPool:
            if self._pool is pool:
                self._pool = self._new_pool(POOL_PROCESSES)
            return await self._check_alone(archive)

    async def _check_alone(self, archive: Path) -> Verdict:
        """Validate an archive in a separate pool, because a broken pool does not reveal which archive broke it."""
        with self._new_pool(1) as pool:
            try:
                return await asyncio.wrap_future(pool.submit(_check_archive, str(archive), self._data))
            except BrokenProcessPool:
                return (CRASHED,)

    def _new_pool(self, processes: int) -> ProcessPoolExecutor:
        spawn = multiprocessing.get_context("spawn")  # A fork would inherit locks held by the server's threads.
        return ProcessPoolExecutor(processes, spawn, limit_process, (self._memory, os.getpid()))


def _check_archive(archive: str, data: str) -> Verdict:
    try:
        with open_submission(archive, open_folder(data).expected_views(TEST_SPLIT)) as submission:
            problems = tuple(submission.problems())
            if submission.meta is None or problems:
                return problems
            return submission.meta
    except MemoryError:
        return (NO_MEMORY,)
