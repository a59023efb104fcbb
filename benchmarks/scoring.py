"""Benchmark of scoring stored float32 .npy views with cached ground truth.

python -m benchmarks.scoring ROOT [CONFIG]

The plain NumPy and torch evaluators, each on one thread, are typical of public evaluation code: decode the whole
view, index it with a mask, average. The last figure is the time of 504 views in the page cache; the views of a
smaller folder are scored repeatedly. The archive's SHA-256, which ``score`` computes in a separate thread, is not
included.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle, islice
from pathlib import Path

import numpy as np
import torch

import rebar_depth_bench as rdb
from benchmarks.timing import machine_description, median_seconds, print_markdown
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.extended.families import view_samples
from rebar_depth_bench.extended.frames import steel_frames
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.scoring.protocol import interior
from rebar_depth_bench.scoring.truth import config_truth
from rebar_depth_bench.scoring.view_numbers import view_numbers
from rebar_depth_bench.submission import SubmissionReader

REPEATS = 15
FULL_CONFIG = 504

Truths = dict[str, tuple[np.ndarray, np.ndarray]]


def plain_scores(archive: Path, truths: Truths, metrics: Callable[[np.ndarray, np.ndarray], list[float]]) -> list:
    scores = []
    with zipfile.ZipFile(archive) as source:
        for view_id, (truth_m, mask) in truths.items():
            with source.open(f"{view_id}.npy") as entry:
                prediction_m = np.load(entry)
            valid = interior(mask) & (truth_m > 0) & np.isfinite(prediction_m) & (prediction_m > 0)
            scores.append(metrics(truth_m[valid], prediction_m[valid]))
    return scores


def numpy_metrics(truth_m: np.ndarray, prediction_m: np.ndarray) -> list[float]:
    z, p = truth_m.astype(float), prediction_m.astype(float)
    scale = np.median(z) / np.median(p)
    return [number for q in (p, scale * p) for number in _numpy_numbers(q, z)]


def _numpy_numbers(p: np.ndarray, z: np.ndarray) -> list[float]:
    error = np.abs(p - z)
    inliers = np.maximum(p / z, z / p) < 1.25
    return [
        float(np.mean(error / z)),
        float(np.sqrt(np.mean(error**2))),
        float(error.mean()),
        float(inliers.mean()),
    ]


def torch_metrics(truth_m: np.ndarray, prediction_m: np.ndarray) -> list[float]:
    z, p = torch.from_numpy(truth_m).double(), torch.from_numpy(prediction_m).double()
    scale = torch.median(z) / torch.median(p)
    return [number for q in (p, scale * p) for number in _torch_numbers(q, z)]


def _torch_numbers(p: torch.Tensor, z: torch.Tensor) -> list[float]:
    error = (p - z).abs()
    inliers = torch.maximum(p / z, z / p) < 1.25
    numbers = ((error / z).mean(), (error**2).mean().sqrt(), error.mean(), inliers.double().mean())
    return [float(number) for number in numbers]


def extended_rows(root: str, config: str, submission: SubmissionReader) -> list[tuple[str, str]]:
    """Return the milliseconds per view of its truth, the fits of its steel, and all measures."""
    folder = open_folder(root)
    steel = load_steel_truth(folder, folder.config(config))
    views = []
    for index in range(len(steel)):
        truth = steel.view(index)
        views.append((truth, submission.read(truth.view_id).astype(np.float64)))
    gathering_s = median_seconds(lambda: [*map(steel.view, range(len(steel)))], REPEATS)
    fitting_s = median_seconds(lambda: [steel_frames(image_m, truth, 0) for truth, image_m in views], REPEATS)
    frames = [steel_frames(image_m, truth, 0) for truth, image_m in views]
    measured = [(image_m, truth, 1 / 1.1, steel) for (truth, image_m), steel in zip(views, frames, strict=True)]
    measuring_s = median_seconds(lambda: [view_samples(*view) for view in measured], REPEATS)
    rows = {
        "gathering a view's truth": gathering_s,
        "fitting bars and crossings": fitting_s,
        "all measures": measuring_s,
    }
    return [(name, f"{1e3 * value / len(views):.1f}") for name, value in rows.items()]


def peak_megabytes(archive: Path, root: str) -> float:
    """Return the peak memory of a ``rebar-bench score`` process in MB."""
    command = [sys.executable, "-m", "rebar_depth_bench", "score", str(archive), "--data", root]
    subprocess.run(command, check=True, capture_output=True)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024


def main(root: str, config: str = "lattice") -> None:
    torch.set_num_threads(1)
    folder = open_folder(root)
    rows = list(rdb.load(root, config, columns=["view_id", "left_depth", "left_mask"]))
    truths = {row["view_id"]: (row["left_depth"], row["left_mask"]) for row in rows}
    scored = config_truth(folder, folder.config(config))
    pixels = sum(len(truth.index) for truth in scored.views) / len(scored.views)
    print(f"{len(rows)} views, {pixels:.0f} scored pixels each; {machine_description()}\n")
    with tempfile.TemporaryDirectory() as scratch:
        archive = Path(scratch) / "submission.zip"
        with rdb.SubmissionWriter(archive, method="benchmark") as writer:
            for view_id, (truth_m, _) in truths.items():
                writer.add(view_id, 1.1 * truth_m + np.float32(0.01))
        with SubmissionReader(archive, folder.expected_views()) as submission:
            runs: dict[str, Callable[[], object]] = {
                "read and checksum alone": lambda: [submission.read(truth.view_id) for truth in scored.views],
                "rebar-bench": lambda: [
                    view_numbers(submission.read(truth.view_id), truth) for truth in scored.views
                ],
                "plain NumPy": lambda: plain_scores(archive, truths, numpy_metrics),
                "plain torch": lambda: plain_scores(archive, truths, torch_metrics),
            }
            seconds = {name: median_seconds(run, REPEATS) for name, run in runs.items()}
            cores = os.cpu_count() or 1
            with ThreadPoolExecutor(cores) as pool:
                whole_s = median_seconds(
                    lambda: [
                        *pool.map(
                            lambda index: view_numbers(
                                submission.read(scored.view_ids[index]), scored.views[index]
                            ),
                            islice(cycle(range(len(scored.views))), FULL_CONFIG),
                        )
                    ],
                    5,
                )
            extended = extended_rows(root, config, submission)
        table = [
            (
                name,
                f"{1e3 * value / len(rows):.2f}",
                f"{len(rows) / value:.0f}",
                f"{seconds['plain NumPy'] / value:.1f}",
            )
            for name, value in seconds.items()
        ]
        print(f"One thread, medians of {REPEATS}:\n")
        print_markdown(["", "ms a view", "views per second", "times plain NumPy"], table)
        print("\nExtended measures, one thread:\n")
        print_markdown(["", "ms a view"], extended)
        print(f"\n{FULL_CONFIG} views on {cores} threads: {whole_s:.2f} s")
        print(f"Peak memory of rebar-bench score: {peak_megabytes(archive, root):.0f} MB")


if __name__ == "__main__":
    main(*sys.argv[1:])
