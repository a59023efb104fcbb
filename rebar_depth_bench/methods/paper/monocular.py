"""Metric3D v2, UniDepth v2 and Depth Anything 3 Metric from one image, with their authors' code."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor, files_digest, positive_or_nan
from rebar_depth_bench.methods.paper.third_party import (
    HubNetwork,
    Network,
    hub_download,
    image_tensor,
    resampled,
    scaled_image,
    snapshot,
    torch_device,
)

_UNTESTED = "run only with its authors' code and random weights on a CPU: its weights were not available"


# Metric3D v2 (M. Hu et al., TPAMI 2024) gets the focal length. As in ``hubconf.py`` of its repository, the image
# is resized with its aspect ratio, centred in 616 x 1064 pixels of the mean colour and normalised. The margins
# of the output are cropped, the rest is brought to the left grid bilinearly and converted from the canonical
# camera to metres. The code requires a CUDA GPU in places; without one, the error message states this.

METRIC3D_CODE, METRIC3D_ENTRY_POINT = "hubconf.py", "metric3d_vit_small"
METRIC3D_CACHE = "yvanyin_metric3d_main"
METRIC3D_REPOSITORY, METRIC3D_CHECKPOINT = "JUGGHM/Metric3D", "metric_depth_vit_small_800k.pth"
METRIC3D_LOCAL_COPY = f"metric3d:FOLDER, a clone of github.com/YvanYin/Metric3D with {METRIC3D_CHECKPOINT} in it"
METRIC3D_INPUT_PX = (616, 1064)
"""Height and width of the network input, pixels."""
METRIC3D_MEAN_RGB, METRIC3D_STD_RGB = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
METRIC3D_FOCAL_PX = 1000.0
"""Focal length of Metric3D's canonical camera, pixels."""
METRIC3D_MAX_M = 300.0
"""Largest depth that Metric3D returns, metres."""
METRIC3D_NETWORK = Network(
    MethodInfo(
        name="metric3d",
        summary=(
            "Metric3D v2 (ViT-small) from one picture: depth in metres, the focal length given, as in the paper"
        ),
        columns=("left_rgb", "left_K"),
        uses_intrinsics=True,
        source=f"github.com/YvanYin/Metric3D, {METRIC3D_ENTRY_POINT}",
        licence="BSD-2-Clause",
        untested_note=_UNTESTED,
    ),
    install="pip install mmcv-lite mmengine timm torchvision",
)


def metric3d_with_weights(folder: Path | None) -> Method:
    """Return Metric3D v2 from a clone of its repository with the checkpoint in it or in its folder ``weight``.

    None: the code from the cache of torch.hub and the checkpoint from that of the Hub; both are downloaded after a
    notice if they are missing. torch.hub takes the main branch and does not record its commit: the summary
    therefore names the cache folder and the digest of its Python files.

    Raises ``MethodError`` if code or checkpoint is missing, or for None, if torch is missing or a download fails.
    """
    network = METRIC3D_NETWORK
    if folder is None:
        code = _metric3d_code()
        cached = snapshot(METRIC3D_REPOSITORY, METRIC3D_CHECKPOINT, METRIC3D_LOCAL_COPY)
        versions = f"code {METRIC3D_CACHE} sha256:{files_digest(sorted(code.rglob('*.py')))}"
        info = network.described(f"{versions}; weights commit {cached.name}")
        return Method(info, lambda: _load_metric3d(code, cached / METRIC3D_CHECKPOINT))
    network.check_folder(folder, METRIC3D_CODE)
    candidates = (folder / METRIC3D_CHECKPOINT, folder / "weight" / METRIC3D_CHECKPOINT)
    checkpoint = next((path for path in candidates if path.is_file()), None)
    if checkpoint is None:
        raise MethodError(
            f"metric3d:{folder}: no {METRIC3D_CHECKPOINT} in it or in its weight/, expected the file of "
            f"https://huggingface.co/{METRIC3D_REPOSITORY}"
        )
    info = network.with_digest(folder.resolve().name, [checkpoint])
    return Method(info, lambda: _load_metric3d(folder, checkpoint))


def _metric3d_code() -> Path:
    """Return the folder of Metric3D's code in the cache of torch.hub, downloaded if it is missing."""
    torch = METRIC3D_NETWORK.import_torch()
    code = Path(torch.hub.get_dir(), METRIC3D_CACHE)
    if not (code / METRIC3D_CODE).is_file():
        source = "https://github.com/YvanYin/Metric3D"
        doing = f"its code from {source} cannot be downloaded or run; {METRIC3D_LOCAL_COPY}"
        with (
            hub_download("metric3d", "its code, which is then executed,", METRIC3D_LOCAL_COPY, source),
            METRIC3D_NETWORK.errors(doing),
        ):
            torch.hub.load("yvanyin/metric3d:main", METRIC3D_ENTRY_POINT, pretrain=False, trust_repo=True)
    return code


def _load_metric3d(code: Path, checkpoint: Path) -> Predictor:
    """Return the predictor of the network in a folder with ``hubconf.py``.

    Raises ``MethodError`` if torch, OpenCV or a module that its code imports is missing, or if the weights are
    incomplete.
    """
    network = METRIC3D_NETWORK
    torch = network.import_torch()
    network.import_package("cv2", install_command("methods"))
    with network.errors(f"{code.name} cannot be loaded"):
        model = torch.hub.load(str(code), METRIC3D_ENTRY_POINT, source="local", pretrain=False)
        model = network.load_checkpoint(model, checkpoint, "model_state_dict", strict=False)

    def infer(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        image, inside, scale = metric3d_input(row["left_rgb"])
        output = model.inference({"input": image.to(torch_device())})[0]
        padded = output.float().cpu().reshape(output.shape[-2:])
        network.check_shape(padded.shape, METRIC3D_INPUT_PX)
        canonical = np.asarray(resampled(padded[inside], row["left_rgb"].shape[:2], "bilinear"))
        # fx * scale is the focal length of the network's input image.
        z_m = canonical * np.float32(row["left_K"][0, 0] * scale / METRIC3D_FOCAL_PX)
        return positive_or_nan(np.clip(z_m, 0, METRIC3D_MAX_M))

    return network.predictor(infer)


def metric3d_input(rgb: UInt8[ndarray, "H W 3"]) -> tuple[Any, tuple[slice, slice], float]:
    """Return the network input, a 1 x 3 x 616 x 1064 tensor, the place of the image in it and its resize factor.

    The image is scaled to the largest size that fits, sides rounded down; an odd pixel of margin goes to the
    bottom or right. Needs torch and OpenCV.
    """
    import cv2

    scale = min(full / side for full, side in zip(METRIC3D_INPUT_PX, rgb.shape[:2], strict=True))
    small = scaled_image(rgb, scale)
    height, width, _ = small.shape
    rows, columns = METRIC3D_INPUT_PX[0] - height, METRIC3D_INPUT_PX[1] - width
    top, left = rows // 2, columns // 2
    padded = cv2.copyMakeBorder(
        small, top, rows - top, left, columns - left, cv2.BORDER_CONSTANT, value=METRIC3D_MEAN_RGB
    )
    mean, std = (np.array(values, np.float32) for values in (METRIC3D_MEAN_RGB, METRIC3D_STD_RGB))
    return image_tensor((padded - mean) / std), np.s_[top : top + height, left : left + width], scale


METRIC3D = METRIC3D_NETWORK.listed(metric3d_with_weights, "own clone and weights: metric3d:FOLDER")
"""Metric3D v2 as in the paper; loading downloads its code, which is executed, and its weights."""


# UniDepth v2 (L. Piccinelli et al., 2025) gets no intrinsics. It estimates the camera itself and pads and
# resizes image and output. Its ``depth`` is planar depth along the optical axis, its ``radius`` the distance
# along the ray. It runs at its default resolution bounds.


def _unidepth_m(model: Any, row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    import torch

    planes = torch.from_numpy(row["left_rgb"].transpose(2, 0, 1).copy())
    depth_m = np.asarray(model.infer(planes)["depth"].float().cpu())
    UNIDEPTH_NETWORK.check_shape(depth_m.shape, (1, 1, *row["left_rgb"].shape[:2]))
    return positive_or_nan(depth_m[0, 0])


UNIDEPTH_NETWORK = HubNetwork(
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
    repository="lpiccinelli/unidepth-v2-vitl14",
    module="unidepth.models",
    class_name="UniDepthV2",
    variant_keys=("model", "pixel_encoder", "name"),
    variant="dinov2_vitl14",
    infer=_unidepth_m,
)
UNIDEPTH = UNIDEPTH_NETWORK.listed(UNIDEPTH_NETWORK.with_weights, "own weights: unidepth:FOLDER")
"""UniDepth v2 as in the paper; loading takes the weights from the Hub or its cache."""


# Depth Anything 3 (H. Lin et al., 2025) gets the focal length. Its package resizes the image (long side 504,
# both sides multiples of 14); its output is brought to the left grid bilinearly and converted to metres with the
# mean of fx and fy, as in ``apply_metric_scaling`` in ``utils/alignment.py`` of the package 0.1.1. Sky is kept
# as the package fills it, from a random sample: torch is seeded for each view.

DA3_SEED = 1
DA3_FOCAL_PX = 300.0
"""Focal length, pixels, at which the output of Depth Anything 3's metric model is in metres."""


def _depth_anything_3_m(model: Any, row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
    import torch

    with torch.random.fork_rng(range(torch.cuda.device_count())):
        torch.manual_seed(DA3_SEED)
        output = np.asarray(model.inference([row["left_rgb"]]).depth, np.float32)
    DA3_NETWORK.check_shape(output.shape, (1, *output.shape[-2:]))
    grid, K = row["left_rgb"].shape[:2], row["left_K"]
    # Of the network's input image, whose sides are resized by slightly different factors.
    focal_px = (K[0, 0] * output.shape[2] / grid[1] + K[1, 1] * output.shape[1] / grid[0]) / 2
    values = np.asarray(resampled(torch.from_numpy(output[0]), grid, "bilinear"))
    return positive_or_nan(values.astype(np.float64) * (focal_px / DA3_FOCAL_PX))


DA3_NETWORK = HubNetwork(
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
    repository="depth-anything/DA3METRIC-LARGE",
    module="depth_anything_3.api",
    class_name="DepthAnything3",
    variant_keys=("model_name",),
    variant="da3metric-large",  # Only its output is converted to metres with the focal length.
    infer=_depth_anything_3_m,
)
DEPTH_ANYTHING_3 = DA3_NETWORK.listed(DA3_NETWORK.with_weights, "own weights: depth-anything-3:FOLDER")
"""Depth Anything 3 Metric as in the paper; loading takes the weights from the Hub or its cache."""
