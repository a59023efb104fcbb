"""Metric3D v2, UniDepth v2 and Depth Anything 3 Metric from one image, with their authors' code."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor, positive_or_nan
from rebar_depth_bench.methods.paper.third_party import (
    Network,
    hub_download,
    image_tensor,
    scaled_image,
    snapshot,
    torch_device,
)

_UNTESTED = "run only with its authors' code and random weights on a CPU: its weights were not available"

METRIC3D_NETWORK = Network(
    MethodInfo(
        name="metric3d",
        summary=(
            "Metric3D v2 (ViT-small) from one picture: depth in metres, the focal length given, as in the paper"
        ),
        columns=("left_rgb", "left_K"),
        uses_intrinsics=True,
        source="github.com/YvanYin/Metric3D, metric3d_vit_small",
        licence="BSD-2-Clause",
        untested_note=_UNTESTED,
    ),
    install="pip install mmcv-lite mmengine timm torchvision",
)


def metric3d_method(folder: Path | None) -> Method:
    """Return Metric3D v2 (M. Hu et al., TPAMI 2024) from a clone of its repository with the checkpoint in it.

    The checkpoint may also be in the clone's folder ``weight``. None: the code from the cache of torch.hub, which
    takes the main branch, and the checkpoint from that of the Hub; both are downloaded after a notice if they are
    missing.

    As in ``hubconf.py`` of the repository, the image is resized with its aspect ratio, centred in 616 x 1064
    pixels of the mean colour and normalised. The margins of the output are cropped, the rest is brought to the
    left grid bilinearly and converted from the canonical camera to metres. The code requires a CUDA GPU in places;
    without one, the error message states this.

    Raises ``MethodError`` if code or checkpoint is missing, or for None, if torch is missing or a download fails.
    """
    network, entry_point = METRIC3D_NETWORK, "metric3d_vit_small"
    repository, checkpoint = "JUGGHM/Metric3D", "metric_depth_vit_small_800k.pth"
    if folder is None:
        local_copy = f"metric3d:FOLDER, a clone of github.com/YvanYin/Metric3D with {checkpoint} in it"
        torch_hub = network.import_package("torch", install_command("torch")).hub
        code = Path(torch_hub.get_dir(), "yvanyin_metric3d_main")
        if not (code / "hubconf.py").is_file():
            source = "https://github.com/YvanYin/Metric3D"
            doing = f"its code from {source} cannot be downloaded or run; {local_copy}"
            with (
                hub_download("metric3d", "its code, which is then executed,", local_copy, source),
                network.errors(doing),
            ):
                torch_hub.load("yvanyin/metric3d:main", entry_point, pretrain=False, trust_repo=True)
        weights = snapshot(repository, checkpoint, local_copy)
        info = replace(network.info, summary=f"{network.info.summary}; weights commit {weights.name}")
    else:
        network.check_folder(folder, "hubconf.py")
        code = folder
        weights = folder if (folder / checkpoint).is_file() else folder / "weight"
        if not (weights / checkpoint).is_file():
            raise MethodError(
                f"metric3d:{folder}: no {checkpoint} in it or in its weight/, expected the file of "
                f"https://huggingface.co/{repository}"
            )
        info = replace(network.info, name=f"metric3d:{folder.resolve().name}")

    def load() -> Predictor:
        torch = network.import_package("torch", install_command("torch"))
        interpolate = torch.nn.functional.interpolate
        cv2 = network.import_package("cv2", install_command("methods"))
        with network.errors(f"{code.name} cannot be loaded"):
            model = torch.hub.load(str(code), entry_point, source="local", pretrain=False)
            model = network.load_checkpoint(model, weights / checkpoint, "model_state_dict", strict=False)

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            rgb, canvas = row["left_rgb"], (616, 1064)
            mean, std = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
            scale = min(canvas[0] / rgb.shape[0], canvas[1] / rgb.shape[1])
            small = scaled_image(rgb, scale)
            height, width = small.shape[:2]
            top, left = (canvas[0] - height) // 2, (canvas[1] - width) // 2
            bottom, right = canvas[0] - height - top, canvas[1] - width - left
            padded = cv2.copyMakeBorder(small, top, bottom, left, right, cv2.BORDER_CONSTANT, value=mean)
            image = image_tensor((padded - np.array(mean, np.float32)) / np.array(std, np.float32))
            with network.errors("inference failed"), torch.inference_mode():
                output = model.inference({"input": image.to(torch_device())})[0].float().cpu()
                network.check_shape(output.shape[-2:], canvas)
                inside = output.reshape(1, 1, *canvas)[..., top : top + height, left : left + width]
                canonical = np.asarray(interpolate(inside, rgb.shape[:2], mode="bilinear")[0, 0])
            # fx * scale is the focal length of the network's input image, 1000 that of the canonical camera.
            z_m = canonical * np.float32(row["left_K"][0, 0] * scale / 1000.0)
            return positive_or_nan(np.clip(z_m, 0, 300.0))  # Metric3D returns at most 300 m.

        return predict

    return Method(info, load)


METRIC3D = METRIC3D_NETWORK.listed(metric3d_method, "own clone and weights: metric3d:FOLDER")
"""Metric3D v2 as in the paper; loading downloads its code, which is executed, and its weights."""


UNIDEPTH_NETWORK = Network(
    MethodInfo(
        name="unidepth",
        summary="UniDepth v2 from one picture: depth in metres, the camera not given, as in the paper",
        columns=("left_rgb",),
        uses_intrinsics=False,
        source="github.com/lpiccinelli-eth/UniDepth, lpiccinelli/unidepth-v2-vitl14",
        licence="CC BY-NC 4.0",
        untested_note=_UNTESTED,
    ),
    install="pip install 'unidepth @ git+https://github.com/lpiccinelli-eth/UniDepth'",
)


def unidepth_method(folder: Path | None) -> Method:
    """Return UniDepth v2 (L. Piccinelli et al., 2025) with the weights in a folder; None: those from the Hub.

    It estimates the camera itself, and pads and resizes image and output. Its ``depth`` is planar depth along the
    optical axis, its ``radius`` the distance along the ray. It runs at its default resolution bounds.

    Raises ``MethodError`` as ``Network.find_weights``.
    """
    network, repository = UNIDEPTH_NETWORK, "lpiccinelli/unidepth-v2-vitl14"
    keys = ("model", "pixel_encoder", "name")
    info, weights = network.find_weights(folder, repository, "unidepth", keys, "dinov2_vitl14")

    def load() -> Predictor:
        torch = network.import_package("torch", install_command("torch"))
        models = network.import_package("unidepth.models", network.install)
        model = network.load_pretrained(models.UniDepthV2, weights, repository)

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            rgb = row["left_rgb"]
            with network.errors("inference failed"), torch.inference_mode():
                output = model.infer(torch.from_numpy(rgb.transpose(2, 0, 1).copy()))
                depth_m = np.asarray(output["depth"].float().cpu())
            network.check_shape(depth_m.shape, (1, 1, *rgb.shape[:2]))
            return positive_or_nan(depth_m[0, 0])

        return predict

    return Method(info, load)


UNIDEPTH = UNIDEPTH_NETWORK.listed(unidepth_method, "own weights: unidepth:FOLDER")
"""UniDepth v2 as in the paper; loading takes the weights from the Hub or its cache."""


DA3_NETWORK = Network(
    MethodInfo(
        name="depth-anything-3",
        summary=(
            "Depth Anything 3 Metric from one picture: depth in metres, the focal length given, as in the paper"
        ),
        columns=("left_rgb", "left_K"),
        uses_intrinsics=True,
        source="depth-anything-3, depth-anything/DA3METRIC-LARGE",
        licence="Apache-2.0",
        untested_note=(
            "run only with its package's code and a small random network on a CPU: its weights were not available"
        ),
    ),
    install="pip install depth-anything-3 addict",
)


def depth_anything_3_method(folder: Path | None) -> Method:
    """Return Depth Anything 3 Metric (H. Lin et al., 2025) with the weights in a folder; None: those from the Hub.

    Its package resizes the image (long side 504, both sides multiples of 14). The output is brought to the left
    grid bilinearly and converted to metres with the mean of fx and fy, as in ``apply_metric_scaling`` in
    ``utils/alignment.py`` of the package 0.1.1. Sky is kept as the package fills it, from a random sample: torch
    is seeded for each view.

    Raises ``MethodError`` as ``Network.find_weights``.
    """
    network, repository = DA3_NETWORK, "depth-anything/DA3METRIC-LARGE"
    # Only the output of this variant is converted to metres with the focal length.
    package, variant = "depth_anything_3", "da3metric-large"
    info, weights = network.find_weights(folder, repository, package, ("model_name",), variant)

    def load() -> Predictor:
        torch = network.import_package("torch", install_command("torch"))
        interpolate = torch.nn.functional.interpolate
        api = network.import_package("depth_anything_3.api", network.install)
        model = network.load_pretrained(api.DepthAnything3, weights, repository)

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            rgb, K = row["left_rgb"], row["left_K"]
            with network.errors("inference failed"), torch.inference_mode():
                with torch.random.fork_rng(range(torch.cuda.device_count())):
                    torch.manual_seed(1)
                    output = np.asarray(model.inference([rgb]).depth, np.float32)
                network.check_shape(output.shape, (1, *output.shape[-2:]))
                values = interpolate(torch.from_numpy(output[None]), rgb.shape[:2], mode="bilinear")[0, 0]
            # Of the network's input image, whose sides are resized by slightly different factors.
            focal_px = (K[0, 0] * output.shape[2] / rgb.shape[1] + K[1, 1] * output.shape[1] / rgb.shape[0]) / 2
            # The output is in metres at a focal length of 300 pixels.
            return positive_or_nan(np.asarray(values, np.float64) * (focal_px / 300.0))

        return predict

    return Method(info, load)


DEPTH_ANYTHING_3 = DA3_NETWORK.listed(depth_anything_3_method, "own weights: depth-anything-3:FOLDER")
"""Depth Anything 3 Metric as in the paper; loading takes the weights from the Hub or its cache."""
