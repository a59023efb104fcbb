"""Example results, for tables, reports and the leaderboard: scores of views in the scorer's tables."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rebar_depth_bench.reporting.html.views import ShownView, ViewPanels, shown_view
from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.reference import Errors, Reference
from rebar_depth_bench.scoring.result import DatasetIdentity, Result, SoftwareIdentity, SubmissionIdentity
from rebar_depth_bench.scoring.table import tabulate
from rebar_depth_bench.scoring.table import PublishedMatch, ViewScore
from rebar_depth_bench.submission.declaration import NOT_DECLARED, Declaration

DECLARED = Declaration("rgb+K", uses_ground_truth=False)
REFERENCE = Reference(Errors(0.0571, 2.21), Errors(0.0062, 0.71))
NEAR_REFERENCE = Reference(Errors(0.2222, 7.89), Errors(0.0333, 4.56))

HOSTILE = '=<script src="//evil.example/x.js">alert(1)</script>[red]\x1b[31m\u202e&amp;'


def scored_view(view_id: str, abs_rel: float = 0.75, coverage: float = 1.0, scale: float = 0.625) -> ViewScore:
    """Return a view score with the given native AbsRel and a distinct value in every other field.

    The rank error grows with the AbsRel: its valid pixels are all predicted too far.
    """
    return ViewScore(
        view_id=view_id,
        scored_px=43210,
        coverage=coverage,
        rank_error=1 - coverage / (1 + abs_rel),
        scale=scale,
        native=DepthMetrics(abs_rel=abs_rel, rmse_cm=20.09, mae_cm=18.71, delta1=0.1234),
        scaled=DepthMetrics(abs_rel=0.0613, rmse_cm=1.52, mae_cm=1.17, delta1=0.9876),
        within_mm={3: 0.0123, 5: 0.0456, 10: 0.0789, 20: 0.1357},
        scaled_constant=(0.0571, 2.21) if coverage == 1 else (0.0529, 2.05),
    )


def unpredicted_view(view_id: str) -> ViewScore:
    """Return the score of a view without any prediction."""
    return ViewScore(view_id, 777, 0.0, 1.0, None, None, None, {3: 0.0, 5: 0.0, 10: 0.0, 20: 0.0})


def overflowed_view(view_id: str) -> ViewScore:
    """Return the score of a view whose squared native error overflows to infinity."""
    native = DepthMetrics(abs_rel=1e200, rmse_cm=math.inf, mae_cm=1e202, delta1=0.0)
    view = scored_view(view_id)
    return ViewScore(view_id, 5, 1.0, 1.0, 1e-200, native, view.scaled, view.within_mm)


def result(
    *views: ViewScore,
    method: str = "my model",
    declared: Declaration = DECLARED,
    reference: Reference = REFERENCE,
) -> Result:
    """Return the result of ``views`` with one table per config, in order of appearance."""
    configs = dict.fromkeys(view.view_id.rpartition("/")[0] for view in views)
    tables = {
        name: tabulate(
            [view for view in views if view.view_id.startswith(f"{name}/")],
            declared,
            reference,
            PublishedMatch(name, same_optics=True) if name in ("lattice", "pile", "pier") else None,
        )
        for name in configs
    }
    return Result(
        dataset=DatasetIdentity("sha256:" + "fedcba9876543210" * 4, "1.2.3"),
        submission=SubmissionIdentity(method, "0123456789abcdef" * 4, declared.inputs, declared.uses_ground_truth),
        software=SoftwareIdentity("0.1.0"),
        tables=tables,
        views=list(views),
    )


def split_result(group: str = "wall", grouping: str = "family", scenes: int = 8) -> Result:
    """Return a result of the split ``test`` of ``cages`` in groups; its last scene is in one of its own."""
    views = [scored_view(f"cages/test-s{scene}-0000", 0.1 + 0.01 * scene) for scene in range(scenes)]
    last = unpredicted_view(f"cages/test-s{scenes}-0000")
    table = tabulate([*views, last], reference=REFERENCE, split="test")
    groups = {
        grouping: {
            group: tabulate(views, reference=NEAR_REFERENCE, split="test"),
            "slab": tabulate([last], reference=REFERENCE, split="test"),
        },
        "distance": {"0.5-1 m": tabulate([*views, last], reference=REFERENCE, split="test")},
    }
    return replace(result(), tables={"cages": replace(table, groups=groups)}, views=[*views, last])


def example() -> Result:
    """Return the result of the golden texts: configs with intervals, gaps, overflow and groups."""
    lattice = [scored_view(f"lattice/{12 * index:04d}", 0.0215 + 0.003 * index) for index in range(8)]
    gaps = [scored_view("lattice-raw/0000", coverage=0.94996), unpredicted_view("lattice-raw/0001")]
    of_scenes = result(*lattice, *gaps, overflowed_view("pier/0000"))
    split = split_result()
    return replace(of_scenes, tables={**of_scenes.tables, **split.tables}, views=[*of_scenes.views, *split.views])


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
    return ViewPanels(rgb, truth, truth * np.float32(factor), steel, score or scored_view(view_id))


def shown(view_id: str = "lattice/0000", score: ViewScore | None = None, factor: float = 1.6) -> ShownView:
    """Return the encoded images of ``panels``."""
    return shown_view(panels(view_id, score, factor))
