"""Answers of a leaderboard: their models, and text of a server for messages.

Every answer is validated before it is used, and text in it is shortened and escaped, because a server may answer
anything.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from rebar_depth_bench.errors import (
    MAX_PROBLEMS_SHOWN,
    InputError,
    Problem,
    RebarDepthError,
    SubmissionError,
    printable,
    problem_summary,
)
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.scoring.result import DisclosedResult, Result, is_disclosed, read_disclosed, read_result
from rebar_depth_bench.validation import Expected, StrictModel, one_of, text, validate_table, whole_number

_MAX_INTEGER = 2**63 - 1
_MAX_LINE_CHARACTERS = 500
_PROBLEMS = TypeAdapter(tuple[Problem, ...], config=ConfigDict(defer_build=True))


class ServiceError(RebarDepthError):
    """Leaderboard that cannot be reached or returns an unexpected response."""


class AnswerError(ServiceError):
    """Answer of a leaderboard that is not valid; asking again does not help."""


def _matches(pattern: str, expected: str) -> Expected:
    return Expected(expected, lambda value: re.fullmatch(pattern, value) is not None and value.isprintable())


SUBMISSION_ID = _matches("[A-Za-z0-9_-]{1,100}", "an id of letters, digits, _ and -")
"""Description of an id, which becomes part of URLs."""


class _Answer(StrictModel, extra="ignore"):
    """Base class of answers: types are strict, and keys of newer services are ignored."""


class TokenInfo(_Answer):
    """Name of a token, its quota and the size limit of the service, bytes."""

    max_upload_bytes: Annotated[int, whole_number(1, _MAX_INTEGER)]
    name: Annotated[str, text(1000)] | None = None
    quota: Annotated[int, whole_number(0, _MAX_INTEGER)] | None = None
    quota_left: Annotated[int, whole_number(0, _MAX_INTEGER)] | None = None


class Submission(_Answer):
    """Accepted submission: its status, the URL of its page, and the reason if scoring has failed."""

    id: Annotated[str, SUBMISSION_ID]
    status: Annotated[str, one_of("queued", "scoring", "scored", "failed")]
    url: Annotated[str, _matches(r"https?://[^\s/][^\s]{0,1999}", "an http or https URL")]
    reason: Annotated[str, Expected("the reason of the failure")] | None = None
    archive_sha256: Annotated[str, _matches("[0-9a-f]{64}", "64 hex digits")] | None = None


_Model = TypeVar("_Model", bound=_Answer)


@dataclass(frozen=True)
class Response:
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
            raise error_type(f"{self.where}: {detail(content, default)}")
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
        shown = [f"\n  - {server_text(line)}" for line in lines[: MAX_PROBLEMS_SHOWN + 1]]
        more = len(lines) - len(shown)
        omitted = f"\n  ... and {more} more" if more > 0 else ""
        error = SubmissionError(f"{archive}: {detail(content, 'rejected')}{''.join(shown)}{omitted}")
        try:
            error.problems = _PROBLEMS.validate_python(content.get("problem_details", ()))
        except ValidationError:  # Another version of the service.
            error.problems = ()
        return error

    def result(self, archive_sha256: str | None) -> Result | DisclosedResult:
        """Return the result in the body. Raises ``AnswerError`` if it is none, or that of another archive.

        A leaderboard with hidden ground truth returns only the disclosed part of it.
        """
        where = f"{self.where}: the result of the leaderboard"
        document, problems = parse_json(self.body)
        if problems:
            raise AnswerError(f"{where}: {problem_summary(problems)}")
        try:
            result = (read_disclosed if is_disclosed(document) else read_result)(self.body, where)
        except InputError as error:
            raise AnswerError(str(error)) from None
        if archive_sha256 not in (None, result.submission.sha256):
            found = server_text(str(result.submission.sha256))
            raise AnswerError(f"{where} is of the archive with SHA-256 {found}, expected {archive_sha256}")
        return result


def detail(content: Mapping[str, Any], default: str) -> str:
    """Return the explanation in the JSON object of an error, or ``default`` if it has none."""
    value = content.get("detail")
    return server_text(value) if isinstance(value, str) and value.strip() else default


def server_lines(value: str) -> str:
    """Return text of a server with its line breaks, each line as ``server_text``, at most 21 lines."""
    return "\n".join(server_text(line) for line in value.splitlines()[: MAX_PROBLEMS_SHOWN + 1])


def server_text(value: str) -> str:
    """Return text of a server on one line, without control characters, truncated to 500 characters."""
    return printable(" ".join(value[: 10 * _MAX_LINE_CHARACTERS].split()), _MAX_LINE_CHARACTERS)
