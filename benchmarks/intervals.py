"""Simulation of the 95 % intervals: how often they contain the true mean, by the number of blocks of views.

python -m benchmarks.intervals

Each number is the share of 10,000 simulated configs whose interval contains the true mean, per cent. Independent
values have one view in each block: normal, skewed (exponential), or bounded (the share of 40 pixels, each hit with
a probability of 0.05). Autocorrelated values have twelve views in each block: normal, with the correlation r^k of
views that are k apart. A survey has independent normal values at four distances, whose means are 3 standard
deviations apart, and one view in each block. "Plain" intervals are the percentiles 2.5 and 97.5 of the same draws.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.timing import print_markdown
from rebar_depth_bench.scoring.bootstrap import (
    BLOCK_VIEWS,
    CONFIDENCE_LEVEL,
    end_percents,
    resample,
    resample_survey,
)

BLOCKS = (8, 10, 24, 30, 60, 100)
CONFIGS, CHUNK = 10_000, 1_000
DISTANCES, STEP = 4, 3.0
PLAIN_PERCENTS = (50 * (1 - CONFIDENCE_LEVEL), 50 * (1 + CONFIDENCE_LEVEL))

Sampler = Callable[[np.random.Generator, int], np.ndarray]
"""Returns values of a number of views of ``CHUNK`` configs, one column for each, whose true mean is 0."""


def normal(rng: np.random.Generator, views: int) -> np.ndarray:
    return rng.normal(size=(views, CHUNK))


def skewed(rng: np.random.Generator, views: int) -> np.ndarray:
    return rng.exponential(size=(views, CHUNK)) - 1


def bounded(rng: np.random.Generator, views: int) -> np.ndarray:
    return rng.binomial(40, 0.05, size=(views, CHUNK)) / 40 - 0.05


def autocorrelated(correlation: float) -> Sampler:
    def sample(rng: np.random.Generator, views: int) -> np.ndarray:
        values = normal(rng, views)
        for view in range(1, views):
            values[view] *= np.sqrt(1 - correlation**2)
            values[view] += correlation * values[view - 1]
        return values

    return sample


def survey(rng: np.random.Generator, views: int) -> np.ndarray:
    means = STEP * (np.arange(views) // -(-views // DISTANCES))
    return np.asarray(normal(rng, views) + (means - means.mean())[:, None])


SAMPLERS: dict[str, tuple[Sampler, int, bool]] = {
    "normal, plain": (normal, 1, False),
    "normal": (normal, 1, True),
    "skewed": (skewed, 1, True),
    "bounded": (bounded, 1, True),
    "autocorrelated, r = 0.5": (autocorrelated(0.5), BLOCK_VIEWS, True),
    "autocorrelated, r = 0.8": (autocorrelated(0.8), BLOCK_VIEWS, True),
    "survey": (survey, 1, True),
}
"""Sampler, views of a block, and whether the percentiles are expanded, by heading."""


def share_containing(sampler: Sampler, blocks: int, block_views: int, *, expanded: bool) -> str:
    """Return the share of the simulated configs whose interval contains the true mean, per cent."""
    views = blocks * block_views
    if sampler is survey:
        resampling = resample_survey(range(views), -(-views // DISTANCES))
    else:
        resampling = resample(range(0, views * BLOCK_VIEWS // block_views, BLOCK_VIEWS // block_views))
    found = resampling.blocks()
    assert found.number == blocks
    if not found.are_enough:
        return "–"
    percents = end_percents(found) if expanded else PLAIN_PERCENTS
    rng, containing = np.random.default_rng(0), 0
    for _ in range(CONFIGS // CHUNK):
        low, high = np.percentile(resampling.means(sampler(rng, views)), percents, axis=0)
        containing += np.count_nonzero((low <= 0) & (high >= 0))
    return f"{100 * containing / CONFIGS:.1f}"


def main() -> None:
    rows = [
        (
            blocks,
            *(
                share_containing(sampler, blocks, block_views, expanded=expanded)
                for sampler, block_views, expanded in SAMPLERS.values()
            ),
        )
        for blocks in BLOCKS
    ]
    print_markdown(["blocks", *SAMPLERS], rows)


if __name__ == "__main__":
    main()
