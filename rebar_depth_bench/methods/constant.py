"""The control that knows nothing: the same depth everywhere. Whatever scaling it corrects is scale, not shape."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.methods.method import Method, MethodInfo, Predictor

CONSTANT_DEPTH_M = 1.0


def _load() -> Predictor:
    return _predict


def _predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    return np.full(row["left_rgb"].shape[:2], CONSTANT_DEPTH_M, np.float32)


CONSTANT = Method(
    MethodInfo(
        name="constant",
        summary=f"control: {CONSTANT_DEPTH_M:g} m at every pixel",
        columns=("left_rgb",),
        uses_intrinsics=False,
        source="this project",
        licence="Apache-2.0",
    ),
    _load,
)
