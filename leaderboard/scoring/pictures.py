"""Pictures of a submission's worst and median views: colour, ground truth, prediction and native error."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from rebar_depth_bench.reporting.html.page import iter_view_panels, views_by_config
from rebar_depth_bench.reporting.html.view_browser import ShownView, shown_view
from rebar_depth_bench.scoring.evaluation import Evaluation
from rebar_depth_bench.scoring.result import Result
from rebar_depth_bench.scoring.view_score import ViewScore, sort_key_worst_first

PICTURE_KINDS = ("colour", "truth", "prediction", "error")


def views_to_picture(views: Sequence[ViewScore], count: int) -> list[ViewScore]:
    """Return the ``count`` worst of the views by rank error, and the median view, worst first."""
    worst_first = sorted(views, key=sort_key_worst_first, reverse=True)
    median = worst_first[len(worst_first) // 2 : len(worst_first) // 2 + 1]
    return [*worst_first[:count], *(view for view in median if view not in worst_first[:count])]


def write_pictures(evaluation: Evaluation, result: Result, count: int, folder: Path) -> None:
    """Write the pictures of the ``count`` worst views and the median view of each config to ``folder``.

    Each view has a JSON file with its id and the texts of its colour bars, and one WebP file per kind.
    """
    folder.mkdir()
    chosen = {name: views_to_picture(views, count) for name, views in views_by_config(result).items()}
    for number, panels in enumerate(iter_view_panels(chosen, evaluation)):
        shown = shown_view(panels)
        for kind, webp in _encoded_pictures(shown).items():
            (folder / f"{number:04d}-{kind}.webp").write_bytes(webp)
        facts = {
            "view_id": panels.view_id,
            "width": shown.images.width,
            "height": shown.images.height,
            "near": shown.near,
            "far": shown.far,
            "limit": shown.native_limit,
        }
        (folder / f"{number:04d}.json").write_text(json.dumps(facts))


def _encoded_pictures(shown: ShownView) -> dict[str, bytes]:
    images = shown.images
    pictures = zip(
        PICTURE_KINDS, (images.colour, images.truth, images.prediction, images.native_error), strict=True
    )
    return {kind: webp for kind, webp in pictures if webp is not None}
