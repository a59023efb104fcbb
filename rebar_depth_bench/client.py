"""Talks to a leaderboard: uploads an archive, waits until it is scored, fetches the result."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, Self

from rebar_depth_bench.errors import InputError, RebarDepthError, SubmissionError
from rebar_depth_bench.progress import Progress, silent

CHUNK = 1 << 20
POLL_S = 2.0
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
        try:
            total = archive.stat().st_size
            with archive.open("rb") as stream:
                watched = _Watched(stream.read, lambda done: progress("uploading", done, total), total)
                answer = self._call("POST", "", files={"archive": (archive.name, watched, "application/zip")})
        except OSError as error:
            raise InputError(f"{archive}: cannot be read: {error.strerror or error}") from None
        if answer.status_code == 422:
            content = answer.json()
            raise SubmissionError(str(archive), content.get("problems", [content.get("detail", "refused")]))
        return self._accepted(answer, 202)

    def wait(self, submission_id: str, progress: Progress = silent) -> dict[str, Any]:
        """Return the submission once it is scored or failed. A service that is away for a while is asked again."""
        away = 0
        while True:
            try:
                found = self._accepted(self._call("GET", f"/{submission_id}"), 200)
                away = 0
            except ServiceError:
                away += 1
                if away > 30:
                    raise
                found = {"status": "unknown"}
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
        except (self._http.HTTPError, self._http.InvalidURL) as error:
            raise ServiceError(f"{self._url}: no answer: {error or type(error).__name__}") from None

    def _accepted(self, answer: Any, status: int) -> dict[str, Any]:
        try:
            content: dict[str, Any] = answer.json()
        except ValueError:
            content = {}
        if answer.status_code == status and "id" in content:
            return content
        told = content.get("detail", f"answered {answer.status_code}, expected {status}")
        kind = InputError if 400 <= answer.status_code < 500 else ServiceError
        raise kind(f"{self._url}: {told}")


class _Watched:
    """A file that tells how much of it was read; ``fileno`` is not offered, so that it is read in pieces."""

    def __init__(self, read: Callable[[int], bytes], tell: Callable[[int], None], total: int) -> None:
        self._read, self._tell_done, self._total, self._done = read, tell, total, 0

    def __len__(self) -> int:
        return self._total

    def read(self, size: int = -1) -> bytes:
        """Read on."""
        data = self._read(size)
        self._done += len(data)
        self._tell_done(self._done)
        return data

    def __iter__(self) -> Iterator[bytes]:
        while data := self.read(CHUNK):
            yield data


def _httpx() -> ModuleType:
    try:
        import httpx2
    except ImportError as error:
        raise InputError(f"submitting needs httpx2 ({error}): pip install 'rebar-depth-bench[submit]'") from None
    module: ModuleType = httpx2
    return module
