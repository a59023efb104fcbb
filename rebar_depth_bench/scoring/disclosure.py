"""Disclosed results: what a leaderboard with hidden ground truth returns of a result.

Most numbers of a result help a submitter to compute the ground truth: a view's scale factor, for example, is the
ratio of the median true depth to the median of the submitter's own depth. Only the rank error and the coverage of
each config are disclosed, rounded to ``DECIMALS``. The models name all that is disclosed, so that a number that is
added to results is hidden unless it is added here, too.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict

from rebar_depth_bench.errors import InputError, Problem, SubmissionError
from rebar_depth_bench.reading import parse_json
from rebar_depth_bench.scoring.protocol import PROTOCOL
from rebar_depth_bench.scoring.result import (
    LIMITED,
    DatasetIdentity,
    Name,
    SoftwareIdentity,
    SubmissionIdentity,
    ViewScore,
)
from rebar_depth_bench.validation import StrictModel, one_of, validate_table

DECIMALS = 3
"""Decimals of the disclosed numbers."""

MIN_VIEW_COVERAGE = 0.5
"""Smallest coverage of a view that is scored if the ground truth is hidden; it limits probing by omission."""

COVERAGE_RULE = f"predictions for at least {MIN_VIEW_COVERAGE * 100:.0f} % of the scored pixels of each view"


def disclosed_number(value: float) -> float:
    """Return a number as it is disclosed."""
    return round(value, DECIMALS)


_Number = Annotated[float, Strict(), Field(ge=0, le=1), AfterValidator(disclosed_number)] | None


class DisclosedTable(StrictModel, extra="ignore"):
    """Disclosed part of the table of a config; ``rank_error`` is None without scored views."""

    coverage: _Number
    ranked: bool
    rank_error: _Number


class DisclosedResult(StrictModel, extra="ignore", strict=False):
    """Disclosed part of a result; ``hidden_truth`` distinguishes it from a whole result."""

    protocol: Annotated[str, Strict(), one_of(PROTOCOL)]
    hidden_truth: Literal[True] = True
    dataset: DatasetIdentity
    submission: SubmissionIdentity
    software: SoftwareIdentity
    tables: Annotated[dict[Name, DisclosedTable], LIMITED]


def disclosed_json(result: bytes) -> bytes:
    """Return the JSON of the disclosed part of a result; of a result that cannot be read, it has no numbers."""
    content = validate_table(DisclosedResult, json.loads(result), [])
    disclosed = {"hidden_truth": True} if content is None else content.model_dump(mode="json")
    return (json.dumps(disclosed, indent=1, ensure_ascii=False) + "\n").encode()


def is_disclosed(document: object) -> bool:
    """Return whether a JSON value is the disclosed part of a result."""
    return isinstance(document, dict) and document.get("hidden_truth") is True


def read_disclosed(data: bytes, where: str) -> DisclosedResult:
    """Return the disclosed result in ``data``; ``where`` names the source in error messages.

    Raises ``InputError`` with all problems if it is none.
    """
    document, problems = parse_json(data)
    content = None if problems else validate_table(DisclosedResult, document, problems)
    if content is None:
        raise InputError.from_problems(f"{where}: is not a disclosed result", problems)
    return content


def check_view_coverage(views: Sequence[ViewScore]) -> None:
    """Raise ``SubmissionError`` if a view has less than ``MIN_VIEW_COVERAGE``.

    The message names neither the view nor its coverage, because these tell how many omitted pixels are scored.
    """
    if any(view.coverage < MIN_VIEW_COVERAGE for view in views):
        problem = Problem("missing", "", "a view has too few predictions on scored pixels", COVERAGE_RULE)
        raise SubmissionError.from_problems("the archive", [problem])
