"""Talks to a leaderboard: uploads an archive, waits until it is scored, fetches the result."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Self

from rebar_depth_bench.errors import InputError, RebarDepthError, SubmissionError
from rebar_depth_bench.progress import Progress, silent

POLL_S = 2.0
NOT_THERE = "no such submission"
MOST_AWAY = 30
"""So often in a row is a service that does not answer asked again."""
ANSWER_S = 3600.0
"""The answer to an upload waits for the archive's check."""


class ServiceError(RebarDepthError):
    """The leaderboard cannot be reached, or answers what it should not."""


class Leaderboard:
    """A leaderboard at ``url``, and the token to submit with. A context manager."""

    def __init__(self, url: str, token: str) -> None:
        """Raise ``InputError`` where the client's package is missing."""
        self._http = _httpx()
        self._url = url.rstrip("/")
        timeout = self._http.Timeout(30.0, read=ANSWER_S)
        self._client = self._http.Client(headers={"Authorization": f"Bearer {token}"}, timeout=timeout)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()

    def submit(self, archive: Path, progress: Progress = silent) -> dict[str, Any]:
        """Upload an archive and return the accepted submission: ``id``, ``status``, ``url``.

        Raises ``SubmissionError`` with every problem of the archive, ``InputError`` for a token, a quota or a
        size, ``ServiceError`` where the service cannot be reached.
        """
        self._check_token()
        try:
            total = archive.stat().st_size
            with archive.open("rb") as stream:
                watched = _Watched(stream.read, lambda done: progress("uploading", done, total))
                answer = self._call("POST", "", files={"archive": (archive.name, watched, "application/zip")})
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if answer.status_code == 422:
            content = _content(answer)
            raise SubmissionError(str(archive), content.get("problems", [content.get("detail", "refused")]))
        return self._accepted(answer, 202)

    def _check_token(self) -> None:
        """Ask for what is not there: a token or an address that is wrong is told before gigabytes are sent."""
        answer = self._call("GET", "/none")
        if answer.status_code != 404 or _content(answer).get("detail") != NOT_THERE:
            self._accepted(answer, 404)

    def wait(self, submission_id: str, progress: Progress = silent) -> dict[str, Any]:
        """Return the submission once it is scored or failed. A service that is away for a while is asked again."""
        away = 0
        while True:
            try:
                answer = self._call("GET", f"/{submission_id}")
                if answer.status_code == 429:
                    raise ServiceError(f"{self._url}: {_content(answer).get('detail', 'too many requests')}")
                found = self._accepted(answer, 200)
                away = 0
            except ServiceError:
                away += 1
                if away > MOST_AWAY:
                    raise
                found = {"status": "no answer, asking again"}
            if found["status"] in ("scored", "failed"):
                progress(found["status"], 1, 1)
                return found
            progress(found["status"], 0, 1)
            time.sleep(POLL_S)

    def result(self, submission_id: str) -> bytes:
        """Return the result's JSON, byte for byte as ``rebar-bench score --json`` writes it."""
        answer = self._call("GET", f"/{submission_id}/result.json")
        if answer.status_code != 200:
            raise ServiceError(f"{self._url}: answered {answer.status_code} for the result, expected 200")
        content: bytes = answer.content
        return content

    def _call(self, method: str, path: str, **content: Any) -> Any:
        try:
            return self._client.request(method, f"{self._url}/api/v1/submissions{path}", **content)
        except (self._http.InvalidURL, self._http.UnsupportedProtocol) as error:
            raise InputError(f"{self._url!r}: no address, expected http://HOST:PORT: {error}") from None
        except self._http.HTTPError as error:
            raise ServiceError(f"{self._url}: no answer: {error or type(error).__name__}") from None

    def _accepted(self, answer: Any, status: int) -> dict[str, Any]:
        content = _content(answer)
        if answer.status_code == status and "id" in content:
            return content
        told = content.get("detail", f"answered {answer.status_code}, expected {status}")
        kind = InputError if 400 <= answer.status_code < 500 else ServiceError
        raise kind(f"{self._url}: {told}")


class _Watched:
    """A file that tells how much of it was read; ``fileno`` is not offered, so that it is read in pieces."""

    def __init__(self, read: Callable[[int], bytes], tell: Callable[[int], None]) -> None:
        self._read, self._tell_done, self._done = read, tell, 0

    def read(self, size: int = -1) -> bytes:
        """Read on."""
        data = self._read(size)
        self._done += len(data)
        self._tell_done(self._done)
        return data


def _content(answer: Any) -> dict[str, Any]:
    """Return an answer's JSON object; an empty one for what is none, such as a proxy's page."""
    try:
        content = answer.json()
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _httpx() -> ModuleType:
    try:
        import httpx2
    except ImportError as error:
        raise InputError(f"submitting needs httpx2 ({error}): pip install 'rebar-depth-bench[submit]'") from None
    module: ModuleType = httpx2
    return module
