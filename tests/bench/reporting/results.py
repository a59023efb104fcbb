"""Results for these tests, made as the scorer makes them: scores of views through ``tabulate``."""

from __future__ import annotations

import math

from rebar_depth_bench.scoring.metrics import DepthMetrics
from rebar_depth_bench.scoring.result import Result, ViewScore, tabulate

HOSTILE = '=<script src="//evil.example/x.js">alert(1)</script>[red]\x1b[31m\u202e&amp;'


def scored(view_id: str, abs_rel: float = 0.75, coverage: float = 1.0, scale: float = 0.625) -> ViewScore:
    """Return a view with the given native AbsRel and numbers that are told apart from each other."""
    return ViewScore(
        view_id=view_id,
        scored_px=43210,
        coverage=coverage,
        scale=scale,
        native=DepthMetrics(abs_rel=abs_rel, rmse_cm=20.09, mae_cm=18.71, delta1=0.1234),
        scaled=DepthMetrics(abs_rel=0.0613, rmse_cm=1.52, mae_cm=1.17, delta1=0.9876),
        within_mm={3: 0.0123, 5: 0.0456, 10: 0.0789, 20: 0.1357},
    )


def unpredicted(view_id: str) -> ViewScore:
    """Return a view without any prediction."""
    return ViewScore(view_id, 777, 0.0, None, None, None, {3: 0.0, 5: 0.0, 10: 0.0, 20: 0.0})


def overflowed(view_id: str) -> ViewScore:
    """Return a view whose prediction was too large to square."""
    native = DepthMetrics(abs_rel=1e200, rmse_cm=math.inf, mae_cm=1e202, delta1=0.0)
    view = scored(view_id)
    return ViewScore(view_id, 5, 1.0, 1e-200, native, view.scaled, view.within_mm)


def result(*views: ViewScore, method: str = "my model") -> Result:
    """Return the result of ``views``, a table per config in the order of appearance."""
    configs = dict.fromkeys(view.view_id.rpartition("/")[0] for view in views)
    tables = {name: tabulate([view for view in views if view.view_id.startswith(f"{name}/")]) for name in configs}
    return Result(
        method=method,
        submission_sha256="0123456789abcdef" * 4,
        dataset_digest="sha256:" + "fedcba9876543210" * 4,
        dataset_version="1.2.3",
        software_version="0.1.0",
        tables=tables,
        views=views,
    )
