"""Example results, for tables, reports and the leaderboard: scores of views in the scorer's tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.reporting.html.views import ShownView, ViewPanels, shown_view
from rebar_depth_bench.scoring.columns import METRICS, SCALED_CONSTANT
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.table import Frame, PublishedMatch, Table, Truth, ViewScore, tabulate
from rebar_depth_bench.submission.declaration import METRIC, NOT_DECLARED, Declaration

DECLARED = Declaration("rgb+K", uses_ground_truth=False)
REFERENCE = {
    "reference.constant.abs_rel": 0.0571,
    "reference.constant.rmse_cm": 2.21,
    "reference.one_pixel.abs_rel": 0.0062,
    "reference.one_pixel.rmse_cm": 0.71,
}
NEAR_REFERENCE = dict(zip(REFERENCE, (0.2222, 7.89, 0.0333, 4.56), strict=True))

HOSTILE = '=<script src="//evil.example/x.js">alert(1)</script>[red]\x1b[31m\u202e&amp;'


def scored_view(view_id: str, abs_rel: float = 0.75, coverage: float = 1.0, scale: float = 0.625) -> ViewScore:
    """Return a view score with the given native AbsRel and a distinct value at every other place.

    The rank error grows with the AbsRel: its valid pixels are all predicted too far.
    """
    numbers = {
        "scored_px": 43210,
        "coverage": coverage,
        "rank_error": 1 - coverage / (1 + abs_rel),
        "scale": scale,
        "native.abs_rel": abs_rel,
        "native.rmse_cm": 20.09,
        "native.mae_cm": 18.71,
        "native.delta1": 0.1234,
        "scaled.abs_rel": 0.0613,
        "scaled.rmse_cm": 1.52,
        "scaled.mae_cm": 1.17,
        "scaled.delta1": 0.9876,
        "within_mm.3": 0.0123,
        "within_mm.5": 0.0456,
        "within_mm.10": 0.0789,
        "within_mm.20": 0.1357,
        "reference.scaled_constant.abs_rel": 0.0571 if coverage == 1 else 0.0529,
        "reference.scaled_constant.rmse_cm": 2.21 if coverage == 1 else 2.05,
    }
    return ViewScore(view_id, numbers)


def changed(view: ViewScore, numbers: Mapping[str, float]) -> ViewScore:
    """Return a view score with other numbers at some places."""
    return replace(view, numbers={**view.numbers, **numbers})


def unpredicted_view(view_id: str) -> ViewScore:
    """Return the score of a view without any prediction."""
    within = dict.fromkeys((f"within_mm.{limit}" for limit in (3, 5, 10, 20)), 0.0)
    return ViewScore(view_id, {"scored_px": 777, "coverage": 0.0, "rank_error": 1.0, **within})


def overflowed_view(view_id: str) -> ViewScore:
    """Return the score of a view whose squared native error overflows to infinity."""
    native = dict(zip(METRICS, (1e200, math.inf, 1e202, 0.0), strict=True))
    errors = {f"native.{name}": value for name, value in native.items()}
    unknown = dict.fromkeys((column.place for column in SCALED_CONSTANT), math.nan)
    return changed(scored_view(view_id), {"scored_px": 5, "rank_error": 1.0, "scale": 1e-200, **errors, **unknown})


def frame_of(views: Sequence[ViewScore], reference: Mapping[str, float] = REFERENCE) -> Frame:
    """Return the frame of views that all have the reference errors ``reference``."""
    return Frame.of_rows({view.view_id: {**view.numbers, **reference} for view in views})


def table_of(
    views: Sequence[ViewScore],
    declared: Declaration = NOT_DECLARED,
    reference: Mapping[str, float] = REFERENCE,
    kind: str = METRIC,
    **of_config: Any,
) -> Table:
    """Return the table of views without groups; ``of_config`` are fields of ``Truth``."""
    frame = frame_of(views, reference)
    truth = Truth(frame.view_ids, views=(), references=(), **of_config)
    return replace(tabulate(frame, truth, kind, declared), groups={})


def result(
    *views: ViewScore,
    method: str = "my model",
    declared: Declaration = DECLARED,
    reference: Mapping[str, float] = REFERENCE,
) -> Result:
    """Return the result of ``views`` with one table per config, in order of appearance."""
    by_config: dict[str, list[ViewScore]] = {}
    for view in views:
        by_config.setdefault(config_of(view.view_id), []).append(view)
    published = {
        name: PublishedMatch(name, same_optics=True) if name in ("lattice", "pile", "pier") else None
        for name in by_config
    }
    return Result(
        dataset=DatasetIdentity("sha256:" + "fedcba9876543210" * 4, "1.2.3"),
        submission=SubmissionIdentity(method, "0123456789abcdef" * 4, declared.inputs, declared.uses_ground_truth),
        software=SoftwareIdentity("0.1.0"),
        tables={
            name: table_of(some, declared, reference, published=published[name])
            for name, some in by_config.items()
        },
        frames={name: frame_of(some, reference) for name, some in by_config.items()},
    )


def split_result(group: str = "wall", grouping: str = "family", scenes: int = 8) -> Result:
    """Return a result of the split ``test`` of ``cages`` in groups; its last scene is in one of its own."""
    views = [scored_view(f"cages/test-s{scene}-0000", 0.1 + 0.01 * scene) for scene in range(scenes)]
    last = unpredicted_view(f"cages/test-s{scenes}-0000")
    table = table_of([*views, last], split="test")
    groups = {
        grouping: {
            group: table_of(views, reference=NEAR_REFERENCE, split="test"),
            "slab": table_of([last], split="test"),
        },
        "distance": {"0.5-1 m": table},
    }
    whole = result(*views, last, declared=DECLARED)
    return replace(whole, tables={"cages": replace(table, groups=groups)})


def joined(*results: Result) -> Result:
    """Return the first result with the configs of all."""
    tables = {name: table for one in results for name, table in one.tables.items()}
    frames = {name: frame for one in results for name, frame in one.frames.items()}
    return replace(results[0], tables=tables, frames=frames)


def example() -> Result:
    """Return the result of the golden texts: configs with intervals, gaps, overflow and groups."""
    lattice = [scored_view(f"lattice/{12 * index:04d}", 0.0215 + 0.003 * index) for index in range(8)]
    gaps = [scored_view("lattice-raw/0000", coverage=0.94996), unpredicted_view("lattice-raw/0001")]
    return joined(result(*lattice, *gaps, overflowed_view("pier/0000")), split_result())


def examples() -> list[Result]:
    """Return the example and results that are compared with it: a better one, and ones not declared alike."""
    lattice = [scored_view(f"lattice/{12 * index:04d}", 0.02, 0.99) for index in range(8)]
    truth = Declaration("rgb", uses_ground_truth=True)
    return [
        example(),
        result(*lattice, scored_view("pier/0000"), method="a_b"),
        result(*lattice, method="oracle", declared=truth),
        result(*lattice, method="unknown", declared=NOT_DECLARED),
    ]


def panels(view_id: str = "lattice/0000", score: ViewScore | None = None, factor: float = 1.6) -> ViewPanels:
    """Return a 40 x 60 view: a bar at 0.5 m in front of a wall at 1 m, predicted ``factor`` times too far."""
    truth = np.ones((40, 60), np.float32)
    steel = np.zeros((40, 60), bool)
    steel[:, 20:30] = True
    truth[steel] = 0.5
    rgb = np.full((40, 60, 3), 128, np.uint8)
    scored = scored_pixels(steel, truth)
    return ViewPanels(rgb, truth, truth * np.float32(factor), steel, scored, score or scored_view(view_id))


def shown(view_id: str = "lattice/0000", score: ViewScore | None = None, factor: float = 1.6) -> ShownView:
    """Return the encoded images of ``panels``."""
    return shown_view(panels(view_id, score, factor))
