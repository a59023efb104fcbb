"""Extended measures of the ground-truth depth itself: the best values that a prediction can reach.

python -m benchmarks.truth ROOT [CONFIG ...]

Bars have ribs and flat ends, and the axis fit uses a few dozen points of each bar. Even with exact depth, fitted
axes therefore deviate by hundredths of a millimetre.
"""

from __future__ import annotations

import sys

import numpy as np

import rebar_depth_bench as rdb
from benchmarks.timing import print_markdown
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.estimates import tabulate_extended
from rebar_depth_bench.extended.families import measures_by_alignment, view_samples
from rebar_depth_bench.extended.frames import steel_frames
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.measures import NATIVE, ONCE, pooled
from rebar_depth_bench.scoring.bootstrap import resample

COLUMNS = ["view_id", "left_depth"]
SCORES = ("boundary_f1", "cloud_f_5mm", "bars_found", "crossings_located")
ERROR_SAMPLES = (
    "axis_offset_judged_mm",
    "spacing_judged_mm",
    "cover_judged_mm",
    "diameter_judged_mm",
    "tie_judged_mm",
    "layer_judged_mm",
    "crossing_angle_judged_deg",
)


def main(root: str, *configs: str) -> None:
    folder = open_folder(root)
    measures = measures_by_alignment()
    score_rows, error_rows = [], []
    for config in configs or folder.configs:
        steel = load_steel_truth(folder, folder.config(config))
        depth_m = {row["view_id"]: row["left_depth"] for row in rdb.load(root, config, columns=COLUMNS)}
        truths = [steel.view(index) for index in range(len(steel))]
        views = []
        for position, truth in enumerate(truths):
            frames = steel_frames(depth_m[truth.view_id], truth, position)
            views.append(view_samples(depth_m[truth.view_id], truth, 1.0, frames))
        table = tabulate_extended(views, resample(range(len(views))), measures)
        numbers = {**table.numbers[ONCE], **table.numbers[NATIVE]}
        score_rows.append((config, len(views), *(_value(numbers[name].value) for name in SCORES)))
        samples = [pooled([view[NATIVE] for view in views], name)[0] for name in ERROR_SAMPLES]
        error_rows.append((config, *map(_spread, samples)))
    print_markdown(["config", "views", *SCORES], score_rows)
    print("\nmm or degrees, over everything judged: median / 95th percentile / largest (how many)\n")
    print_markdown(["config", *ERROR_SAMPLES], error_rows)


def _value(value: float | None) -> str:
    return "none" if value is None else f"{value:g}"


def _spread(values: np.ndarray) -> str:
    if not len(values):
        return "none"
    median, p95 = np.percentile(values, [50, 95])
    return f"{median:.3f} / {p95:.3f} / {values.max():.3f} ({len(values)})"


if __name__ == "__main__":
    main(*sys.argv[1:])
