"""Upload pipeline: receive, check, store and enqueue an archive; it is accepted only after the last step."""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import IO

import structlog
from anyio import fail_after, move_on_after, to_thread

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import Quota, QuotaExceededError, Upload
from leaderboard.names import name_problem, normalised
from leaderboard.refusals import RefusedError, too_large
from leaderboard.scoring.isolation import (
    ProcessEndedError,
    TimeLimitError,
    UnavailableError,
    archive_error,
    call_isolated,
)
from leaderboard.scoring.sandbox import check
from leaderboard.service import Service
from leaderboard.settings import Settings
from leaderboard.storage.archive_store import upload_file
from rebar_depth_bench.base.errors import RebarDepthError, SubmissionError
from rebar_depth_bench.reporting.formatting import counted
from rebar_depth_bench.submission import SubmissionMeta

UNAVAILABLE_MESSAGE = "the service cannot check or store archives at the moment; try again later"
"""Detail of the 503 response if the dataset is unreadable or the disk full."""
WRITE_CHUNK_BYTES = 1 << 20
"""Number of buffered bytes that triggers a write, which runs in a worker thread."""
_LOG = structlog.get_logger("uploads")


async def accept_upload(
    service: Service, token: TokenModel, archive: AsyncIterator[bytes]
) -> tuple[SubmissionModel, bool]:
    """Accept an archive; return its submission, and whether that is new; both are on disk on return.

    It is not new if the token has sent the same archive before. Uploads with one token are received one after the
    other, so that they do not fill the disk. The quota is checked before the archive is read, and only accepted
    archives count. Raises ``RefusedError``.
    """
    async with service.upload_locks[token.id]:
        try:
            await to_thread.run_sync(_check_quota, service, token)
            with upload_file(service.spool) as file:
                sha256, size = await _receive(archive, file, service.settings)
                received = Path(file.name), sha256, size
                return await to_thread.run_sync(
                    _check_and_store, service, token, *received, limiter=service.check_limiter
                )
        except QuotaExceededError as error:
            message = f"the quota of {error} is used up; rejected archives do not count"
            raise RefusedError(429, message) from None
        except (OSError, RebarDepthError, UnavailableError) as error:
            _LOG.error("upload failed: service unavailable", error=str(error))
            raise RefusedError(503, UNAVAILABLE_MESSAGE) from None


async def _receive(archive: AsyncIterator[bytes], file: IO[bytes], settings: Settings) -> tuple[str, int]:
    """Write an archive to ``file``; return its SHA-256 in hexadecimal and its size in bytes.

    Raises ``RefusedError``: 413 if it is too large, 408 if it takes too long.
    """
    sha256, size, waiting = hashlib.sha256(), 0, bytearray()

    def flush() -> None:
        sha256.update(waiting)
        file.write(waiting)
        file.flush()
        waiting.clear()

    limit = f"it took longer than {settings.upload_seconds:g} seconds"
    try:
        with fail_after(settings.upload_seconds):
            while True:
                with move_on_after(settings.upload_idle_seconds) as idle:
                    part = await anext(archive, None)
                if idle.cancelled_caught:
                    limit = f"nothing was received for {settings.upload_idle_seconds:g} seconds"
                    raise TimeoutError
                if part is None:
                    break
                waiting += part
                size += len(part)
                if size > settings.max_upload:
                    raise too_large(settings.max_upload)
                if len(waiting) >= WRITE_CHUNK_BYTES:
                    await to_thread.run_sync(flush)
            await to_thread.run_sync(flush)
    except TimeoutError:
        raise RefusedError(408, f"the upload was ended, because {limit}") from None
    return sha256.hexdigest(), size


def _check_and_store(
    service: Service, token: TokenModel, path: Path, sha256: str, size: int
) -> tuple[SubmissionModel, bool]:
    settings, database = service.settings, service.database
    with database.read() as session:
        duplicate = submissions.find_duplicate(session, token, sha256)
    if duplicate is not None:
        return duplicate, False
    try:
        meta = _checked_archive(path, settings)
    except SubmissionError as error:
        _LOG.info("upload rejected", token=token.name, problems=len(error.problems))
        detail = f"the archive is invalid: {counted(len(error.problems), 'problem')}"
        raise RefusedError(422, detail, error.problems) from None
    submission_id = submissions.new_id()
    upload = Upload(meta, sha256, size, service.folder.digest)
    public = settings.default_visibility == "always"
    service.archives.put(submission_id, path)
    try:
        record = submissions.accept(database, submission_id, token, upload, _quota_of(settings), public)
    except QuotaExceededError:  # After other errors the row may exist and needs its archive.
        service.archives.delete(submission_id)
        raise
    if record.id != submission_id:  # Sent twice at the same time.
        service.archives.delete(submission_id)
        return record, False
    _LOG.info("upload accepted", token=token.name, submission=submission_id[:6], bytes=size)
    return record, True


def _checked_archive(path: Path, settings: Settings) -> SubmissionMeta:
    """Return the content of ``submission.json`` with the method's name normalised.

    Raises ``SubmissionError`` with the problems of the archive, and ``UnavailableError``.
    """
    for _ in range(2):  # A process that was killed from outside says nothing about the archive.
        try:
            meta = call_isolated(
                check, path, settings.data, memory=settings.score_memory, time_limit_s=settings.check_time
            )
        except TimeLimitError:
            raise archive_error("size", f"the check took longer than {settings.check_time:g} s") from None
        except ProcessEndedError as error:
            _LOG.error("checking process ended", status=error.status)
            if not error.was_killed:
                break
        else:
            method = normalised(meta.method)
            if problem := name_problem(method):
                raise archive_error("invalid", problem, "submission.json: method", "visible characters")
            return meta.model_copy(update={"method": method})
    raise archive_error("damaged", "the archive cannot be read: the process that reads it crashed")


def _check_quota(service: Service, token: TokenModel) -> None:
    with service.database.read() as session:
        submissions.check_quota(session, token, _quota_of(service.settings), 0)


def _quota_of(settings: Settings) -> Quota:
    return Quota(settings.quota, settings.quota_bytes)
