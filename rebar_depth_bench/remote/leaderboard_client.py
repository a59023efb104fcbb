"""HTTP client of a leaderboard: upload an archive, wait until it is scored, fetch the result.

The token is sent to the leaderboard only: redirects are not followed. Answers are limited in size and in time, and
validated before they are used; text in them is shortened and escaped, because a server may answer anything.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from rebar_depth_bench.base.errors import (
    MAX_PROBLEMS_SHOWN,
    InputError,
    Problem,
    RebarDepthError,
    SubmissionError,
    escape_text,
    printable,
    problem_summary,
    require_extra,
)
from rebar_depth_bench.base.limits import JSON_BYTES, DeadlineError, call_until
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import open_regular, parse_json
from rebar_depth_bench.base.validation import validate_table
from rebar_depth_bench.remote.models import ID_PATTERN, Answer, RejectedResponse, Submission, Token
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.submission.declaration import RANKS_METRIC
from rebar_depth_bench.submission.reader import read_metadata

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
_MAX_LINE_CHARACTERS = 500
_Model = TypeVar("_Model", bound=Answer)


class ServiceError(RebarDepthError):
    """Leaderboard that cannot be reached or returns an unexpected response."""


class AnswerError(ServiceError):
    """Answer of a leaderboard that is not valid; asking again does not help."""


@dataclass(frozen=True)
class _Response:
    """Status and body of a response; ``where`` is the address of the service for error messages."""

    where: str
    status: int
    body: bytes

    def content(self) -> Mapping[str, Any]:
        """Return the JSON object of the body, or an empty one if it is none (such as a proxy's page)."""
        value, problems = parse_json(self.body)
        return value if not problems and isinstance(value, dict) else {}

    def answer(self, model: type[_Model], *statuses: int) -> _Model:
        """Return the validated answer of a response with one of ``statuses``.

        Raises ``InputError`` for other statuses from 400 to 499, ``ServiceError`` for any other and for a body
        that is no JSON object, and ``AnswerError`` for an object that is no valid answer.
        """
        content = self.content()
        if self.status not in statuses or not content:
            expected = " or ".join(map(str, statuses))
            wanted = f"{expected} with a JSON object" if self.status in statuses else expected
            default = f"the response status is {self.status}, expected {wanted}"
            error_type = InputError if 400 <= self.status < 500 else ServiceError
            raise error_type(f"{self.where}: {_detail(content, default)}")
        problems: list[Problem] = []
        answer = validate_table(model, content, problems)
        if answer is None:
            raise AnswerError(
                f"{self.where}: the answer of the leaderboard is not valid: {problem_summary(problems)}"
            )
        return answer

    def rejection(self, archive: Path) -> SubmissionError:
        """Return the error of a rejected archive, with the lines of the service and its ``problem_details``."""
        content = self.content()
        lines = content.get("problems")
        lines = [line for line in lines if isinstance(line, str)] if isinstance(lines, list) else []
        # The last of the service's lines is the number of those that it leaves out.
        shown = [f"\n  - {_one_line(line)}" for line in lines[: MAX_PROBLEMS_SHOWN + 1]]
        more = len(lines) - len(shown)
        omitted = f"\n  ... and {more} more" if more > 0 else ""
        error = SubmissionError(f"{archive}: {_detail(content, 'rejected')}{''.join(shown)}{omitted}")
        rejected = validate_table(RejectedResponse, content, [], from_json=True)
        error.problems = () if rejected is None else tuple(rejected.problem_details)
        return error


def _detail(content: Mapping[str, Any], default: str) -> str:
    """Return the explanation in the JSON object of an error, or ``default`` if it has none."""
    value = content.get("detail")
    return _one_line(value) if isinstance(value, str) and value.strip() else default


def _one_line(text: str) -> str:
    return printable(" ".join(text[: 10 * _MAX_LINE_CHARACTERS].split()), _MAX_LINE_CHARACTERS)


class LeaderboardClient:
    """Client for the leaderboard at ``url`` that authenticates with ``token``; a context manager."""

    def __init__(self, url: str, token: str) -> None:
        """Open an HTTP client.

        Raises ``InputError`` if ``httpx2`` is not installed, the token is not ASCII, or the environment names a
        proxy or certificates that cannot be used.
        """
        if not token.isascii() or not token.isprintable():
            raise InputError("the token has other characters than printable ASCII, expected it as it was issued")
        require_extra("submit", ["httpx2"])
        import httpx2

        self._http: Any = httpx2
        self._url = url.rstrip("/")
        self._token = token
        self._peer: tuple[str, int] | None = None
        self._client = self._new_client()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def submit(self, archive: Path, progress: Progress = silent) -> Submission:
        """Upload an archive and return the accepted submission.

        Raises ``SubmissionError`` with every problem of a rejected archive, before the upload if its predictions
        are not metric, ``InputError`` for an invalid token, an exhausted quota, an archive that is too large or a
        file that cannot be read, and ``ServiceError`` if the service cannot be reached or its answer is not valid.
        """
        meta = read_metadata(archive)
        if meta is not None and (problems := meta.kind_problems(RANKS_METRIC)):
            raise SubmissionError.from_problems(archive, problems)
        max_bytes = self._get("token", REQUEST_TIMEOUT_S).answer(Token, 200).max_upload_bytes
        digest, last_read = hashlib.sha256(), time.monotonic()
        try:
            with open_regular(archive) as stream:
                total = os.fstat(stream.fileno()).st_size
                if total > max_bytes:
                    raise InputError(f"{archive}: has {total} bytes, expected at most {max_bytes}")

                def chunks() -> Iterator[bytes]:
                    nonlocal last_read
                    while data := stream.read(_CHUNK_BYTES):
                        digest.update(data)
                        last_read = time.monotonic()
                        progress("uploading", stream.tell(), total)
                        yield data

                headers = {"Content-Type": "application/zip", "Content-Length": str(total)}
                # An upload may take any time as long as it proceeds.
                response = self._call(
                    "PUT", "submissions", lambda: last_read + UPLOAD_TIMEOUT_S, headers=headers, content=chunks()
                )
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if response.status == 422:
            raise response.rejection(archive)
        accepted = response.answer(Submission, 202, 200)
        if accepted.archive_sha256 != digest.hexdigest():
            raise AnswerError(f"{self._url}: the service received another archive than was sent")
        return accepted

    def wait(self, submission_id: str, progress: Progress = silent, limit_s: float = WAIT_S) -> Submission:
        """Poll until the submission is scored or failed, and return it.

        Raises ``ServiceError`` after ``limit_s`` seconds, after more than ``MAX_FAILED_POLLS`` consecutive failed
        requests and for an answer that is not valid, such as an unknown status, and ``InputError`` if the service
        rejects the token or the id.
        """
        path = f"submissions/{_checked_id(submission_id)}"
        end = time.monotonic() + limit_s
        failed_polls, status = 0, "not scored"
        while (remaining_s := end - time.monotonic()) > 0:
            try:
                response = self._get(path, min(remaining_s, REQUEST_TIMEOUT_S))
                if response.status == 429:
                    raise ServiceError(f"{self._url}: {_detail(response.content(), 'too many requests')}")
                submission = response.answer(Submission, 200)
                if submission.id != submission_id:
                    raise AnswerError(
                        f"{self._url}: the answer is on submission {submission.id}, expected {submission_id}"
                    )
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
        raise ServiceError(
            f"{self._url}/{path}: the submission is still {status} after {limit_s:g} s of waiting; "
            "this page shows its result once it is scored"
        )

    def result(self, submission_id: str, archive_sha256: str | None = None) -> tuple[Result, bytes]:
        """Return the result and its JSON, byte-identical to the output of ``rebar-bench score --json``.

        Raises ``ServiceError`` if the response status is not 200, and ``AnswerError`` if the body is no result, or
        that of another archive than the one with ``archive_sha256``.
        """
        response = self._get(f"submissions/{_checked_id(submission_id)}/result.json", RESULT_TIMEOUT_S)
        if response.status != 200:
            raise ServiceError(
                f"{self._url}: the response status for the result is {response.status}, expected 200"
            )
        where = f"{self._url}: the result of the leaderboard"
        try:
            result = read_result(response.body, where)
        except InputError as error:
            raise AnswerError(str(error)) from None
        if archive_sha256 not in (None, result.submission.sha256):
            raise AnswerError(
                f"{where} is of the archive with SHA-256 {result.submission.sha256}, expected {archive_sha256}"
            )
        return result, response.body

    def _get(self, path: str, limit_s: float) -> _Response:
        end = time.monotonic() + limit_s
        return self._call("GET", path, lambda: end)

    def _call(self, method: str, path: str, end: Callable[[], float], **content: Any) -> _Response:
        """Return the response to a request, which must be complete before the time ``end()``."""
        client = self._client
        try:
            return call_until(end, lambda: self._exchange(client, method, path, content), self._abandon)
        except DeadlineError:
            raise ServiceError(f"{self._where()}: no complete response within the time limit") from None
        except (self._http.InvalidURL, self._http.UnsupportedProtocol) as error:
            raise InputError(f"{self._url!r}: is not a valid URL, expected http://HOST:PORT: {error}") from None
        except self._http.HTTPError as error:
            found = _one_line(str(error)) or type(error).__name__
            raise ServiceError(f"{self._where()}: no response: {found}") from None

    def _exchange(self, client: Any, method: str, path: str, content: dict[str, Any]) -> _Response:
        def trace(event: str, info: Mapping[str, Any]) -> None:
            if event.endswith("connect_tcp.started"):
                self._peer = info["host"], info["port"]

        max_bytes, body, url = JSON_BYTES.value(), bytearray(), f"{self._url}/api/v1/{path}"
        with client.stream(method, url, extensions={"trace": trace}, **content) as response:
            for chunk in response.iter_raw():
                body += chunk
                if len(body) > max_bytes:
                    expected = JSON_BYTES.allowed("bytes")
                    raise AnswerError(f"{self._url}: the response is too large, expected {expected}")
            return _Response(self._where(), response.status_code, bytes(body))

    def _where(self) -> str:
        """Return the address of the service, with the proxy to which the last connection was made, if any."""
        if self._peer is None:
            return self._url
        url = self._http.URL(self._url)
        if self._peer == (url.raw_host.decode(), url.port or {"http": 80, "https": 443}[url.scheme]):
            return self._url
        host, port = self._peer
        names = _set_variables(f"{url.scheme}_proxy", "all_proxy")
        return f"{self._url}, through the proxy {host}:{port} ({names}; NO_PROXY={url.host} avoids it)"

    def _new_client(self) -> Any:
        # A compressed body could be far larger than what is received.
        headers = {"Authorization": f"Bearer {self._token}", "Accept-Encoding": "identity"}
        timeout = self._http.Timeout(30.0, read=UPLOAD_TIMEOUT_S)
        certificates = "ssl_cert_file" if os.environ.get("SSL_CERT_FILE") else "ssl_cert_dir"
        folders = os.environ.get("SSL_CERT_DIR", "") if certificates == "ssl_cert_dir" else ""
        try:
            if folders and not any(map(os.path.isdir, folders.split(os.pathsep))):  # It would be as if empty.
                raise OSError("there is no such folder")
            return self._http.Client(headers=headers, timeout=timeout, follow_redirects=False)
        except OSError as error:  # Before ``ValueError``, which some errors of certificates are as well.
            found = _set_variables("sslkeylogfile" if error.filename else certificates)
            raise InputError(f"{found}: cannot be used: {error.strerror or error}; unset or correct it") from None
        except (ImportError, ValueError, self._http.InvalidURL) as error:
            found = _set_variables("http_proxy", "https_proxy", "all_proxy")
            expected = "the package httpx2[socks]" if isinstance(error, ImportError) else "http://HOST:PORT"
            raise InputError(f"{found}: no usable proxy, expected {expected}; NO_PROXY=* avoids it") from None

    def _abandon(self) -> None:
        """Close the connections, so that a request that takes too long ends in its thread."""
        client, self._client = self._client, self._new_client()
        client.close()


def _set_variables(*names: str) -> str:
    """Return the environment variables with some names in any case, and their values without passwords."""
    given = (item for item in sorted(os.environ.items()) if item[1] and item[0].lower() in names)
    shown = [f"{name}=" + re.sub(r"^(\w+://)?.*@", r"\1", value) for name, value in given]
    return printable(", ".join(shown), _MAX_LINE_CHARACTERS)


def _checked_id(submission_id: str) -> str:
    """Return an id that can be part of a URL; raise ``InputError`` for any other text."""
    if not re.fullmatch(ID_PATTERN, submission_id):
        raise InputError(
            f"{escape_text(submission_id)} is not the id of a submission, expected letters, digits, _ and -"
        )
    return submission_id
