"""Simulation of working ranges: how often a bin is called met, by its true share, views and their correlation.

python -m benchmarks.working_ranges

Each number is the share of 10,000 simulated bins that are called met, per cent. Each view has 4, 10, 25 or 60
samples, and passes each of them with a probability of its own, drawn from a beta distribution whose mean is the
true share, 90 or 99 %. Its other parameter follows from the correlation of two samples of one view.

python -m benchmarks.working_ranges ARCHIVE ROOT

The correlation that an archive has in each task and each bin with enough samples of enough views of which 5 to
95 % pass (from the analysis of variance between and within views).
"""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.timing import print_markdown
from rebar_depth_bench.extended.tasks import task_samples
from rebar_depth_bench.extended.working_range import MIN_SAMPLES, MIN_VIEWS, bin_positions, share_interval, verdict
from rebar_depth_bench.scorer import score

BINS = 10_000
VIEWS, SAMPLES, CORRELATIONS = (10, 20, 40), (4, 10, 25, 60), (0.0, 0.1, 0.2, 0.3, 0.5)


def share_met(rng: np.random.Generator, views: int, samples: int, correlation: float, share: float) -> float:
    """Return the share of the simulated bins that are called met."""
    view = np.repeat(np.arange(views), samples)
    met = 0
    for _ in range(BINS):
        probability = np.full(views, share)
        if correlation:
            total = 1 / correlation - 1
            probability = rng.beta(share * total, (1 - share) * total, views)
        passes = rng.random(len(view)) < probability[view]
        met += verdict(float(passes.mean()), share_interval(passes, view)[0]) == "met"
    return met / BINS


def view_correlation(passes: np.ndarray, view: np.ndarray) -> float:
    """Return the correlation of two samples of one view (Donner and Koval, Biometrics 36, 1980)."""
    _, position, counts = np.unique(view, return_inverse=True, return_counts=True)
    n, k = len(passes), len(counts)
    means = np.bincount(position, passes) / counts
    between = (counts * (means - passes.mean()) ** 2).sum() / (k - 1)
    within = ((passes - means[position]) ** 2).sum() / (n - k)
    size = (n - (counts**2).sum() / n) / (k - 1)
    return float((between - within) / (between + (size - 1) * within))


def print_correlations(archive: str, root: str) -> None:
    """Print the correlation within views of each task and bin of an archive."""
    extended = score(archive, root, extended=True).extended
    assert extended is not None
    rows = []
    for config, frames in extended.frames.items():
        for task, samples in task_samples(frames.native).items():
            for from_m, to_m, inside in bin_positions(samples.distance_m):
                passes, view = np.abs(samples.error_mm[inside]) <= samples.limit_mm, samples.view[inside]
                views = len(np.unique(view))
                if len(passes) >= MIN_SAMPLES and views >= MIN_VIEWS and 0.05 <= passes.mean() <= 0.95:
                    correlation = view_correlation(passes.astype(np.float64), view)
                    numbers = (len(passes), views, f"{100 * passes.mean():.1f}", f"{correlation:.2f}")
                    rows.append((config, task, f"{from_m:g}-{to_m:g}", *numbers))
    print_markdown(["config", "task", "m", "samples", "views", "pass, %", "correlation"], rows)


def main() -> None:
    if sys.argv[1:]:
        print_correlations(*sys.argv[1:])
        return
    rng = np.random.default_rng(0)
    for share in (0.9, 0.99):
        rows = [
            (views, samples, *(f"{100 * share_met(rng, views, samples, one, share):.1f}" for one in CORRELATIONS))
            for views in VIEWS
            for samples in SAMPLES
        ]
        print(f"\nTrue share {share:.0%}:\n")
        print_markdown(["views", "samples per view", *(f"correlation {one:g}" for one in CORRELATIONS)], rows)


if __name__ == "__main__":
    main()
