"""Pictures to what a depth network takes, and what it puts out back to the left grid. Needs torch.

The networks' own pre-processing runs where ``transformers`` has it without torchvision; Depth Pro's is done here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError

if TYPE_CHECKING:
    from torch import Tensor

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
