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
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import da3_depth_m, da3_focal_px, positive_or_nan
from rebar_depth_bench.methods.monocular.hub import CONFIG, HubModel, lazy_hub_method, load_network
from rebar_depth_bench.methods.monocular.third_party import read_json_object, shape_error, translate_errors
from rebar_depth_bench.methods.transformers.model import resized
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
