"""An upload's way in: received, checked, kept, queued. Only then is it accepted."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping

import structlog
from anyio import to_thread

from leaderboard.db import submissions
from leaderboard.db.models import SubmissionRecord, TokenRecord
from leaderboard.db.submissions import QuotaSpentError, Upload
from leaderboard.uploads.multipart import MOST_ELSE, Received, UploadError, receive, too_large
from leaderboard.web.context import Service
from rebar_depth_bench.errors import MAX_PROBLEMS_SHOWN, RebarDepthError

AWAY = "the service cannot check or keep archives now; try again later"
"""The dataset cannot be read, the disk is full, or the place of archives does not answer."""
_LOG = structlog.get_logger("intake")


class RefusedError(Exception):
    """An upload is refused: the HTTP status, the sentence that says why, for an archive (422) every problem."""

    def __init__(self, status: int, detail: str, problems: tuple[str, ...] = ()) -> None:
        self.status, self.detail = status, detail
        self.problems = (problems or (detail,)) if status == 422 else None
        super().__init__(detail)


async def take_in(
    service: Service, token: TokenRecord, body: AsyncIterator[bytes], headers: Mapping[str, str]
) -> SubmissionRecord:
    """Return the record of an accepted upload: archive and row are on disk by then. Raises ``RefusedError``.

    A token without quota is told before its archive is read; only an accepted archive is charged.
    """
    settings = service.settings
    if await to_thread.run_sync(_spent, service, token) >= settings.quota:
        raise _quota_spent(settings.quota)
    if int(headers.get("content-length", 0)) > settings.max_upload + MOST_ELSE:
        raise RefusedError(413, too_large(settings.max_upload))
    try:
        received = await receive(body, headers.get("content-type", ""), service.spool, settings.max_upload)
        try:
            return await _accepted(service, token, received)
        finally:
            await to_thread.run_sync(received.path.unlink, True)
    except UploadError as error:
        raise RefusedError(error.status, error.detail) from None
    except (OSError, RebarDepthError) as error:
        _LOG.error("cannot take uploads", error=str(error))
        raise RefusedError(503, AWAY) from None


async def _accepted(service: Service, token: TokenRecord, received: Received) -> SubmissionRecord:
    verdict = await service.checker.check(received.path)
    if isinstance(verdict, tuple):
        _LOG.info("refused", token=token.name, problems=len(verdict))
        raise RefusedError(422, _headline(verdict), shown(verdict))
    submission_id = submissions.new_id()
    upload = Upload(verdict, received.sha256, received.size, service.folder.digest)
    public = service.settings.public == "always"

    def keep() -> SubmissionRecord:
        service.archives.put(submission_id, received.path)
        try:
            return submissions.accept(
                service.database, submission_id, token, upload, service.settings.quota, public
            )
        except QuotaSpentError:  # whatever else goes wrong, the row may be there, and its archive must be
            service.archives.delete(submission_id)
            raise

    try:
        record = await to_thread.run_sync(keep)
    except QuotaSpentError:
        raise _quota_spent(service.settings.quota) from None
    _LOG.info("accepted", token=token.name, submission=submission_id[:6], bytes=received.size)
    return record


def shown(problems: tuple[str, ...]) -> tuple[str, ...]:
    """Return the problems that are told, and how many more there are."""
    left_over = len(problems) - MAX_PROBLEMS_SHOWN
    more = (f"... and {left_over} more",) if left_over > 0 else ()
    return problems[:MAX_PROBLEMS_SHOWN] + more


def _headline(problems: tuple[str, ...]) -> str:
    return f"the archive is refused: {len(problems)} problem{'' if len(problems) == 1 else 's'}"


def _spent(service: Service, token: TokenRecord) -> int:
    with service.database.read() as session:
        return submissions.spent_today(session, token.id)


def _quota_spent(quota: int) -> RefusedError:
    return RefusedError(
        429, f"this token has made its {quota} submissions of today (UTC); refused archives were not counted"
    )
