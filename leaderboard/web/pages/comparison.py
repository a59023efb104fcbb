"""Comparison of two submissions: every metric with the paired difference and its 95 % interval."""

from __future__ import annotations

from typing import Any

from fastapi import HTTPException

from leaderboard.db import submissions
from leaderboard.service import Service
from rebar_depth_bench.errors import InputError, printable
from rebar_depth_bench.reporting.comparison_tables import COMPARISON_NOTE, comparison_cells, views_note
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.result_io import read_result


def comparison_context(service: Service, first_id: str, other_id: str) -> dict[str, Any]:
    """Return the template context of the comparison of two submissions.

    Raises status 404 if one has no result or the ground truth is hidden, and 422 if they cannot be compared.
    """
    if service.settings.hidden_truth:
        raise HTTPException(404, "the ground truth is hidden; submissions are not compared view by view")
    try:
        comparison = compare(_result(service, first_id), _result(service, other_id))
    except InputError as error:
        raise HTTPException(422, str(error)) from None
    return {
        "pair": [
            {"id": submission_id, "name": printable(archive.method)}
            for submission_id, archive in zip((first_id, other_id), comparison.provenance.archives, strict=True)
        ],
        "compared": [
            {
                "name": printable(config),
                "views": views_note(differences),
                "rows": [comparison_cells(difference) for difference in differences],
            }
            for config, differences in comparison.configs.items()
        ],
        "note": COMPARISON_NOTE,
    }


def _result(service: Service, submission_id: str) -> Result:
    content = submissions.result_json(service.database, submission_id)
    if content is None:
        raise HTTPException(404, "no such submission, or it is not scored")
    return read_result(content, "the submission")
