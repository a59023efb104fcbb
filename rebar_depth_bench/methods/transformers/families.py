"""Model families of ``transformers`` depth checkpoints: output units, pre-processing and post-processing.

The meaning of the output is derived from ``config.json``, following the models' code in ``transformers`` 5.23;
this and the conversion to metres do not need torch.

Pre-processing (image to network input) and post-processing (network output to the left grid) need torch. The
processors of ``transformers`` are used if they work without torchvision; that of Depth Pro is implemented here.
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
from rebar_depth_bench.validation import short_repr

if TYPE_CHECKING:
    from torch import Tensor

INVERSE_DEPTH_BOUNDS_PER_M = (1e-4, 1e4)
"""Bounds of Depth Pro's inverse depth, 1/m: depth between 0.1 mm and 10 km."""


class OutputKind(Enum):
    """Meaning of a network's output; the value is the text shown to users."""

    METRES = "depth in metres, the camera's focal length not given"
    INVERSE = (
        "up to scale, and up to a shift of the inverse: the model puts out relative inverse depth, one over it is "
        "submitted, and only the scaled numbers mean anything"
    )
    CANONICAL = "depth in metres, the camera's focal length given"


@dataclass(frozen=True)
class ModelFamily:
    """Model type: its display name, and a function from a checkpoint's config to the meaning of its output."""

    name: str
    output: Callable[[Mapping[str, Any]], OutputKind]


def _depth_anything(config: Mapping[str, Any]) -> OutputKind:
    """Return the output kind of Depth Anything, which has metric and relative checkpoints."""
    return OutputKind.METRES if config.get("depth_estimation_type", "relative") == "metric" else OutputKind.INVERSE


def _dpt(config: Mapping[str, Any]) -> OutputKind:
    """Return the output kind of DPT: metric for DINOv2 backbones, relative for MiDaS checkpoints.

    Checkpoints on DINOv2 are the metric heads that its authors trained on NYU and KITTI.
    """
    backbone = config.get("backbone_config")
    is_dinov2 = isinstance(backbone, dict) and backbone.get("model_type") == "dinov2"
    return OutputKind.METRES if is_dinov2 else OutputKind.INVERSE


FAMILIES: Mapping[str, ModelFamily] = {
    "depth_anything": ModelFamily("Depth Anything", _depth_anything),
    "depth_pro": ModelFamily("Depth Pro", lambda _: OutputKind.CANONICAL),
    "dpt": ModelFamily("DPT", _dpt),
    "glpn": ModelFamily("GLPN", lambda _: OutputKind.METRES),
    "zoedepth": ModelFamily("ZoeDepth", lambda _: OutputKind.METRES),
}
"""Supported families by ``model_type`` of ``config.json``."""

_UNSUPPORTED: Mapping[str, str] = {
    "chmv2": "it estimates the height of trees, not depth",
    "prompt_depth_anything": "it completes measured depth, which a single image does not have",
}


def family_of(config: Mapping[str, Any], where: str) -> ModelFamily:
    """Return the family of a checkpoint's ``config.json``; ``where`` is the file in the error message.

    Raises ``MethodError`` if the model type is not supported.
    """
    model_type = config.get("model_type")
    if isinstance(model_type, str) and model_type in FAMILIES:
        return FAMILIES[model_type]
    reason = f" ({_UNSUPPORTED[model_type]})" if isinstance(model_type, str) and model_type in _UNSUPPORTED else ""
    raise MethodError(
        f"{where}: model_type is {short_repr(model_type)}{reason}, expected one of {', '.join(FAMILIES)}"
    )


def network_output_to_depth_m(
    output: OutputKind, values: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"] | None = None
) -> Float32[ndarray, "h w"]:
    """Return planar depth in metres; for relative output, its unit is unknown.

    ``values`` is the network output on the left grid; ``K`` holds the intrinsics of that grid in pixels and is
    required for Depth Pro only. Depths that are not finite or not above 0 become NaN, which means no prediction.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if output is OutputKind.CANONICAL:
            assert K is not None
            z_m = canonical_to_depth_m(values, K)
        else:
            z_m = (1 / values if output is OutputKind.INVERSE else values).astype(np.float32)
    return np.where(np.isfinite(z_m) & (z_m > 0), z_m, np.float32(np.nan))


def canonical_to_depth_m(canonical: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"]) -> Float32[ndarray, "h w"]:
    """Return z = 1 / (canonical * W / fx), metres.

    ``canonical`` is the inverse depth of a camera whose focal length equals the image width. W is the width of
    ``canonical`` and of the grid that ``K`` belongs to, not that of the square image which the network receives.
    Source: A. Bochkovskii et al., "Depth Pro", ICLR 2025, and the model's post-processing.
    """
    inverse_per_m = canonical.astype(np.float64) * (canonical.shape[1] / K[0, 0])
    return np.asarray(1 / np.clip(inverse_per_m, *INVERSE_DEPTH_BOUNDS_PER_M), np.float32)


ZOE_PADDING_FACTOR = 3
"""ZoeDepth pads each border by int(3 sqrt(side / 2)) mirrored pixels."""


@dataclass(frozen=True)
class ImageProcessing:
    """Pre- and post-processing of a network.

    ``to_network_input`` maps an H x W x 3 uint8 image to a 1 x 3 x h x w tensor; ``to_left_grid`` maps the
    network output and (H, W) to an H x W tensor.
    """

    to_network_input: Callable[[UInt8[ndarray, "H W 3"]], Float[Tensor, "1 3 h w"]]
    to_left_grid: Callable[[Float[Tensor, "h w"], tuple[int, int]], Float[Tensor, "H W"]]


def resized(values: Float[Tensor, "h w"], grid: tuple[int, int], mode: str) -> Float[Tensor, "H W"]:
    """Return values resampled to another grid over the same field of view (``align_corners=False``).

    ``mode`` is the interpolation mode of torch.
    """
    from torch.nn import functional

    return functional.interpolate(values[None, None], size=grid, mode=mode, align_corners=False)[0, 0]


def depth_pro_processing(settings: Mapping[str, Any], processor: Any) -> ImageProcessing:
    """Return Depth Pro's processing: normalise, then resize to a square.

    Input and output are resized bilinearly, as in the authors' code.
    """
    del processor
    size, mean, std = settings["size"], settings["image_mean"], settings["image_std"]
    scale = settings.get("rescale_factor", 1 / 255)

    def to_network_input(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        import torch
        from torch.nn import functional

        normal = (rgb * np.float64(scale) - np.asarray(mean)) / np.asarray(std)
        planes = torch.from_numpy(normal.astype(np.float32).transpose(2, 0, 1).copy())[None]
        target = (size["height"], size["width"])
        return functional.interpolate(planes, size=target, mode="bilinear", align_corners=False)

    return ImageProcessing(to_network_input, lambda values, grid: resized(values, grid, "bilinear"))


def library_processing(settings: Mapping[str, Any], processor: Any) -> ImageProcessing:
    """Return the library processor's pre-processing, with bicubic resizing of the output as in its own code.

    If the processor pads to multiples of a step (``size_divisor``), the padding is cropped after resizing. Raises
    ``MethodError`` if it both resizes and pads.
    """
    del settings
    padded = bool(getattr(processor, "do_pad", False))
    if padded and processor.do_resize:
        raise MethodError("preprocessor_config.json: do_resize and do_pad together, expected one of them")

    def to_left_grid(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
        if not padded:
            return resized(values, grid, "bicubic")
        step = processor.size_divisor or 1
        full = tuple(-(-side // step) * step for side in grid)
        return _centre_crop(resized(values, (full[0], full[1]), "bicubic"), grid)

    return ImageProcessing(_library_preprocessing(processor), to_left_grid)


def zoedepth_processing(settings: Mapping[str, Any], processor: Any) -> ImageProcessing:
    """Return ZoeDepth's processing: the mirrored borders that its processor adds are cropped after resizing."""
    del settings

    def to_left_grid(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
        border = [int(ZOE_PADDING_FACTOR * np.sqrt(side / 2)) if processor.do_pad else 0 for side in grid]
        full = (grid[0] + 2 * border[0], grid[1] + 2 * border[1])
        return _centre_crop(resized(values, full, "bicubic"), grid)

    return ImageProcessing(_library_preprocessing(processor), to_left_grid)


PROCESSING_FACTORIES: Mapping[str, Callable[[Mapping[str, Any], Any], ImageProcessing]] = {
    "depth_anything": library_processing,
    "depth_pro": depth_pro_processing,
    "dpt": library_processing,
    "glpn": library_processing,
    "zoedepth": zoedepth_processing,
}
"""Factories by ``model_type``; arguments: ``preprocessor_config.json``, library processor (Depth Pro: None)."""


def _library_preprocessing(processor: Any) -> Callable[[UInt8[ndarray, "H W 3"]], Float[Tensor, "1 3 h w"]]:
    def to_network_input(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        tensor: Tensor = processor(images=rgb, return_tensors="pt", input_data_format="channels_last")[
            "pixel_values"
        ]
        return tensor.float()

    return to_network_input


def _centre_crop(values: Float[Tensor, "h w"], grid: tuple[int, int]) -> Float[Tensor, "H W"]:
    """Return the central part of shape ``grid``."""
    top, left = ((full - side) // 2 for full, side in zip(values.shape, grid, strict=True))
    return values[top : top + grid[0], left : left + grid[1]]
