"""Upload pipeline: receive, check, store and enqueue an archive; it is accepted only after the last step."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path

import structlog
from anyio import fail_after, to_thread

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import DuplicateError, Quota, QuotaExceededError, Upload
from leaderboard.names import name_problem, normalised
from leaderboard.scoring.run_sandbox import UnavailableError, Verdict, check_archive
from leaderboard.service import Service
from leaderboard.settings import Settings
from leaderboard.uploads.errors import UploadRejectedError, too_large
from rebar_depth_bench.errors import Problem, RebarDepthError
from rebar_depth_bench.reporting.formatting import counted

UNAVAILABLE_MESSAGE = "the service cannot check or store archives at the moment; try again later"
"""Detail of the 503 response if the dataset is unreadable or the disk full."""
WRITE_CHUNK_BYTES = 1 << 20
"""Number of buffered bytes that triggers a write, which runs in a worker thread."""
_LOG = structlog.get_logger("uploads")


@dataclass(frozen=True)
class AcceptedUpload:
    """Submission of an upload; it is not new if the token has sent the same archive before."""

    record: SubmissionModel
    is_new: bool


@dataclass(frozen=True)
class _ReceivedArchive:
    """A received archive: its file, its SHA-256 in hexadecimal and its size in bytes."""

    path: Path
    sha256: str
    size: int


async def accept_upload(service: Service, token: TokenModel, archive: AsyncIterator[bytes]) -> AcceptedUpload:
    """Accept an archive; archive and database row are on disk on return.

    Uploads with one token are received one after the other, so that they do not fill the disk. The quota is
    checked before the archive is read, and only accepted archives count. Raises ``UploadRejectedError``.
    """
    settings = service.settings
    async with service.upload_locks[token.id]:
        await to_thread.run_sync(_check_quota, service, token)
        try:
            with fail_after(settings.upload_seconds):
                received = await _receive(
                    _with_idle_timeout(archive, settings), service.spool, settings.max_upload
                )
            try:
                return await _check_and_store(service, token, received)
            finally:
                await to_thread.run_sync(received.path.unlink, True)
        except TimeoutError:
            message = f"the upload was ended, because it took longer than {settings.upload_seconds:g} seconds"
            raise UploadRejectedError(408, message) from None
        except DuplicateError as error:
            _LOG.info("upload of a known archive", token=token.name, submission=error.record.id[:6])
            return AcceptedUpload(error.record, is_new=False)
        except QuotaExceededError as error:
            raise _quota_exceeded(error) from None
        except (OSError, RebarDepthError, UnavailableError) as error:
            _LOG.error("upload failed: service unavailable", error=str(error))
            raise UploadRejectedError(503, UNAVAILABLE_MESSAGE) from None


async def _with_idle_timeout(body: AsyncIterator[bytes], settings: Settings) -> AsyncIterator[bytes]:
    """Yield the parts of ``body``. Raises ``UploadRejectedError`` (408) if none arrives for too long."""
    seconds = settings.upload_idle_seconds
    while True:
        try:
            with fail_after(seconds):
                part = await anext(body, None)
        except TimeoutError:
            message = f"the upload was ended, because nothing was received for {seconds:g} seconds"
            raise UploadRejectedError(408, message) from None
        if part is None:
            return
        yield part


async def _receive(archive: AsyncIterator[bytes], spool: Path, max_bytes: int) -> _ReceivedArchive:
    """Write an archive to a new file in ``spool``.

    Raises ``UploadRejectedError`` (413), and leaves no file, if it has more than ``max_bytes`` bytes.
    """
    descriptor, name = tempfile.mkstemp(dir=spool, suffix=".upload")
    path, sha256, size, waiting = Path(name), hashlib.sha256(), 0, bytearray()
    try:
        with os.fdopen(descriptor, "wb") as file:

            def flush() -> None:
                sha256.update(waiting)
                file.write(waiting)
                waiting.clear()

            async for part in archive:
                waiting += part
                size += len(part)
                if size > max_bytes:
                    raise too_large(max_bytes)
                if len(waiting) >= WRITE_CHUNK_BYTES:
                    await to_thread.run_sync(flush)
            await to_thread.run_sync(flush)
        return _ReceivedArchive(path, sha256.hexdigest(), size)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


async def _check_and_store(service: Service, token: TokenModel, received: _ReceivedArchive) -> AcceptedUpload:
    settings = service.settings
    await to_thread.run_sync(_raise_if_duplicate, service, token, received.sha256)
    verdict = _with_name_problems(
        await to_thread.run_sync(
            check_archive, received.path, settings, service.spool, limiter=service.check_limiter
        )
    )
    if isinstance(verdict, tuple):
        _LOG.info("upload rejected", token=token.name, problems=len(verdict))
        raise UploadRejectedError(422, f"the archive is invalid: {counted(len(verdict), 'problem')}", verdict)
    submission_id = submissions.new_id()
    upload = Upload(verdict, received.sha256, received.size, service.folder.digest)
    public = settings.default_visibility == "always"

    def store() -> SubmissionModel:
        service.archives.put(submission_id, received.path)
        try:
            return submissions.accept(service.database, submission_id, token, upload, quota_of(settings), public)
        except (QuotaExceededError, DuplicateError):  # After other errors the row may exist and needs its archive.
            service.archives.delete(submission_id)
            raise

    record = await to_thread.run_sync(store)
    _LOG.info("upload accepted", token=token.name, submission=submission_id[:6], bytes=received.size)
    return AcceptedUpload(record, is_new=True)


def _with_name_problems(verdict: Verdict) -> Verdict:
    """Return the verdict with the method's name normalised, or with the problem of this name."""
    if isinstance(verdict, tuple):
        return verdict
    method = normalised(verdict.method)
    if problem := name_problem(method):
        return (Problem("invalid", "submission.json: method", problem, "visible characters"),)
    return verdict.model_copy(update={"method": method})


def _raise_if_duplicate(service: Service, token: TokenModel, sha256: str) -> None:
    with service.database.read() as session:
        if duplicate := submissions.find_duplicate(session, token, sha256):
            raise DuplicateError(duplicate)


def quota_of(settings: Settings) -> Quota:
    """Return the daily quota of every token."""
    return Quota(settings.quota, settings.quota_bytes)


def _check_quota(service: Service, token: TokenModel) -> None:
    try:
        with service.database.read() as session:
            submissions.check_quota(session, token, quota_of(service.settings), 0)
    except QuotaExceededError as error:
        raise _quota_exceeded(error) from None


def _quota_exceeded(error: QuotaExceededError) -> UploadRejectedError:
    return UploadRejectedError(429, f"the quota of {error} is used up; rejected archives do not count")
