"""Checkpoints of the real depth networks of ``transformers``, tiny and with random weights, on disk."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

IMAGENET: Mapping[str, Any] = {
    "do_resize": True,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_normalize": True,
    "image_mean": [0.485, 0.456, 0.406],
    "image_std": [0.229, 0.224, 0.225],
}
KEEP_ASPECT_RATIO: Mapping[str, Any] = {"keep_aspect_ratio": True, "resample": 3}
VIT: Mapping[str, Any] = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2}
NECK: Mapping[str, Any] = {"neck_hidden_sizes": [4, 4, 8, 8], "fusion_hidden_size": 8}


def depth_anything(transformers: Any, **changes: Any) -> Any:
    """Return a Depth Anything config with 14-pixel patches, as in the real models."""
    backbone = transformers.Dinov2Config(
        **VIT, patch_size=14, image_size=28, mlp_ratio=2, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )
    return transformers.DepthAnythingConfig(
        backbone_config=backbone, patch_size=14, reassemble_hidden_size=16, head_hidden_size=4, **NECK, **changes
    )


def dpt(transformers: Any, **changes: Any) -> Any:
    """Return a DPT config with a built-in ViT backbone, as in MiDaS."""
    return transformers.DPTConfig(
        **VIT,
        **NECK,
        intermediate_size=16,
        image_size=32,
        patch_size=8,
        backbone_out_indices=[0, 1, 2, 3],
        is_hybrid=False,
        **changes,
    )


def dpt_dinov2(transformers: Any, **changes: Any) -> Any:
    """Return a DPT config with a DINOv2 backbone, as in the metric heads published with DINOv2."""
    backbone = transformers.Dinov2Config(
        **VIT, patch_size=14, image_size=28, mlp_ratio=2, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )
    return transformers.DPTConfig(backbone_config=backbone, is_hybrid=False, **NECK, **changes)


def glpn(transformers: Any, **changes: Any) -> Any:
    """Return a GLPN config with one block per stage."""
    return transformers.GLPNConfig(
        hidden_sizes=[4, 8, 8, 16],
        depths=[1] * 4,
        num_attention_heads=[1] * 4,
        decoder_hidden_size=8,
        **changes,
    )


def zoedepth(transformers: Any, **changes: Any) -> Any:
    """Return a ZoeDepth config with one metric head of eight bins."""
    nyu = {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}
    backbone = transformers.BeitConfig(
        **VIT,
        intermediate_size=16,
        image_size=32,
        patch_size=8,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    return transformers.ZoeDepthConfig(
        backbone_config=backbone,
        bottleneck_features=8,
        num_relative_features=4,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        **{"bin_configurations": [nyu], **NECK, **changes},
    )


def zoedepth_two_heads(transformers: Any) -> Any:
    """Return a ZoeDepth config with an indoor (NYU) and an outdoor (KITTI) head.

    The library's code requires four layers of 128 for the transformer that chooses between them.
    """
    return zoedepth(
        transformers,
        bin_configurations=[
            {"n_bins": 8, "min_depth": 0.001, "max_depth": max_m, "name": name}
            for name, max_m in (("nyu", 10.0), ("kitti", 80.0))
        ],
        num_patch_transformer_layers=4,
        patch_transformer_hidden_size=128,
        patch_transformer_intermediate_size=8,
        patch_transformer_num_attention_heads=2,
    )


def depth_pro(transformers: Any, **changes: Any) -> Any:
    """Return a Depth Pro config with the head that estimates the focal length, as in the real model."""
    encoder = transformers.Dinov2Config(**VIT, patch_size=8, image_size=16, mlp_ratio=2).to_dict()
    encoders = {f"{name}_model_config": dict(encoder) for name in ("image", "patch", "fov")}
    return transformers.DepthProConfig(
        fusion_hidden_size=8,
        patch_size=16,
        intermediate_hook_ids=[3, 1],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.25, 0.5, 1],
        scaled_images_feature_dims=[8, 8, 8],
        merge_padding_value=1,
        use_fov_model=True,
        num_fov_head_layers=1,
        **encoders,
        **changes,
    )


def _size(height: int, width: int) -> dict[str, Any]:
    return {"size": {"height": height, "width": width}}


def _dpt_settings(height: int, width: int, multiple: int) -> dict[str, Any]:
    shape = {**KEEP_ASPECT_RATIO, **_size(height, width), "ensure_multiple_of": multiple}
    return {"image_processor_type": "DPTImageProcessor", **IMAGENET, **shape}


ZOE_SETTINGS: Mapping[str, Any] = {
    "image_processor_type": "ZoeDepthImageProcessor",
    **IMAGENET,
    **_size(32, 64),
    "do_pad": True,
    "keep_aspect_ratio": True,
    "ensure_multiple_of": 8,
}

MODELS: Mapping[str, tuple[Callable[..., Any], Mapping[str, Any]]] = {
    "depth-anything": (depth_anything, _dpt_settings(56, 56, 14)),
    "depth-pro": (
        depth_pro,
        {
            "image_processor_type": "DepthProImageProcessorFast",
            **IMAGENET,
            **_size(64, 64),
            "image_mean": [0.5] * 3,
            "image_std": [0.5] * 3,
        },
    ),
    "dpt": (dpt, {**_dpt_settings(32, 32, 1), "keep_aspect_ratio": False}),
    "dpt-dinov2": (
        dpt_dinov2,
        {**_dpt_settings(56, 56, 14), "do_resize": False, "do_pad": True, "size_divisor": 14},
    ),
    "glpn": (glpn, {"image_processor_type": "GLPNImageProcessor", "do_rescale": True, "size_divisor": 32}),
    "zoedepth": (zoedepth, ZOE_SETTINGS),
    "zoedepth-two-heads": (zoedepth_two_heads, ZOE_SETTINGS),
}
"""Config factory and ``preprocessor_config.json`` of each kind of model."""

LAST_LAYER: Mapping[str, str] = {
    "depth-anything": "head.conv3",
    "depth-pro": "head.layers.4",
    "dpt": "head.head.4",
    "dpt-dinov2": "head.head.4",
    "glpn": "head.head.2",
}
"""Name of the convolution before the last activation, by kind of model."""


def save_checkpoint(folder: Path, kind: str, bias: float | None = None, **changes: Any) -> Path:
    """Write a checkpoint of random weights and return its folder.

    With ``bias``, the output of the last convolution equals this number everywhere.
    """
    torch, transformers = (importlib.import_module(name) for name in ("torch", "transformers"))
    torch.manual_seed(1)
    config, settings = MODELS[kind]
    model = transformers.AutoModelForDepthEstimation.from_config(config(transformers, **changes))
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:  # Large enough for an output that varies over the image.
                parameter.normal_(0, (2 / parameter[0].numel()) ** 0.5)
        if kind in LAST_LAYER:
            last = model.get_submodule(LAST_LAYER[kind])
            last.weight.copy_(last.weight.abs() / 4 if bias is None else 0 * last.weight)
            last.bias.fill_(0.1 if bias is None else bias)
    model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(dict(settings)))
    return folder
