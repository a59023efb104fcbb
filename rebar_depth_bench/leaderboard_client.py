"""HTTP client of a leaderboard: upload an archive, wait until it is scored, fetch the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Self

from pydantic import TypeAdapter, ValidationError

from rebar_depth_bench.errors import InputError, Problem, RebarDepthError, SubmissionError
from rebar_depth_bench.progress import Progress, silent

_PROBLEMS = TypeAdapter(tuple[Problem, ...])
POLL_INTERVAL_S = 2.0
"""Time between two status requests, seconds."""
MAX_FAILED_POLLS = 30
"""Number of consecutive failed status requests that ``LeaderboardClient.wait`` tolerates."""
UPLOAD_TIMEOUT_S = 3600.0
"""Read timeout, seconds; the service responds to an upload only after it has checked the archive."""


class ServiceError(RebarDepthError):
    """Leaderboard that cannot be reached or returns an unexpected response."""


class LeaderboardClient:
    """Client for the leaderboard at ``url`` that authenticates with ``token``; a context manager."""

    def __init__(self, url: str, token: str) -> None:
        """Open an HTTP client; raise ``InputError`` if ``httpx2`` is not installed."""
        self._http = _httpx()
        self._url = url.rstrip("/")
        timeout = self._http.Timeout(30.0, read=UPLOAD_TIMEOUT_S)
        self._client = self._http.Client(headers={"Authorization": f"Bearer {token}"}, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def submit(self, archive: Path, progress: Progress = silent) -> dict[str, Any]:
        """Upload an archive and return the accepted submission, a dict with ``id``, ``status`` and ``url``.

        Raises ``SubmissionError`` with every problem of a rejected archive, ``InputError`` for an invalid token,
        an exhausted quota, an archive that is too large or a file that cannot be read, and ``ServiceError`` if
        the service cannot be reached.
        """
        max_bytes = self.token()["max_upload_bytes"]
        try:
            total = archive.stat().st_size
            if total > max_bytes:
                raise InputError(f"{archive}: has {total} bytes, expected at most {max_bytes}")
            with archive.open("rb") as stream:
                upload = _ProgressReader(stream.read, lambda done: progress("uploading", done, total))
                response = self._call(
                    "POST", "submissions", files={"archive": (archive.name, upload, "application/zip")}
                )
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if response.status_code == 422:
            content = _json_object(response)
            raise _rejection(archive, content)
        return self._checked(response, 202, "id")

    def token(self) -> dict[str, Any]:
        """Return the token's ``name``, ``quota``, ``quota_left`` and the limits of the service.

        Raises ``InputError`` for an unknown token or a wrong URL, ``ServiceError`` if the service does not answer.
        """
        return self._checked(self._call("GET", "token"), 200, "max_upload_bytes")

    def wait(self, submission_id: str, progress: Progress = silent) -> dict[str, Any]:
        """Poll until the submission is scored or failed, and return it.

        Raises ``ServiceError`` after more than ``MAX_FAILED_POLLS`` consecutive failed requests, and
        ``InputError`` if the service rejects the token or the id.
        """
        failed_polls = 0
        while True:
            try:
                response = self._call("GET", f"submissions/{submission_id}")
                if response.status_code == 429:
                    raise ServiceError(f"{self._url}: {_json_object(response).get('detail', 'too many requests')}")
                submission = self._checked(response, 200, "id")
                failed_polls = 0
            except ServiceError:
                failed_polls += 1
                if failed_polls > MAX_FAILED_POLLS:
                    raise
                submission = {"status": "no response, retrying"}
            if submission["status"] in ("scored", "failed"):
                progress(submission["status"], 1, 1)
                return submission
            progress(submission["status"], 0, 1)
            time.sleep(POLL_INTERVAL_S)

    def result(self, submission_id: str) -> bytes:
        """Return the result JSON, byte-identical to the output of ``rebar-bench score --json``.

        Raises ``ServiceError`` if the response status is not 200.
        """
        response = self._call("GET", f"submissions/{submission_id}/result.json")
        if response.status_code != 200:
            raise ServiceError(
                f"{self._url}: the response status for the result is {response.status_code}, expected 200"
            )
        content: bytes = response.content
        return content

    def _call(self, method: str, path: str, **content: Any) -> Any:
        try:
            return self._client.request(method, f"{self._url}/api/v1/{path}", **content)
        except (self._http.InvalidURL, self._http.UnsupportedProtocol) as error:
            raise InputError(f"{self._url!r}: is not a valid URL, expected http://HOST:PORT: {error}") from None
        except self._http.HTTPError as error:
            raise ServiceError(f"{self._url}: no response: {error or type(error).__name__}") from None

    def _checked(self, response: Any, status: int, key: str) -> dict[str, Any]:
        """Return the JSON object of a response with ``status`` that has ``key``; raise its error otherwise."""
        content = _json_object(response)
        if response.status_code == status and key in content:
            return content
        detail = content.get("detail", f"the response status is {response.status_code}, expected {status}")
        error_type = InputError if 400 <= response.status_code < 500 else ServiceError
        raise error_type(f"{self._url}: {detail}")


class _ProgressReader:
    """File-like object that reports the number of bytes read so far.

    It has no ``fileno``, so that the HTTP client reads it in chunks.
    """

    def __init__(self, read: Callable[[int], bytes], on_read: Callable[[int], None]) -> None:
        self._read, self._on_read, self._bytes_read = read, on_read, 0

    def read(self, size: int = -1) -> bytes:
        """Read up to ``size`` bytes and report the total."""
        data = self._read(size)
        self._bytes_read += len(data)
        self._on_read(self._bytes_read)
        return data


def _rejection(archive: Path, content: Mapping[str, Any]) -> SubmissionError:
    """Return the error of a rejected archive, with the lines of the service and its ``problem_details``."""
    lines = "".join(f"\n  - {line}" for line in content.get("problems", ()))
    error = SubmissionError(f"{archive}: {content.get('detail', 'rejected')}{lines}")
    try:
        error.problems = _PROBLEMS.validate_python(content.get("problem_details", ()))
    except ValidationError:  # Another version of the service.
        error.problems = ()
    return error


def _json_object(response: Any) -> dict[str, Any]:
    """Return the JSON object of a response, or an empty dict if the body is not one (such as a proxy's page)."""
    try:
        content = response.json()
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _httpx() -> ModuleType:
    try:
        import httpx2
    except ImportError as error:
        raise InputError(
            f"submitting requires httpx2 ({error}): pip install 'rebar-depth-bench[submit]'"
        ) from None
    module: ModuleType = httpx2
    return module
