"""UniDepth v2 and Depth Anything 3 Metric from one image, with their authors' packages and weights from the Hub.

UniDepth gets no intrinsics. It estimates the camera itself and pads and resizes image and output. Its ``depth`` is
planar depth along the optical axis, its ``radius`` the distance along the ray. It runs at its default resolution
bounds. This method has never been run with the real network: its weights could not be downloaded and its package
needs torchvision. Written after ``unidepth/models/unidepthv2/unidepthv2.py`` of its repository.

Depth Anything 3 gets the focal length. Its package resizes the image (long side 504, both sides multiples of 14);
its output is brought to the left grid bilinearly. Sky is kept as the package fills it, from a random sample: torch
is seeded for each view. Tested with the package's own code (0.1.1, with a stand-in for torchvision) and a small
network with random weights; a test repeats this if the package is installed. It has never been run with the real
weights, which could not be downloaded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.huggingface.families import resized
from rebar_depth_bench.methods.paper.third_party import (
    CONFIG,
    HubModel,
    announce_download,
    check_folder,
    download_error,
    image_tensor,
    import_torch,
    lazy_hub_method,
    load_checkpoint,
    load_network,
    read_json_object,
    shape_error,
    torch_device,
    translate_errors,
    with_weights_digest,
)
from rebar_depth_bench.validation import short_repr

UNIDEPTH_NAME, UNIDEPTH_REPOSITORY = "unidepth", "lpiccinelli/unidepth-v2-vitl14"
UNIDEPTH_INSTALL = "pip install 'unidepth @ git+https://github.com/lpiccinelli-eth/UniDepth'"
UNIDEPTH_INFO = MethodInfo(
    name=UNIDEPTH_NAME,
    summary="UniDepth v2 from one picture: depth in metres, the camera not given, as in the paper",
    columns=("left_rgb",),
    uses_intrinsics=False,
    source=f"github.com/lpiccinelli-eth/UniDepth, {UNIDEPTH_REPOSITORY}",
    licence="CC BY-NC 4.0",
    untested_note="not tested with the real network: its code and weights were not available",
)
DA3_NAME, DA3_REPOSITORY = "depth-anything-3", "depth-anything/DA3METRIC-LARGE"
DA3_PRESET = "da3metric-large"
"""The only model whose output is scaled to metres by the focal length; others are relative or already metric."""
DA3_SEED = 1
DA3_INSTALL = "pip install depth-anything-3"
DA3_INFO = MethodInfo(
    name=DA3_NAME,
    summary="Depth Anything 3 Metric from one picture: depth in metres, the focal length given, as in the paper",
    columns=("left_rgb", "left_K"),
    uses_intrinsics=True,
    source=f"depth-anything-3, {DA3_REPOSITORY}",
    licence="Apache-2.0",
    untested_note="tested only with its real code and a small random network: its weights were not available",
)


def load_unidepth(folder: Path) -> Predictor:
    """Return the predictor of UniDepth's network in a folder; raises as ``load_network``."""
    torch, model = load_network(UNIDEPTH_NAME, "unidepth.models", "UniDepthV2", UNIDEPTH_INSTALL, folder)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        planes = torch.from_numpy(row["left_rgb"].transpose(2, 0, 1).copy())
        with translate_errors(UNIDEPTH_NAME, torch, "inference failed"), torch.inference_mode():
            depth_m = np.asarray(model.infer(planes)["depth"].float().cpu().numpy())
        grid = row["left_rgb"].shape[:2]
        if depth_m.shape != (1, 1, *grid):
            raise shape_error(UNIDEPTH_NAME, depth_m.shape, f"1 x 1 and the image's {grid}")
        return positive_or_nan(depth_m[0, 0])

    return predict


def load_depth_anything_3(folder: Path) -> Predictor:
    """Return the predictor of Depth Anything 3's network in a folder; raises as ``load_network``."""
    torch, model = load_network(DA3_NAME, "depth_anything_3.api", "DepthAnything3", DA3_INSTALL, folder)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb, grid = row["left_rgb"], row["left_rgb"].shape[:2]
        with (
            translate_errors(DA3_NAME, torch, "inference failed"),
            torch.random.fork_rng(range(torch.cuda.device_count())),
        ):
            torch.manual_seed(DA3_SEED)
            network_output = np.asarray(model.inference([rgb]).depth, np.float32)
        if network_output.ndim != 3 or len(network_output) != 1:
            raise shape_error(DA3_NAME, network_output.shape, "1 x h x w")
        values = resized(torch.from_numpy(network_output[0]), grid, "bilinear").numpy()
        input_grid = (network_output.shape[1], network_output.shape[2])
        return da3_depth_m(values, da3_focal_px(row["left_K"], grid, input_grid))

    return predict


def check_preset(folder: Path) -> None:
    """Raise ``MethodError`` if ``config.json`` in a folder belongs to another model of Depth Anything 3."""
    preset = read_json_object(folder / CONFIG).get("model_name")
    if preset != DA3_PRESET:
        raise MethodError(
            f"{DA3_NAME}:{folder}: config.json names model {short_repr(preset)}, expected {DA3_PRESET!r}: only "
            "its output can be converted to metres with the focal length"
        )


UNIDEPTH_MODEL = HubModel(UNIDEPTH_INFO, UNIDEPTH_REPOSITORY, "unidepth", UNIDEPTH_INSTALL, load_unidepth)
UNIDEPTH = lazy_hub_method(UNIDEPTH_MODEL)
"""UniDepth v2 as in the paper; loading takes the weights from the Hub or its cache."""
DEPTH_ANYTHING_3_MODEL = HubModel(
    DA3_INFO, DA3_REPOSITORY, "depth_anything_3", DA3_INSTALL, load_depth_anything_3, check_preset
)
DEPTH_ANYTHING_3 = lazy_hub_method(DEPTH_ANYTHING_3_MODEL)
"""Depth Anything 3 Metric as in the paper; loading takes the weights from the Hub or its cache."""


# Metric3D v2 (``metric3d_vit_small``) from one image and its focal length, with its authors' code.
#
# The image is letterboxed: resized with its aspect ratio and centred in 616 x 1064 pixels of the mean colour.
# The margins of the output are cropped, the rest is brought to the left grid bilinearly and converted from the
# canonical camera to metres, as in ``hubconf.py``.
#
# This method has never been run with the real network because its weights could not be downloaded. The code
# imports mmcv or mmengine and requires a CUDA GPU in places; without one, the error message states this.

NAME, HUB_ENTRY_POINT = "metric3d", "metric3d_vit_small"
REPOSITORY, CACHE_FOLDER = "yvanyin/metric3d:main", "yvanyin_metric3d_main"
CHECKPOINT_FILE = "metric_depth_vit_small_800k.pth"
WEIGHTS_URL = f"https://huggingface.co/JUGGHM/Metric3D/resolve/main/{CHECKPOINT_FILE}"
HUBCONF = "hubconf.py"
INPUT_SIZE_PX = (616, 1064)
"""Height and width of the network input, pixels."""
MEAN_RGB, STD_RGB = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
MARGIN_RGB = (124, 116, 104)
"""Mean colour as integers, as OpenCV writes it into an image."""
LOCAL_COPY_HINT = f"{NAME}:FOLDER, a clone of github.com/YvanYin/Metric3D with {CHECKPOINT_FILE} in it"
INFO = MethodInfo(
    name=NAME,
    summary="Metric3D v2 (ViT-small) from one picture: depth in metres, the focal length given, as in the paper",
    columns=("left_rgb", "left_K"),
    uses_intrinsics=True,
    source=f"github.com/YvanYin/Metric3D, {HUB_ENTRY_POINT}",
    licence="BSD-2-Clause",
    untested_note="not tested with the real network: its code and weights were not available",
)


def metric3d_method(folder: Path) -> Method:
    """Return Metric3D v2 from a clone of its repository with the checkpoint in it or in its folder ``weight``.

    Raises ``MethodError`` if code or checkpoint is missing.
    """
    check_folder(folder, NAME, (HUBCONF,))
    candidates = (folder / CHECKPOINT_FILE, folder / "weight" / CHECKPOINT_FILE)
    checkpoint = next((path for path in candidates if path.is_file()), None)
    if checkpoint is None:
        raise MethodError(
            f"{NAME}:{folder}: no {CHECKPOINT_FILE} in it or in its weight/, expected the file from {WEIGHTS_URL}"
        )
    return Method(
        with_weights_digest(INFO, folder.resolve().name, [checkpoint]), lambda: load_predictor(folder, checkpoint)
    )


def load_predictor(folder: Path, checkpoint: Path) -> Predictor:
    """Return the predictor of the network in a folder with ``hubconf.py``, on the GPU if torch finds one.

    Raises ``MethodError`` if torch or a module that its code imports is missing, or if the weights are incomplete.
    """
    torch = import_torch(NAME)
    with translate_errors(NAME, torch, f"{folder.name} cannot be loaded"):
        network = torch.hub.load(str(folder), HUB_ENTRY_POINT, source="local", pretrain=False)
        model = load_checkpoint(NAME, torch, network, checkpoint, "model_state_dict", strict=False)

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        grid = row["left_rgb"].shape[:2]
        letterbox = fit_letterbox(grid, INPUT_SIZE_PX)
        with translate_errors(NAME, torch, "inference failed"), torch.inference_mode():
            tensor = network_input(row["left_rgb"], letterbox).to(torch_device(torch))
            raw_output = model.inference({"input": tensor})[0]
            padded_depth = raw_output.float().cpu().reshape(raw_output.shape[-2:])
        if tuple(padded_depth.shape) != INPUT_SIZE_PX:
            raise shape_error(NAME, padded_depth.shape, f"{INPUT_SIZE_PX}")
        canonical = resized(crop_margins(padded_depth, letterbox.margins), grid, "bilinear")
        return metric3d_depth_m(np.asarray(canonical.numpy()), row["left_K"], letterbox.scale)

    return predict


def network_input(rgb: UInt8[ndarray, "H W 3"], letterbox: Letterbox) -> Any:
    """Return the normalised network input, a tensor of shape 1 x 3 x 616 x 1064. Needs torch.

    Source: ``hubconf.py`` of Metric3D, with torch's bilinear interpolation instead of OpenCV's, which is equal.
    """
    torch, size = import_torch(NAME), (letterbox.height_px, letterbox.width_px)
    planes = [resized(plane, size, "bilinear").round().numpy() for plane in image_tensor(torch, rgb)[0]]
    letterboxed = padded(np.stack(planes, axis=-1), letterbox.margins, MARGIN_RGB)
    return image_tensor(torch, (letterboxed - MEAN_RGB) / STD_RGB)


def cached_metric3d_method() -> Method:
    """Return Metric3D v2 from the cache of torch.hub; missing files are downloaded after a notice.

    torch.hub takes the main branch and does not record its commit: the summary therefore names the cache folder
    and the digests of its Python files and of the checkpoint. Both must be present to compute the digests.

    Raises ``MethodError`` if torch is missing or a download fails.
    """
    torch = import_torch(NAME)
    cache = Path(torch.hub.get_dir())
    folder, checkpoint = cache / CACHE_FOLDER, cache / "checkpoints" / CHECKPOINT_FILE
    if not (folder / HUBCONF).is_file():
        source = "https://github.com/YvanYin/Metric3D"
        announce_download(NAME, "its code, which is then executed,", source, LOCAL_COPY_HINT)
        doing = f"its code from {source} cannot be downloaded or run; {LOCAL_COPY_HINT}"
        with translate_errors(NAME, torch, doing):
            torch.hub.load(REPOSITORY, HUB_ENTRY_POINT, pretrain=False, trust_repo=True)
    if not checkpoint.is_file():
        announce_download(NAME, "the weights", WEIGHTS_URL, LOCAL_COPY_HINT)
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.hub.download_url_to_file(WEIGHTS_URL, str(checkpoint), progress=False)
        except OSError as error:
            raise download_error(NAME, WEIGHTS_URL, error, LOCAL_COPY_HINT) from None
    code = files_digest(sorted(folder.rglob("*.py")))
    versions = f"code {CACHE_FOLDER} sha256:{code}; weights sha256:{files_digest([checkpoint])}"
    info = replace(INFO, summary=f"{INFO.summary}; {versions}")
    return Method(info, lambda: load_predictor(folder, checkpoint))


METRIC3D = Method(
    replace(INFO, summary=f"{INFO.summary}; own clone and weights: {NAME}:FOLDER"),
    lambda: cached_metric3d_method().load(),
)
"""Metric3D v2 as in the paper; loading downloads its code, which is executed, and its weights with torch.hub."""


# Conversions of network outputs to metres, and resizing and padding of network inputs. Torch is not needed.
#
# Each function follows the network's authors: Metric3D v2 (M. Hu et al., TPAMI 2024; ``hubconf.py`` of its
# repository), Depth Anything 3 (H. Lin et al., 2025; ``utils/alignment.py`` and the FAQ of its package 0.1.1),
# UniDepth v2 (L. Piccinelli et al., 2025; the key ``depth`` of ``infer``).

METRIC3D_FOCAL_PX = 1000.0
"""Focal length of Metric3D's canonical camera, pixels."""
METRIC3D_MAX_M = 300.0
"""Largest depth that Metric3D returns, metres."""
DA3_FOCAL_PX = 300.0
"""Focal length, pixels, at which the output of Depth Anything 3's metric model is in metres."""


@dataclass(frozen=True)
class Margins:
    """Width of the margins around an image, pixels."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass(frozen=True)
class Letterbox:
    """Placement of an image in a fixed-size network input.

    The image is resized by ``scale`` to ``height_px`` x ``width_px`` and surrounded by ``margins``.
    """

    scale: float
    height_px: int
    width_px: int
    margins: Margins


def fit_letterbox(grid: tuple[int, int], target: tuple[int, int]) -> Letterbox:
    """Return Metric3D's letterboxing of an image of ``grid`` = (H, W) into an input of ``target`` = (h, w) pixels.

    The image is scaled to the largest size that fits (sides rounded down) and centred; an odd pixel of margin goes
    to the bottom or right. Source: ``hubconf.py``.
    """
    scale = min(target[0] / grid[0], target[1] / grid[1])
    height, width = (max(1, int(side * scale)) for side in grid)
    return Letterbox(scale, height, width, _centring_margins(target[0] - height, target[1] - width))


def margins_to_multiple(grid: tuple[int, int], step_px: int) -> Margins:
    """Return the margins that pad (H, W) to multiples of ``step_px``; an odd pixel goes to the bottom or right.

    Both images of a stereo pair get the same margins, so that disparities are unchanged.
    """
    return _centring_margins(-grid[0] % step_px, -grid[1] % step_px)


def _centring_margins(rows: int, columns: int) -> Margins:
    """Return as many margin pixels in total, evenly on both sides; an odd one goes to the bottom or right."""
    return Margins(rows // 2, rows - rows // 2, columns // 2, columns - columns // 2)


def padded(image: ndarray, margins: Margins, colour: tuple[int, ...] | None = None) -> ndarray:
    """Return an H x W x C image with margins of one colour, or of repeated border pixels if ``colour`` is None."""
    if colour is None:
        widths = ((margins.top, margins.bottom), (margins.left, margins.right), (0, 0))
        return np.pad(image, widths, mode="edge")
    height, width, channels = image.shape
    padded_shape = (height + margins.top + margins.bottom, width + margins.left + margins.right, channels)
    canvas = np.broadcast_to(np.asarray(colour, image.dtype), padded_shape).copy()
    canvas[margins.top : margins.top + height, margins.left : margins.left + width] = image
    return canvas


def crop_margins(values: Any, margins: Margins) -> Any:
    """Return a view of an h x w array or tensor without its margins."""
    height, width = values.shape
    return values[margins.top : height - margins.bottom, margins.left : width - margins.right]


def metric3d_depth_m(
    canonical: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"], scale: float
) -> Float32[ndarray, "h w"]:
    """Return z = canonical * fx * scale / 1000, metres, at most 300 m; NaN where it is not above 0.

    ``K`` (pixels) belongs to the left grid and ``scale`` is the resize factor of the image: fx * scale is the
    focal length of the network's input image. Source: ``hubconf.py`` of Metric3D, "de-canonical transform".
    """
    z_m = canonical.astype(np.float64) * (K[0, 0] * scale / METRIC3D_FOCAL_PX)
    return positive_or_nan(np.clip(z_m, 0, METRIC3D_MAX_M))


def da3_focal_px(K: Float64[ndarray, "3 3"], grid: tuple[int, int], input_grid: tuple[int, int]) -> float:
    """Return the mean of fx and fy, pixels, of the input image of Depth Anything 3.

    ``K`` belongs to the left ``grid`` = (H, W), which was resized to ``input_grid`` = (h, w): long side 504, both
    sides multiples of 14, so that fx and fy differ slightly. Source: ``apply_metric_scaling``.
    """
    return float(K[0, 0] * input_grid[1] / grid[1] + K[1, 1] * input_grid[0] / grid[0]) / 2


def da3_depth_m(values: Float[ndarray, "h w"], focal_px: float) -> Float32[ndarray, "h w"]:
    """Return z = value * focal / 300, metres; NaN where it is not above 0. ``focal_px``: see ``da3_focal_px``."""
    return positive_or_nan(values.astype(np.float64) * (focal_px / DA3_FOCAL_PX))


def positive_or_nan(depth_m: Float[ndarray, "h w"]) -> Float32[ndarray, "h w"]:
    """Return depth as float32, with NaN (no prediction) where it is not finite or not above 0."""
    with np.errstate(over="ignore"):
        single = depth_m.astype(np.float32)
    return np.where(np.isfinite(single) & (single > 0), single, np.float32(np.nan))
