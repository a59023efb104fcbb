"""What a depth checkpoint of ``transformers`` puts out, told by its ``config.json``, and how that becomes metres.

Nothing here needs torch. Read off the models' own code in ``transformers`` 5.23.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy import ndarray

from rebar_depth_bench.errors import MethodError

INVERSE_DEPTH_BOUNDS_PER_M = (1e-4, 1e4)
"""Depth Pro holds its answer between a tenth of a millimetre and ten kilometres."""


class Output(Enum):
    """What the numbers of a model mean; the value is what people are told."""

    METRES = "depth in metres, the camera's focal length not given"
    INVERSE = (
        "up to scale, and up to a shift of the inverse: the model puts out relative inverse depth, one over it is "
        "submitted, and only the scaled numbers mean anything"
    )
    CANONICAL = "depth in metres, the camera's focal length given"


@dataclass(frozen=True)
class Family:
    """A model type: its name for people, and what the output of a checkpoint with this config means."""

    name: str
    output: Callable[[Mapping[str, Any]], Output]


def _depth_anything(config: Mapping[str, Any]) -> Output:
    return Output.METRES if config.get("depth_estimation_type", "relative") == "metric" else Output.INVERSE


def _dpt(config: Mapping[str, Any]) -> Output:
    """MiDaS checkpoints are relative; those on DINOv2 are its authors' metric heads for NYU and KITTI."""
    backbone = config.get("backbone_config") or {}
    return Output.METRES if backbone.get("model_type") == "dinov2" else Output.INVERSE


FAMILIES: Mapping[str, Family] = {
    "depth_anything": Family("Depth Anything", _depth_anything),
    "depth_pro": Family("Depth Pro", lambda _: Output.CANONICAL),
    "dpt": Family("DPT", _dpt),
    "glpn": Family("GLPN", lambda _: Output.METRES),
    "zoedepth": Family("ZoeDepth", lambda _: Output.METRES),
}
"""By ``model_type``."""

_REFUSED: Mapping[str, str] = {
    "chmv2": "it estimates the height of trees, not depth",
    "prompt_depth_anything": "it completes measured depth, which a single picture does not bring",
}


def family_of(config: Mapping[str, Any], where: str) -> Family:
    """Return the family of a checkpoint's ``config.json``; ``where`` names it in the error.

    Raises ``MethodError`` for one that is not known here.
    """
    kind = config.get("model_type")
    if isinstance(kind, str) and kind in FAMILIES:
        return FAMILIES[kind]
    why = f" ({_REFUSED[kind]})" if isinstance(kind, str) and kind in _REFUSED else ""
    raise MethodError(f"{where}: model_type is {kind!r}{why}, expected one of {', '.join(FAMILIES)}")


def depth_m(
    output: Output, values: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"] | None = None
) -> Float32[ndarray, "h w"]:
    """Return planar depth, metres (of relative output: in an unknown unit), NaN where there is no answer.

    ``values`` are the model's on the left grid, ``K`` that grid's intrinsics, pixels, for Depth Pro alone.
    A value that is not finite or <= 0 is no answer.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if output is Output.CANONICAL:
            assert K is not None
            found = canonical_to_depth_m(values, K)
        else:
            found = (1 / values if output is Output.INVERSE else values).astype(np.float32)
    return np.where(np.isfinite(found) & (found > 0), found, np.float32(np.nan))


def canonical_to_depth_m(canonical: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"]) -> Float32[ndarray, "h w"]:
    """Return z = 1 / (canonical * W / fx): inverse depth of a camera whose focal length is one picture width.

    W is the width of the grid that ``K`` belongs to, and of ``canonical``, not that of the squashed picture which
    the network sees. Source: A. Bochkovskii et al., "Depth Pro", ICLR 2025, and the model's post-processing.
    """
    inverse_per_m = canonical.astype(np.float64) * (canonical.shape[1] / K[0, 0])
    return np.asarray(1 / np.clip(inverse_per_m, *INVERSE_DEPTH_BOUNDS_PER_M), np.float32)
