"""Controls that know the answer: exact depth, and exact depth spoiled by a known factor and noise.

For teaching and for tests: what a perfect submission scores, and what scale and noise of known size do to each
number. They read the ground truth and so are no methods.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.methods.method import Method, MethodInfo

FACTOR = 1.25
NOISE = 0.01


def spoiled(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    """Return ``FACTOR`` times the truth, times 1 + Gaussian noise of standard deviation ``NOISE`` at each pixel.

    The noise depends on the view's id alone. No answer where there is no surface.
    """
    seed = int.from_bytes(hashlib.sha256(row["view_id"].encode()).digest()[:8], "little")
    depth_m = row["left_depth"].astype(np.float64)
    noise = np.random.default_rng(seed).normal(0.0, NOISE, depth_m.shape)
    return np.asarray(FACTOR * depth_m * (1 + noise), np.float32)


def _control(name: str, summary: str) -> MethodInfo:
    return MethodInfo(
        name=name,
        summary=f"control that reads the ground truth: {summary}",
        columns=("left_depth",),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
        reads_truth=True,
    )


TRUTH = Method(_control("truth", "exact depth"), lambda: lambda row: np.asarray(row["left_depth"]))
NOISY_TRUTH = Method(
    _control("noisy-truth", f"{FACTOR:g} times exact depth, with {NOISE:.0%} of noise"), lambda: spoiled
)
