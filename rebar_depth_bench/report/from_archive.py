"""The report of a scored archive: picks the views to show and gathers their pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rebar_depth_bench.dataset import decode_row, load_undecoded
from rebar_depth_bench.files import write_text
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.report.browser import VIEWS_SHOWN, views_to_show
from rebar_depth_bench.report.page import render_report
from rebar_depth_bench.report.panels import ViewPanels
from rebar_depth_bench.result import Result, ViewScore
from rebar_depth_bench.submission import SubmissionReader, config_of, open_submission

_COLUMNS = ("view_id", "left_rgb", "left_depth", "left_mask")


def write_report(
    result: Result,
    archive: str | os.PathLike[str],
    root: str | Path,
    target: Path,
    *,
    views_shown: int = VIEWS_SHOWN,
) -> None:
    """Write the HTML report of ``result``, which came from scoring ``archive`` on ``root``.

    Of each config up to ``views_shown`` views are shown in pictures: the worst by native AbsRel, then evenly down
    to the best. Raises ``InputError`` where ``views_shown`` is negative.
    """
    chosen = {
        config: views_to_show([view for view in result.views if config_of(view.view_id) == config], views_shown)
        for config in result.tables
    }
    folder = open_folder(root)
    with open_submission(archive, folder.expected_views()) as submission:
        page = render_report(result, panels_of(chosen, root, submission))
    write_text(target, page)


def panels_of(
    chosen: Mapping[str, list[ViewScore]], root: str | Path, submission: SubmissionReader
) -> Iterator[ViewPanels]:
    """Yield the arrays of the chosen views one view at a time; rows of other views are streamed past undecoded."""
    for config, views in chosen.items():
        scores = {view.view_id: view for view in views}
        if scores:
            for row in load_undecoded(root, config, streaming=True, columns=_COLUMNS):
                if row["view_id"] in scores:
                    yield _panels(scores[row["view_id"]], decode_row(row), submission)


def _panels(score: ViewScore, row: Mapping[str, Any], submission: SubmissionReader) -> ViewPanels:
    return ViewPanels(
        view_id=score.view_id,
        rgb=row["left_rgb"],
        truth_m=row["left_depth"],
        prediction_m=submission.read(score.view_id),
        steel=row["left_mask"],
        score=score,
    )
