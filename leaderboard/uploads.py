"""Uploads: the form of an upload, and the way of an archive from its first byte to its place in the queue."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import AsyncIterator
from pathlib import Path

import structlog
from anyio import to_thread
from multipart import MultipartError, MultipartSegment, PushMultipartParser, parse_options_header
from sqlalchemy import exists, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from leaderboard.db.engine import DATABASE_UNAVAILABLE
from leaderboard.db.models import ResultModel, SubmissionModel, TokenModel
from leaderboard.db.submissions import (
    QUEUED,
    SCORED,
    SCORING,
    Quota,
    QuotaExceededError,
    check_quota,
    find,
    new_id,
)
from leaderboard.names import name_problem, normalised
from leaderboard.refusals import RefusedError, too_large
from leaderboard.scoring.isolation import (
    ProcessEndedError,
    TimeLimitError,
    UnavailableError,
    archive_error,
    isolated_call,
)
from leaderboard.scoring.sandbox import check
from leaderboard.service import Service
from leaderboard.storage.archive_store import upload_file
from rebar_depth_bench.base.errors import RebarDepthError, SubmissionError
from rebar_depth_bench.scoring.formatting import counted
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.submission import SubmissionMeta
from rebar_depth_bench.submission.declaration import MethodDetails

UNAVAILABLE_MESSAGE = "the service cannot check or store archives at the moment; try again later"
"""Detail of the 503 response if the dataset or the archive folder is unusable, or the disk full."""
WRITE_CHUNK_BYTES = 1 << 20
"""Number of buffered bytes that triggers a write, which runs in a worker thread."""
ARCHIVE_FIELD, TOKEN_FIELD = "archive", "token"
MAX_FIELD_BYTES = 1 << 10
"""Maximum size in bytes of a text field."""
MAX_OVERHEAD_BYTES = 64 << 10
"""Maximum size in bytes of everything in the body except the content of the archive."""
_LOG = structlog.get_logger("uploads")


async def accept_upload(
    service: Service, token: TokenModel, archive: AsyncIterator[bytes]
) -> tuple[SubmissionModel, bool]:
    """Accept an archive; return its submission, and whether that is new; both are on disk on return.

    It is not new if the token has sent the same archive before, unless that submission is outdated and its archive
    is gone. Uploads with one token are received one after the other, so that they do not fill the disk. The quota
    is checked before the archive is read, and only accepted archives count. Raises ``RefusedError``: 413 if the
    archive is too large, 422 with all problems if it is invalid, 429 if the quota is used up, and 503 if the
    service cannot check or store it.
    """
    settings, database = service.settings, service.database
    quota = Quota(settings.quota, settings.quota_bytes)

    def check_before() -> None:
        service.archives.check()
        if database.board().dataset_digest != service.folder.digest:
            raise UnavailableError("another server of this database serves another dataset")
        with database.read() as session:
            check_quota(session, token, quota, 0)

    try:
        async with service.upload_locks[token.id]:
            await to_thread.run_sync(check_before)
            with upload_file(service.spool) as file:
                sha256, size, waiting = hashlib.sha256(), 0, bytearray()

                def flush() -> None:
                    sha256.update(waiting)
                    file.write(waiting)
                    file.flush()
                    waiting.clear()

                async for part in archive:
                    waiting += part
                    size += len(part)
                    if size > settings.max_upload:
                        raise too_large(settings.max_upload)
                    if len(waiting) >= WRITE_CHUNK_BYTES:
                        await to_thread.run_sync(flush)
                await to_thread.run_sync(flush)
                received = (Path(file.name), sha256.hexdigest(), size)
                return await to_thread.run_sync(
                    _check_and_store, service, token, quota, *received, limiter=service.check_limiter
                )
    except QuotaExceededError as error:
        message = f"the quota of {error} is used up; rejected archives do not count"
        raise RefusedError(429, f"{message}, and GET /api/v1/submissions lists the accepted ones") from None
    except SubmissionError as error:
        _LOG.info("upload rejected", token=token.name, problems=len(error.problems))
        detail = f"the archive is invalid: {counted(len(error.problems), 'problem')}"
        raise RefusedError(422, detail, error.problems) from None
    except (OSError, RebarDepthError, UnavailableError) as error:
        _LOG.error("upload failed: service unavailable", error=str(error))
        raise RefusedError(503, UNAVAILABLE_MESSAGE) from None


def _check_and_store(
    service: Service, token: TokenModel, quota: Quota, path: Path, sha256: str, size: int
) -> tuple[SubmissionModel, bool]:
    """Check a received archive, build its row, store the archive, and commit the row.

    A process that is killed before the archive is stored leaves the file of an upload, which the next start
    deletes; one that is killed before the commit, an archive without a row, which ``check`` lists.
    """
    settings, database, archives = service.settings, service.database, service.archives
    with database.read() as session:
        if duplicate := _find_duplicate(session, service, token, sha256):
            return duplicate, False
    meta = _checked_archive(service, path)
    method = normalised(meta.method)
    if problem := name_problem(method):
        raise archive_error("invalid", problem, "submission.json: method", "visible characters")
    details = meta.model_dump(include=set(MethodDetails.model_fields), exclude_none=True)
    if (seconds := meta.seconds_per_view) is not None:
        details["seconds_per_view"] = seconds
    now = time.time()
    record = SubmissionModel(
        id=new_id(),
        token_id=token.id,
        method=method,
        inputs=meta.inputs,
        uses_ground_truth=meta.uses_ground_truth,
        details=json.dumps(details),
        archive_sha256=sha256,
        archive_bytes=size,
        public=settings.default_visibility == "always",
        created_at=now,
        queued_at=now,
        status=QUEUED,
        attempts=0,
    )
    submission_id = record.id
    archives.put(submission_id, path)
    try:
        with database.write() as session:
            # The token's row is locked, so that concurrent uploads are neither duplicates nor exceed the quota.
            session.execute(select(TokenModel).where(TokenModel.id == token.id).with_for_update())
            duplicate = _find_duplicate(session, service, token, sha256)
            if duplicate is None:
                check_quota(session, token, quota, size)
                session.add(record)
    except QuotaExceededError:
        archives.delete(submission_id)
        raise
    except SQLAlchemyError as error:
        # A server whose connection was lost may yet make the commit: then the archive stays.
        may_be_stored = database.has_row_locks and isinstance(error, DATABASE_UNAVAILABLE)
        if not may_be_stored and find(database, submission_id) is None:
            archives.delete(submission_id)
        raise
    if duplicate is not None:  # Sent twice at the same time.
        archives.delete(submission_id)
        return duplicate, False
    _LOG.info("upload accepted", token=token.name, submission=submission_id[:6], bytes=size)
    return record, True


def _checked_archive(service: Service, path: Path) -> SubmissionMeta:
    """Return the content of ``submission.json``; the archive is read in a process of its own.

    Raises ``SubmissionError`` with the problems of the archive, and ``UnavailableError``.
    """
    settings = service.settings
    for _ in range(2):  # A process that was killed from outside says nothing about the archive.
        try:
            job = (check, path, settings.data, service.folder.digest)
            with isolated_call(*job, memory=settings.score_memory, time_limit_s=settings.score_time) as call:
                while not call.wait(settings.score_time):
                    pass
                return call.value()
        except TimeLimitError:
            raise archive_error("size", f"the check took longer than {settings.score_time:g} s") from None
        except ProcessEndedError as error:
            _LOG.error("checking process ended", status=error.status, details=error.details)
            if not error.was_killed:
                break
    else:
        raise UnavailableError("the process that checks the archive was killed twice")
    raise archive_error("damaged", "the archive cannot be read: the process that reads it crashed")


def _find_duplicate(session: Session, service: Service, token: TokenModel, sha256: str) -> SubmissionModel | None:
    """Return the submission that a token has made of an archive, or None.

    Failed ones may be sent again, and those without archive that have no result of the served dataset.
    """
    is_current = exists().where(
        ResultModel.submission_id == SubmissionModel.id,
        ResultModel.dataset_digest == service.folder.digest,
        ResultModel.protocol == PROTOCOL,
        ResultModel.json.is_not(None),
    )
    same = select(SubmissionModel, is_current).where(
        SubmissionModel.token_id == token.id,
        SubmissionModel.archive_sha256 == sha256,
        SubmissionModel.status.in_((QUEUED, SCORING, SCORED)),
    )
    for record, has_current_result in session.execute(same):
        has_archive = record.archive_deleted_at is None and service.archives.file(record.id).is_file()
        if has_current_result or has_archive:
            return record
    return None


class UploadForm:
    """Reader of a form whose field ``archive`` is consumed as a stream.

    Raises ``RefusedError`` (422) for a body that is not valid multipart, lacks the field, has it twice or
    has too much else.
    """

    def __init__(self, body: AsyncIterator[bytes], content_type: str) -> None:
        self._body, self._overhead = body, 0
        self._events = self._parse(_boundary_of(content_type))
        self._archives = 0

    async def token(self) -> str:
        """Return the text of the field ``token`` if it comes before the archive, otherwise ""."""
        text = bytearray()
        async for name, content in self._events:
            if name == ARCHIVE_FIELD:
                break
            text += content if name == TOKEN_FIELD else b""
        return text.decode(errors="replace") if len(text) <= MAX_FIELD_BYTES else ""

    async def archive(self) -> AsyncIterator[bytes]:
        """Yield the content of the field ``archive``."""
        async for name, content in self._events:
            if name == ARCHIVE_FIELD and content:
                yield content
        if not self._archives:
            raise RefusedError(422, f"the body has no field {ARCHIVE_FIELD!r}, expected a zip file in it")

    async def _parse(self, boundary: str) -> AsyncIterator[tuple[str, bytes]]:
        """Yield the name of a field and its content in parts, of which the first is empty."""
        name = ""
        try:
            with PushMultipartParser(boundary) as parser:
                async for chunk in self._body:
                    self._overhead += len(chunk)
                    for event in parser.parse(chunk):
                        if isinstance(event, MultipartSegment):
                            name = event.name or ""
                            self._archives += name == ARCHIVE_FIELD
                            yield name, b""
                        elif event:
                            self._overhead -= len(event) if name == ARCHIVE_FIELD else 0
                            yield name, bytes(event)
                    self._check()
        except MultipartError as error:
            raise RefusedError(422, f"the body is not valid multipart/form-data: {error}") from None

    def _check(self) -> None:
        if self._archives > 1:
            raise RefusedError(422, f"the body has the field {ARCHIVE_FIELD!r} twice, expected once")
        if self._overhead > MAX_OVERHEAD_BYTES:  # Including preamble and epilogue.
            raise RefusedError(
                422, f"the body has more than {MAX_OVERHEAD_BYTES} bytes outside the field {ARCHIVE_FIELD!r}"
            )


def _boundary_of(content_type: str) -> str:
    kind, options = parse_options_header(content_type)
    boundary = options.get("boundary")
    if kind != "multipart/form-data" or not boundary:
        raise RefusedError(
            422, f"the content type is {content_type!r}, expected multipart/form-data with a boundary"
        )
    return str(boundary)
