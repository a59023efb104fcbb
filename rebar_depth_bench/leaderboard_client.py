"""HTTP client of a leaderboard: upload an archive, wait until it is scored, fetch the result.

The token is sent to the leaderboard only: redirects are not followed. Answers are limited in size and in time.
"""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, BinaryIO, Self

from rebar_depth_bench.deadline import DeadlineError, call_until
from rebar_depth_bench.errors import InputError, escape_text
from rebar_depth_bench.leaderboard_answers import (
    SUBMISSION_ID,
    AnswerError,
    Response,
    ServiceError,
    Submission,
    TokenInfo,
    detail,
    server_text,
)
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.parallel import Progress, silent
from rebar_depth_bench.reading import open_regular

POLL_INTERVAL_S = 2.0
"""Time between two status requests, seconds."""
MAX_FAILED_POLLS = 30
"""Number of consecutive failed status requests that ``LeaderboardClient.wait`` tolerates."""
WAIT_S = 3600.0
"""Default time limit of ``LeaderboardClient.wait``, seconds."""
REQUEST_TIMEOUT_S, RESULT_TIMEOUT_S = 60.0, 600.0
"""Time limits of a request, and of the download of a result, seconds."""
_CHUNK_BYTES = 1 << 16
UPLOAD_TIMEOUT_S = 3600.0
"""Time limit from the last byte of an upload to the end of the response, seconds: the archive is checked first."""


class LeaderboardClient:
    """Client for the leaderboard at ``url`` that authenticates with ``token``; a context manager."""

    def __init__(self, url: str, token: str) -> None:
        """Open an HTTP client; raise ``InputError`` if ``httpx2`` is not installed or the token is not ASCII."""
        if not token.isascii() or not token.isprintable():
            raise InputError("the token has other characters than printable ASCII, expected it as it was issued")
        self._http = _httpx()
        self._url = url.rstrip("/")
        self._token = token
        self._client = self._new_client()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def submit(self, archive: Path, progress: Progress = silent) -> Submission:
        """Upload an archive and return the accepted submission, with the SHA-256 of what was sent.

        Raises ``SubmissionError`` with every problem of a rejected archive, ``InputError`` for an invalid token,
        an exhausted quota, an archive that is too large or a file that cannot be read, and ``ServiceError`` if
        the service cannot be reached or its answer is not valid.
        """
        max_bytes = self.token().max_upload_bytes
        try:
            with open_regular(archive) as stream:
                total = os.fstat(stream.fileno()).st_size
                if total > max_bytes:
                    raise InputError(f"{archive}: has {total} bytes, expected at most {max_bytes}")
                upload = _Upload(stream, lambda done: progress("uploading", done, total))
                headers = {"Content-Type": "application/zip", "Content-Length": str(total)}
                response = self._call("PUT", "submissions", upload.deadline, headers=headers, content=upload)
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if response.status == 422:
            raise response.rejection(archive)
        accepted = response.answer(Submission, 202, 200)
        if accepted.archive_sha256 not in (None, upload.sha256()):
            raise AnswerError(f"{self._url}: the service received another archive than was sent")
        return accepted.model_copy(update={"archive_sha256": upload.sha256()})

    def token(self) -> TokenInfo:
        """Return the token's name, its quota and the size limit of the service.

        Raises ``InputError`` for an unknown token or a wrong URL, ``ServiceError`` if the service does not answer.
        """
        return self._call("GET", "token", _deadline(REQUEST_TIMEOUT_S)).answer(TokenInfo, 200)

    def wait(self, submission_id: str, progress: Progress = silent, limit_s: float = WAIT_S) -> Submission:
        """Poll until the submission is scored or failed, and return it.

        Raises ``ServiceError`` after ``limit_s`` seconds, after more than ``MAX_FAILED_POLLS`` consecutive failed
        requests and for an answer that is not valid, such as an unknown status, and ``InputError`` if the service
        rejects the token or the id.
        """
        end = time.monotonic() + limit_s
        failed_polls, status = 0, "not scored"
        while (remaining_s := end - time.monotonic()) > 0:
            try:
                submission = self._poll(submission_id, min(remaining_s, REQUEST_TIMEOUT_S))
            except AnswerError:
                raise
            except ServiceError:
                failed_polls += 1
                if failed_polls > MAX_FAILED_POLLS:
                    raise
                progress("no response, retrying", 0, 1)
            else:
                failed_polls, status = 0, submission.status
                has_ended = status in ("scored", "failed")
                progress(status, int(has_ended), 1)
                if has_ended:
                    return submission
            time.sleep(min(POLL_INTERVAL_S, max(end - time.monotonic(), 0)))
        page = f"{self._url}/submissions/{submission_id}"
        raise ServiceError(
            f"{page}: the submission is still {status} after {limit_s:g} s of waiting; this page shows its result "
            "once it is scored"
        )

    def result(self, submission_id: str, archive_sha256: str | None = None) -> bytes:
        """Return the result JSON, byte-identical to the output of ``rebar-bench score --json``.

        A leaderboard with hidden ground truth returns only the disclosed part of it.

        Raises ``ServiceError`` if the response status is not 200 or the body is no result, or that of another
        archive than the one with ``archive_sha256``.
        """
        path = f"submissions/{_checked_id(submission_id)}/result.json"
        response = self._call("GET", path, _deadline(RESULT_TIMEOUT_S))
        if response.status != 200:
            raise ServiceError(
                f"{self._url}: the response status for the result is {response.status}, expected 200"
            )
        response.result(archive_sha256)
        return response.body

    def _poll(self, submission_id: str, limit_s: float) -> Submission:
        response = self._call("GET", f"submissions/{_checked_id(submission_id)}", _deadline(limit_s))
        if response.status == 429:
            raise ServiceError(f"{self._url}: {detail(response.content(), 'too many requests')}")
        submission = response.answer(Submission, 200)
        if submission.id != submission_id:
            raise AnswerError(
                f"{self._url}: the answer is on submission {submission.id}, expected {submission_id}"
            )
        return submission

    def _call(self, method: str, path: str, end: Callable[[], float], **content: Any) -> Response:
        """Return the response to a request, which must be complete before the time ``end()``."""
        client = self._client
        try:
            return call_until(end, lambda: self._exchange(client, method, path, content), self._abandon)
        except DeadlineError:
            raise ServiceError(f"{self._url}: no complete response within the time limit") from None
        except (self._http.InvalidURL, self._http.UnsupportedProtocol) as error:
            raise InputError(f"{self._url!r}: is not a valid URL, expected http://HOST:PORT: {error}") from None
        except self._http.HTTPError as error:
            found = server_text(str(error)) or type(error).__name__
            raise ServiceError(f"{self._url}: no response: {found}") from None

    def _exchange(self, client: Any, method: str, path: str, content: dict[str, Any]) -> Response:
        max_bytes, body = JSON_BYTES.value(), bytearray()
        with client.stream(method, f"{self._url}/api/v1/{path}", **content) as response:
            for chunk in response.iter_raw():
                body += chunk
                if len(body) > max_bytes:
                    expected = JSON_BYTES.allowed("bytes")
                    raise AnswerError(f"{self._url}: the response is too large, expected {expected}")
            return Response(self._url, response.status_code, bytes(body))

    def _new_client(self) -> Any:
        # A compressed body could be far larger than what is received.
        headers = {"Authorization": f"Bearer {self._token}", "Accept-Encoding": "identity"}
        timeout = self._http.Timeout(30.0, read=UPLOAD_TIMEOUT_S)
        return self._http.Client(headers=headers, timeout=timeout, follow_redirects=False)

    def _abandon(self) -> None:
        """Close the connections, so that a request that takes too long ends in its thread."""
        client, self._client = self._client, self._new_client()
        client.close()


class _Upload:
    """Chunks of a file, which report the number of bytes read so far and compute their SHA-256."""

    def __init__(self, stream: BinaryIO, on_read: Callable[[int], None]) -> None:
        self._stream, self._on_read, self._bytes_read = stream, on_read, 0
        self._digest, self._last_read = hashlib.sha256(), time.monotonic()

    def __iter__(self) -> Iterator[bytes]:
        while data := self._stream.read(_CHUNK_BYTES):
            self._digest.update(data)
            self._last_read = time.monotonic()
            self._bytes_read += len(data)
            self._on_read(self._bytes_read)
            yield data

    def sha256(self) -> str:
        """Return the hex SHA-256 of the bytes read so far."""
        return self._digest.hexdigest()

    def deadline(self) -> float:
        """Return the time by which the next chunk must be read or the response be complete."""
        return self._last_read + UPLOAD_TIMEOUT_S


def _deadline(limit_s: float) -> Callable[[], float]:
    end = time.monotonic() + limit_s
    return lambda: end


def _checked_id(submission_id: str) -> str:
    """Return an id that can be part of a URL; raise ``InputError`` for any other text."""
    if not SUBMISSION_ID.accept(submission_id):
        raise InputError(
            f"{escape_text(submission_id)} is not the id of a submission, expected {SUBMISSION_ID.text}"
        )
    return submission_id


def _httpx() -> ModuleType:
    try:
        import httpx2
    except ImportError as error:
        raise InputError(
            f"submitting requires httpx2 ({error}): pip install 'rebar-depth-bench[submit]'"
        ) from None
    module: ModuleType = httpx2
    return module
