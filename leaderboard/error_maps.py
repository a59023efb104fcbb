"""Error maps of the worst views, as the command line's report draws them.

Whoever knows a prediction and its error knows the truth: error maps are for boards whose truth is no secret.
"""

from __future__ import annotations

from collections.abc import Iterator

from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.report.from_archive import panels_of
from rebar_depth_bench.report.panels import error_webp
from rebar_depth_bench.result import Result, badness
from rebar_depth_bench.submission import config_of, open_submission


def draw(archive: str, data: str, result: Result, count: int) -> Iterator[tuple[str, bytes]]:
    """Yield the native error maps, WebP, of the ``count`` worst views of each config by view id."""
    worst = {
        config: sorted(
            (view for view in result.views if config_of(view.view_id) == config), key=badness, reverse=True
        )[:count]
        for config in result.tables
    }
    with open_submission(archive, open_folder(data).expected_views()) as submission:
        for panels in panels_of(worst, data, submission):
            yield panels.view_id, error_webp(panels)
