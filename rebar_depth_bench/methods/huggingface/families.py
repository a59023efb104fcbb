"""What a depth checkpoint of ``transformers`` puts out, told by its ``config.json``, and how that becomes metres.

Nothing here needs torch. Read off the models' own code in ``transformers`` 5.23.

Pictures to what a depth network takes, and what it puts out back to the left grid. Needs torch.

The networks' own pre-processing runs where ``transformers`` has it without torchvision; Depth Pro's is done here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError

if TYPE_CHECKING:
    from torch import Tensor

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


ZOE_PADDING_FACTOR = 3
"""ZoeDepth mirrors int(3 sqrt(side / 2)) pixels onto each border."""


@dataclass(frozen=True)
class Preparation:
    """``pixels``: H x W x 3 uint8 to 1 x 3 x h x w; ``on_left_grid``: the output, and (H, W), to H x W."""

    pixels: Callable[[UInt8[ndarray, "H W 3"]], Float[Tensor, "1 3 h w"]]
    on_left_grid: Callable[[Float[Tensor, "h w"], tuple[int, int]], Float[Tensor, "H W"]]


def resized(values: Float[Tensor, "h w"], grid: tuple[int, int], mode: str) -> Float[Tensor, "H W"]:
    """Return values on another grid of the same view, corners of pixels aligned; ``mode`` is torch's."""
    from torch.nn import functional

    return functional.interpolate(values[None, None], size=grid, mode=mode, align_corners=False)[0, 0]


def depth_pro(settings: Mapping[str, Any], processor: Any) -> Preparation:
    """Return Depth Pro's: normalised first, then squashed to a square, bilinear both ways as in its own code."""
    del processor
    size, mean, std = settings["size"], settings["image_mean"], settings["image_std"]
    scale = settings.get("rescale_factor", 1 / 255)

    def pixels(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        import torch
        from torch.nn import functional

        normal = (rgb * np.float64(scale) - np.asarray(mean)) / np.asarray(std)
        planes = torch.from_numpy(normal.astype(np.float32).transpose(2, 0, 1).copy())[None]
        target = (size["height"], size["width"])
        return functional.interpolate(planes, size=target, mode="bilinear", align_corners=False)

    return Preparation(pixels, lambda values, grid: resized(values, grid, "bilinear"))


def library(settings: Mapping[str, Any], processor: Any) -> Preparation:
    """Return the processor's own pre-processing; the output is resized bicubic, as its own code does."""
    del settings
    padded = bool(getattr(processor, "do_pad", False))
    if padded and processor.do_resize:
        raise MethodError("preprocessor_config.json: do_resize and do_pad together, expected one of them")

    def on_left_grid(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
        if not padded:
            return resized(values, grid, "bicubic")
        step = processor.size_divisor or 1
        full = tuple(-(-side // step) * step for side in grid)
        return _middle(resized(values, (full[0], full[1]), "bicubic"), grid)

    return Preparation(_library_pixels(processor), on_left_grid)


def zoedepth(settings: Mapping[str, Any], processor: Any) -> Preparation:
    """Return ZoeDepth's: its processor mirrors the borders outward, which are cut off the resized output again."""
    del settings

    def on_left_grid(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
        border = [int(ZOE_PADDING_FACTOR * np.sqrt(side / 2)) if processor.do_pad else 0 for side in grid]
        full = (grid[0] + 2 * border[0], grid[1] + 2 * border[1])
        return _middle(resized(values, full, "bicubic"), grid)

    return Preparation(_library_pixels(processor), on_left_grid)


PREPARATIONS: Mapping[str, Callable[[Mapping[str, Any], Any], Preparation]] = {
    "depth_anything": library,
    "depth_pro": depth_pro,
    "dpt": library,
    "glpn": library,
    "zoedepth": zoedepth,
}
"""By ``model_type``: from ``preprocessor_config.json`` and the library's processor (none for Depth Pro)."""


def _library_pixels(processor: Any) -> Callable[[UInt8[ndarray, "H W 3"]], Float[Tensor, "1 3 h w"]]:
    def pixels(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        tensor: Tensor = processor(images=rgb, return_tensors="pt", input_data_format="channels_last")[
            "pixel_values"
        ]
        return tensor.float()

    return pixels


def _middle(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
    top, left = ((full - side) // 2 for full, side in zip(values.shape, grid, strict=True))
    return values[top : top + grid[0], left : left + grid[1]]
