"""Upload pipeline: receive, validate, store and enqueue an archive; it is accepted only after the last step."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping

import structlog
from anyio import fail_after, to_thread

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionModel, TokenModel
from leaderboard.db.submissions import QuotaExceededError, Upload
from leaderboard.service import Service
from leaderboard.uploads.multipart import (
    MAX_OVERHEAD_BYTES,
    ReceivedArchive,
    UploadRejectedError,
    receive,
    too_large_message,
)
from rebar_depth_bench.errors import RebarDepthError
from rebar_depth_bench.reporting.formatting import counted

UNAVAILABLE_MESSAGE = "the service cannot validate or store archives at the moment; try again later"
"""Detail of the 503 response if the dataset is unreadable, the disk full or the archive storage unavailable."""
_LOG = structlog.get_logger("uploads")


async def accept_upload(
    service: Service, token: TokenModel, body: AsyncIterator[bytes], headers: Mapping[str, str]
) -> SubmissionModel:
    """Accept an upload and return its database row; archive and row are on disk on return.

    Uploads with one token are received one after the other, so that they do not fill the disk. The quota is
    checked before the archive is read, and only accepted archives count. Raises ``UploadRejectedError``.
    """
    async with service.upload_locks[token.id]:
        return await _accept(service, token, body, headers)


async def _accept(
    service: Service, token: TokenModel, body: AsyncIterator[bytes], headers: Mapping[str, str]
) -> SubmissionModel:
    settings = service.settings
    if await to_thread.run_sync(quota_used, service, token) >= settings.quota:
        raise _quota_exceeded(settings.quota)
    if int(headers.get("content-length", 0)) > settings.max_upload + MAX_OVERHEAD_BYTES:
        raise UploadRejectedError(413, too_large_message(settings.max_upload))
    try:
        body = _with_idle_timeout(body, settings.upload_idle_seconds)
        received = await receive(body, headers.get("content-type", ""), service.spool, settings.max_upload)
        try:
            return await _validate_and_store(service, token, received)
        finally:
            await to_thread.run_sync(received.path.unlink, True)
    except (OSError, RebarDepthError) as error:
        _LOG.error("upload failed: service unavailable", error=str(error))
        raise UploadRejectedError(503, UNAVAILABLE_MESSAGE) from None


async def _with_idle_timeout(body: AsyncIterator[bytes], seconds: float) -> AsyncIterator[bytes]:
    """Yield the parts of ``body``. Raises ``UploadRejectedError`` (408) if none arrives for ``seconds``."""
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


async def _validate_and_store(service: Service, token: TokenModel, received: ReceivedArchive) -> SubmissionModel:
    verdict = await service.checker.check(received.path)
    if isinstance(verdict, tuple):
        _LOG.info("upload rejected", token=token.name, problems=len(verdict))
        raise UploadRejectedError(422, f"the archive is invalid: {counted(len(verdict), 'problem')}", verdict)
    submission_id = submissions.new_id()
    upload = Upload(verdict, received.sha256, received.size, service.folder.digest)
    public = service.settings.default_visibility == "always"

    def store() -> SubmissionModel:
        service.archives.put(submission_id, received.path)
        try:
            return submissions.accept(
                service.database, submission_id, token, upload, service.settings.quota, public
            )
        except QuotaExceededError:  # After any other error the row may exist, so its archive must be kept.
            service.archives.delete(submission_id)
            raise

    try:
        record = await to_thread.run_sync(store)
    except QuotaExceededError:
        raise _quota_exceeded(service.settings.quota) from None
    _LOG.info("upload accepted", token=token.name, submission=submission_id[:6], bytes=received.size)
    return record


def quota_used(service: Service, token: TokenModel) -> int:
    """Return the number of submissions that the token has made today (UTC)."""
    with service.database.read() as session:
        return submissions.count_submissions_today(session, token.id)


def _quota_exceeded(quota: int) -> UploadRejectedError:
    return UploadRejectedError(
        429, f"the quota of {quota} submissions per day (UTC) is used up; rejected archives do not count"
    )
