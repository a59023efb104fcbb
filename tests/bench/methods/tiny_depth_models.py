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
VIT: Mapping[str, Any] = {"hidden_size": 16, "num_hidden_layers": 4, "num_attention_heads": 2}
NECK: Mapping[str, Any] = {"neck_hidden_sizes": [4, 4, 8, 8], "fusion_hidden_size": 8}
SMALL_VIT: Mapping[str, Any] = {**VIT, "intermediate_size": 16, "image_size": 32, "patch_size": 8}


def depth_anything(transformers: Any, **changes: Any) -> Any:
    """Return a Depth Anything config with 14-pixel patches, as in the real models."""
    return transformers.DepthAnythingConfig(
        backbone_config=_dinov2(transformers),
        patch_size=14,
        reassemble_hidden_size=16,
        head_hidden_size=4,
        **NECK,
        **changes,
    )


def dpt(transformers: Any, **changes: Any) -> Any:
    """Return a DPT config with a built-in ViT backbone, as in MiDaS."""
    return transformers.DPTConfig(
        **SMALL_VIT, **NECK, backbone_out_indices=[0, 1, 2, 3], is_hybrid=False, **changes
    )


def dpt_dinov2(transformers: Any, **changes: Any) -> Any:
    """Return a DPT config with a DINOv2 backbone, as in the metric heads published with DINOv2."""
    return transformers.DPTConfig(backbone_config=_dinov2(transformers), is_hybrid=False, **NECK, **changes)


def glpn(transformers: Any, **changes: Any) -> Any:
    """Return a GLPN config with one block per stage."""
    one = [1] * 4
    return transformers.GLPNConfig(
        hidden_sizes=[4, 8, 8, 16], depths=one, num_attention_heads=one, decoder_hidden_size=8, **changes
    )


def zoedepth(transformers: Any, **changes: Any) -> Any:
    """Return a ZoeDepth config with one metric head of eight bins."""
    backbone = transformers.BeitConfig(
        **SMALL_VIT, out_indices=[1, 2, 3, 4], reshape_hidden_states=False, use_relative_position_bias=True
    )
    return transformers.ZoeDepthConfig(
        backbone_config=backbone,
        bottleneck_features=8,
        num_relative_features=4,
        bin_embedding_dim=8,
        num_attractors=[4, 2, 2, 1],
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}],
        **NECK,
        **changes,
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


def _dinov2(transformers: Any) -> Any:
    return transformers.Dinov2Config(
        **VIT, patch_size=14, image_size=28, mlp_ratio=2, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )


def _settings(kind: str, height: int, width: int, **more: Any) -> Mapping[str, Any]:
    size = {"size": {"height": height, "width": width}}
    return {"image_processor_type": f"{kind}ImageProcessor", **IMAGENET, **size, **more}


DPT: Mapping[str, Any] = {"keep_aspect_ratio": True, "resample": 3}
DPT_PAD: Mapping[str, Any] = {**DPT, "do_resize": False, "do_pad": True, "size_divisor": 14}
HALF: Mapping[str, Any] = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
ZOE: Mapping[str, Any] = {"do_pad": True, "keep_aspect_ratio": True, "ensure_multiple_of": 8}
MODELS: Mapping[str, tuple[Callable[..., Any], Mapping[str, Any]]] = {
    "depth-anything": (depth_anything, _settings("DPT", 56, 56, ensure_multiple_of=14, **DPT)),
    "depth-pro": (depth_pro, {**_settings("", 64, 64), **HALF}),
    "dpt": (dpt, {**_settings("DPT", 32, 32, ensure_multiple_of=1, resample=3), "keep_aspect_ratio": False}),
    "dpt-dinov2": (dpt_dinov2, {**_settings("DPT", 56, 56, ensure_multiple_of=14), **DPT_PAD}),
    "glpn": (glpn, {"image_processor_type": "GLPNImageProcessor", "do_rescale": True, "size_divisor": 32}),
    "zoedepth": (zoedepth, _settings("ZoeDepth", 32, 64, **ZOE)),
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
