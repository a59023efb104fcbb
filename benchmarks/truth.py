"""What exact depth itself scores in the extended measures: how near to perfect they can come.

python -m benchmarks.truth ROOT [CONFIG ...]

Bars have ribs and flat ends, the fit takes a few dozen points of each: a fitted axis is off by hundredths of a
millimetre where depth is exact.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

import rebar_depth_bench as rdb
from benchmarks.timing import print_markdown
from rebar_depth_bench.extended.evaluation import NATIVE, ONCE, score_extended
from rebar_depth_bench.folder import open_folder

PERFECT = ("boundary_f1", "cloud_f_1mm", "layer_confusion", "full_mask_abs_rel", "shifted_rmse_cm")
BARS = ("bars_found", "pass_gb50204_cover_slab")
SAMPLES = (
    "axis_offset_judged_mm",
    "spacing_judged_mm",
    "layer_judged_mm",
    "cover_judged_mm",
    "diameter_judged_mm",
)


def main(root: str, *configs: str) -> None:
    names = configs or open_folder(root).configs
    with tempfile.TemporaryDirectory() as scratch:
        archive = Path(scratch) / "truth.zip"
        with rdb.SubmissionWriter(archive, method="truth") as writer:
            for config in names:
                for row in rdb.load(root, config, columns=["view_id", "left_depth"]):
                    writer.add(row["view_id"], row["left_depth"])
        extended = score_extended(rdb.score(archive, root), archive, root)
    numbers = {name: {**table.numbers[ONCE], **table.numbers[NATIVE]} for name, table in extended.tables.items()}
    print_markdown(
        ["config", "views", *PERFECT, *BARS],
        [
            (name, extended.tables[name].views, *(f"{of[one].value:g}" for one in (*PERFECT, *BARS)))
            for name, of in numbers.items()
        ],
    )
    print("\nmm, over all bars or pairs judged: median / 95th percentile / largest, and how many\n")
    rows = []
    for name in extended.tables:
        views = [view.samples[NATIVE] for view in extended.views if view.view_id.startswith(f"{name}/")]
        pooled = [np.concatenate([view[one] for view in views]) for one in SAMPLES]
        rows.append((name, *map(_spread, pooled)))
    print_markdown(["config", *SAMPLES], rows)


def _spread(values: np.ndarray) -> str:
    if not len(values):
        return "none"
    median, p95 = np.percentile(values, [50, 95])
    return f"{median:.3f} / {p95:.3f} / {values.max():.3f} ({len(values)})"


if __name__ == "__main__":
    main(*sys.argv[1:])
