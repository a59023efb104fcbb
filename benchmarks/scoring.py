"""How fast stored float32 .npy views are scored once the ground truth is cached, on one core.

python -m benchmarks.scoring ROOT [CONFIG]

The plain evaluator is the usual full-frame NumPy code: decode everything, index with a mask, average.
"""

from __future__ import annotations

import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

import rebar_depth_bench as rdb
from benchmarks.timing import machine, median_seconds, print_markdown
from rebar_depth_bench.folder import open_folder
from rebar_depth_bench.ground_truth import config_truth
from rebar_depth_bench.protocol import interior
from rebar_depth_bench.scoring import score_view
from rebar_depth_bench.submission import open_submission

REPEATS = 15


def plain_scores(archive: Path, truths: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[list[float]]:
    scores = []
    with zipfile.ZipFile(archive) as source:
        for view_id, (truth_m, mask) in truths.items():
            with source.open(f"{view_id}.npy") as entry:
                prediction_m = np.load(entry)
            valid = interior(mask) & (truth_m > 0) & np.isfinite(prediction_m) & (prediction_m > 0)
            z, p = truth_m[valid].astype(float), prediction_m[valid].astype(float)
            scale = np.median(z) / np.median(p)
            scores.append([number for q in (p, scale * p) for number in plain_metrics(q, z)])
    return scores


def plain_metrics(p: np.ndarray, z: np.ndarray) -> list[float]:
    error = np.abs(p - z)
    inliers = np.maximum(p / z, z / p) < 1.25
    return [
        float(np.mean(error / z)),
        float(np.sqrt(np.mean(error**2))),
        float(error.mean()),
        float(inliers.mean()),
    ]


def main(root: str, config: str = "lattice") -> None:
    folder = open_folder(root)
    rows = list(rdb.load(root, config, columns=["view_id", "left_depth", "left_mask"]))
    truths = {row["view_id"]: (row["left_depth"], row["left_mask"]) for row in rows}
    print(f"{len(rows)} views, medians of {REPEATS}, one thread; {machine()}\n")
    with tempfile.TemporaryDirectory() as scratch:
        archive = Path(scratch) / "submission.zip"
        with rdb.SubmissionWriter(archive, method="benchmark") as writer:
            for view_id, (truth_m, _) in truths.items():
                writer.add(view_id, 1.1 * truth_m + np.float32(0.01))
        scored = list(config_truth(folder, config))
        with open_submission(archive, folder.expected_views()) as submission:
            read_s = median_seconds(lambda: [submission.read(one.view_id) for one in scored], REPEATS)
            ours_s = median_seconds(
                lambda: [score_view(one, submission.read(one.view_id)) for one in scored], REPEATS
            )
        plain_s = median_seconds(lambda: plain_scores(archive, truths), REPEATS)
    table = [
        (name, f"{1e3 * seconds / len(rows):.2f}", f"{len(rows) / seconds:.0f}", f"{plain_s / seconds:.1f}")
        for name, seconds in (
            ("read and checksum alone", read_s),
            ("rebar-bench", ours_s),
            ("plain NumPy", plain_s),
        )
    ]
    print_markdown(["", "ms a view", "views per second", "times plain"], table)


if __name__ == "__main__":
    main(*sys.argv[1:])
