"""The report of a scored archive: picks the views to show and gathers their pictures."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rebar_depth_bench.dataset import decode_row, load_undecoded
from rebar_depth_bench.files import write_text
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.report.page import render_report
from rebar_depth_bench.report.panels import ViewPanels
from rebar_depth_bench.result import Result, ViewScore, badness
from rebar_depth_bench.submission import SubmissionReader, config_of, open_submission

VIEWS_SHOWN = 6
_COLUMNS = ("view_id", "left_rgb", "left_depth", "left_mask")


def write_report(result: Result, archive: str | os.PathLike[str], root: str | Path, target: Path) -> None:
    """Write the HTML report of ``result``, which came from scoring ``archive`` on ``root``.

    Of each config up to ``VIEWS_SHOWN`` views are shown, evenly spread from its worst native AbsRel to its best.
    """
    folder = open_folder(root)
    panels: list[ViewPanels] = []
    with open_submission(archive, folder.expected_views()) as submission:
        for config in result.tables:
            chosen = views_to_show([view for view in result.views if config_of(view.view_id) == config])
            rows = _rows_of({score.view_id for score in chosen}, root, config)
            panels += [_panels(score, rows[score.view_id], submission) for score in chosen]
    write_text(target, render_report(result, panels))


def _rows_of(view_ids: set[str], root: str | Path, config: str) -> dict[str, dict[str, Any]]:
    """Return the rows of some views, streamed past the others: only these are decoded."""
    undecoded = load_undecoded(root, config, streaming=True, columns=_COLUMNS)
    return {row["view_id"]: decode_row(row) for row in undecoded if row["view_id"] in view_ids}


def _panels(score: ViewScore, row: Mapping[str, Any], submission: SubmissionReader) -> ViewPanels:
    return ViewPanels(
        view_id=score.view_id,
        rgb=row["left_rgb"],
        truth_m=row["left_depth"],
        prediction_m=submission.read(score.view_id),
        steel=row["left_mask"],
        score=score,
    )


def views_to_show(views: Sequence[ViewScore]) -> list[ViewScore]:
    """Return up to ``VIEWS_SHOWN`` views from worst to best, evenly spread; a view without a value is worst."""
    worst_first = sorted(views, key=badness, reverse=True)
    if len(worst_first) <= VIEWS_SHOWN:
        return worst_first
    last = len(worst_first) - 1
    return [worst_first[round(n * last / (VIEWS_SHOWN - 1))] for n in range(VIEWS_SHOWN)]
