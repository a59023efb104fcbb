"""HTTP client of a leaderboard: upload an archive, wait until it is scored, fetch the result.

The token is sent to the leaderboard only: redirects are not followed. Answers are limited in size and in time, and
validated before they are used; text in them is shortened and escaped, because a server may answer anything.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.request import proxy_bypass

from rebar_depth_bench.base.errors import (
    MAX_PROBLEMS_SHOWN,
    InputError,
    Problem,
    RebarDepthError,
    SubmissionError,
    library_message,
    printable,
    problem_summary,
    require_extra,
)
from rebar_depth_bench.base.limits import JSON_BYTES, DeadlineError, call_within
from rebar_depth_bench.base.parallel import Progress, silent
from rebar_depth_bench.base.reading import open_regular, parse_json
from rebar_depth_bench.base.validation import Model, validate_table
from rebar_depth_bench.remote.models import ErrorResponse, RejectedResponse, Submission, Token
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
REQUEST_TIMEOUT_S, RESULT_TIMEOUT_S, UPLOAD_TIMEOUT_S = 60.0, 600.0, 3600.0
"""Time limits of a request, of the download of a result, and of an upload, seconds."""
MIN_UPLOAD_RATE = 10_000
"""Rate by which the size of an archive extends the time limit of its upload, bytes per second."""


class ServiceError(RebarDepthError):
    """Leaderboard that cannot be reached or returns an unexpected response."""


@dataclass(frozen=True)
class _Response:
    """Status and body of a response; ``where`` is the address of the service for error messages."""

    where: str
    status: int
    body: bytes

    def read(self, model: type[Model], problems: list[Problem]) -> Model | None:
        """Return the body as an answer of the API, or None after adding its problems to ``problems``."""
        value, found = parse_json(self.body)
        problems += found
        return None if found else validate_table(model, value, problems, from_json=True)

    def answer(self, model: type[Model], *statuses: int) -> Model:
        """Return the answer of a response with one of ``statuses``.

        Raises ``InputError`` for other statuses from 400 to 499, and ``ServiceError`` for any other and for a body
        that is no valid answer, such as a proxy's page.
        """
        if self.status not in statuses:
            error_type = InputError if 400 <= self.status < 500 else ServiceError
            found = f"the response status is {self.status}, expected {' or '.join(map(str, statuses))}"
            raise error_type(f"{self.where}: {self.detail(found)}")
        problems: list[Problem] = []
        answer = self.read(model, problems)
        if answer is None:
            found = f"the answer of the leaderboard is not valid: {problem_summary(problems)}"
            raise ServiceError(f"{self.where}: {found}")
        return answer

    def detail(self, default: str) -> str:
        """Return the reason that the service gives for an error, or ``default`` if it gives none."""
        error = self.read(ErrorResponse, [])
        return default if error is None else _one_line(error.detail) or default


class LeaderboardClient:
    """Client for the leaderboard at ``url`` that authenticates with ``token``."""

    def __init__(self, url: str, token: str) -> None:
        """Raise ``InputError`` if ``httpx2`` is not installed or the token is not printable ASCII."""
        if not token.isascii() or not token.isprintable():
            raise InputError("the token has other characters than printable ASCII, expected it as it was issued")
        require_extra("submit", ["httpx2"])
        self._url = url.rstrip("/")
        self._token = token

    def submit(self, archive: Path, progress: Progress = silent) -> Submission:
        """Upload an archive and return the accepted submission.

        Raises ``SubmissionError`` with every problem of a rejected archive, before the upload if its predictions
        are not metric, ``InputError`` for an invalid token, an exhausted quota, an archive that is too large or a
        file that cannot be read, and ``ServiceError`` if the service cannot be reached or its answer is not valid.
        """
        meta = read_metadata(archive)
        if meta is not None and (problems := meta.kind_problems(RANKS_METRIC)):
            raise SubmissionError.from_problems(archive, problems)
        max_bytes = self._request("GET", "token", REQUEST_TIMEOUT_S).answer(Token, 200).max_upload_bytes
        digest = hashlib.sha256()
        try:
            with open_regular(archive) as stream:
                total = os.fstat(stream.fileno()).st_size
                if total > max_bytes:
                    raise InputError(f"{archive}: has {total} bytes, expected at most {max_bytes}")

                def chunks() -> Iterator[bytes]:
                    while data := stream.read(1 << 16):
                        digest.update(data)
                        progress("uploading", stream.tell(), total)
                        yield data

                headers = {"Content-Type": "application/zip", "Content-Length": str(total)}
                limit_s = UPLOAD_TIMEOUT_S + total / MIN_UPLOAD_RATE
                response = self._request("PUT", "submissions", limit_s, headers=headers, content=chunks())
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if response.status == 422 and (rejected := response.read(RejectedResponse, [])) is not None:
            # The last of the service's lines is the number of problems that it leaves out.
            lines = [rejected.detail, *rejected.problems[: MAX_PROBLEMS_SHOWN + 1]]
            rejection = SubmissionError(f"{archive}: " + "\n  - ".join(map(_one_line, lines)))
            rejection.problems = tuple(rejected.problem_details)
            raise rejection
        accepted = response.answer(Submission, 202, 200)
        if accepted.archive_sha256 != digest.hexdigest():
            raise ServiceError(f"{self._url}: the service received another archive than was sent")
        return accepted

    def wait(self, accepted: Submission, progress: Progress = silent, limit_s: float = WAIT_S) -> Submission:
        """Poll until an accepted submission is scored or failed, and return it.

        Raises ``ServiceError`` after ``limit_s`` seconds, and after more than ``MAX_FAILED_POLLS`` consecutive
        requests without a valid answer, and ``InputError`` if the service rejects the token or the id.
        """
        path = f"submissions/{accepted.id}"
        end = time.monotonic() + limit_s
        failed_polls, status = 0, "not scored"
        while (remaining_s := end - time.monotonic()) > 0:
            try:
                response = self._request("GET", path, min(remaining_s, REQUEST_TIMEOUT_S))
                if response.status == 429:
                    raise ServiceError(f"{self._url}: {response.detail('too many requests')}")
                submission = response.answer(Submission, 200)
                if submission.id != accepted.id:
                    raise ServiceError(f"{self._url}: the answer is on {submission.id}, expected {accepted.id}")
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

    def result(self, submission: Submission) -> tuple[Result, bytes]:
        """Return the result and its JSON, byte-identical to the output of ``rebar-bench score --json``.

        Raises ``ServiceError`` if the response status is not 200, or if the body is not the result of the archive.
        """
        response = self._request("GET", f"submissions/{submission.id}/result.json", RESULT_TIMEOUT_S)
        where = f"{self._url}: the result of the leaderboard"
        if response.status != 200:
            raise ServiceError(f"{where} has the response status {response.status}, expected 200")
        try:
            result = read_result(response.body, where)
        except InputError as error:
            raise ServiceError(str(error)) from None
        found, expected = result.submission.sha256, submission.archive_sha256
        if found != expected:
            raise ServiceError(f"{where} is of the archive with SHA-256 {found}, expected {expected}")
        return result, response.body

    def _request(self, method: str, path: str, limit_s: float, **content: Any) -> _Response:
        """Return the response to a request.

        Raises ``InputError`` for an invalid URL and for proxies or certificates of the environment that cannot be
        used, and ``ServiceError`` if the response is too large or not complete within ``limit_s`` seconds.
        """
        import httpx2

        # A compressed body could be far larger than what is received.
        headers = {"Authorization": f"Bearer {self._token}", "Accept-Encoding": "identity"}
        try:
            client = httpx2.Client(headers=headers, timeout=httpx2.Timeout(30.0, read=limit_s))
        except (OSError, ImportError, ValueError, httpx2.InvalidURL) as error:
            names = "ssl_cert_(file|dir)|sslkeylogfile" if isinstance(error, OSError) else "(https?|all)_proxy"
            found = f"{_set_variables(names)}: cannot be used: {library_message(error)}"
            raise InputError(f"{found}; unset or correct it") from None

        def exchange() -> _Response:
            body = bytearray()
            with client, client.stream(method, f"{self._url}/api/v1/{path}", **content) as response:
                for chunk in response.iter_raw():
                    body += chunk
                    if len(body) > JSON_BYTES.value():
                        raise ServiceError(f"{self._url}: the answer is too large: {JSON_BYTES.allowed('bytes')}")
            return _Response(self._where(), response.status_code, bytes(body))

        try:
            return call_within(limit_s, exchange, client.close)
        except DeadlineError:
            raise ServiceError(f"{self._where()}: no complete response within the time limit") from None
        except (httpx2.InvalidURL, httpx2.UnsupportedProtocol) as error:
            raise InputError(f"{self._url!r}: is not a valid URL, expected http://HOST:PORT: {error}") from None
        except httpx2.HTTPError as error:
            raise ServiceError(f"{self._where()}: no response: {library_message(error)}") from None

    def _where(self) -> str:
        """Return the address of the service, with the proxy of the environment that leads to it, if any."""
        import httpx2

        url = httpx2.URL(self._url)
        proxies = _set_variables(f"({url.scheme}|all)_proxy")
        if not proxies or proxy_bypass(url.host):
            return self._url
        return f"{self._url}, through the proxy {proxies} (NO_PROXY={url.host} avoids it)"


def _set_variables(pattern: str) -> str:
    """Return the environment variables whose name in lower case matches, and their values without passwords."""
    given = (item for item in sorted(os.environ.items()) if item[1] and re.fullmatch(pattern, item[0].lower()))
    return _one_line(", ".join(f"{name}=" + re.sub(r"^(\w+://)?.*@", r"\1", value) for name, value in given))


def _one_line(text: str) -> str:
    return printable(" ".join(text.split()), 500)
