"""Depth Anything 3 Metric from one image and its focal length, with its authors' package.

The package resizes the image (long side 504, both sides multiples of 14); its output is brought to the left grid
bilinearly. Sky is kept as the package fills it, from a random sample: torch is seeded for each view.

Tested with the package's own code (0.1.1, with a stand-in for torchvision) and a small network with random
weights; a test repeats this if the package is installed. It has never been run with the real weights, which could
not be downloaded.
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
from rebar_depth_bench.methods.monocular.conversions import da3_depth_m, da3_focal_px
from rebar_depth_bench.methods.monocular.hub import CONFIG, WEIGHTS, HubModel, lazy_hub_method
from rebar_depth_bench.methods.monocular.third_party import (
    check_weights_loaded,
    import_package,
    import_torch,
    read_json_object,
    safetensors_names,
    translate_errors,
)
from rebar_depth_bench.validation import short_repr

NAME, REPOSITORY = "depth-anything-3", "depth-anything/DA3METRIC-LARGE"
PRESET = "da3metric-large"
"""The only model whose output is scaled to metres by the focal length; others are relative or already metric."""
SEED = 1
INSTALL = "pip install depth-anything-3"
INFO = MethodInfo(
    name=NAME,
    summary="Depth Anything 3 Metric from one picture: depth in metres, the focal length given, as in the paper",
    columns=("left_rgb", "left_K"),
    uses_intrinsics=True,
    source=f"depth-anything-3, {REPOSITORY}",
    licence="Apache-2.0",
    untested_note="tested only with its real code and a small random network: its weights were not available",
)


def load_predictor(folder: Path) -> Predictor:
    """Return the predictor of the network in a folder, on the GPU if torch finds one.

    Raises ``MethodError`` if torch or the package is missing, or if the weights are incomplete.
    """
    torch = import_torch(NAME)
    api = import_package("depth_anything_3.api", NAME, INSTALL)
    with translate_errors(NAME, torch, f"{folder.name} cannot be loaded"):
        model = api.DepthAnything3.from_pretrained(str(folder), local_files_only=True)
        model = check_weights_loaded(NAME, torch, model, safetensors_names(folder / WEIGHTS))

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb, grid = row["left_rgb"], row["left_rgb"].shape[:2]
        with (
            translate_errors(NAME, torch, "inference failed"),
            torch.random.fork_rng(range(torch.cuda.device_count())),
        ):
            torch.manual_seed(SEED)
            network_output = np.asarray(model.inference([rgb]).depth, np.float32)
        if network_output.ndim != 3 or len(network_output) != 1:
            raise MethodError(
                f"{NAME}: the network returned depth of shape {network_output.shape}, expected 1 x h x w"
            )
        values, input_grid = (
            _resize_to_left_grid(torch, network_output[0], grid),
            (network_output.shape[1], network_output.shape[2]),
        )
        return da3_depth_m(values, da3_focal_px(row["left_K"], grid, input_grid))

    return predict


def _resize_to_left_grid(
    torch: Any, values: Float32[ndarray, "h w"], grid: tuple[int, int]
) -> Float32[ndarray, "H W"]:
    from rebar_depth_bench.methods.huggingface.families import resized

    return np.asarray(resized(torch.from_numpy(values), grid, "bilinear").numpy())


def check_preset(folder: Path) -> None:
    """Raise ``MethodError`` if ``config.json`` in a folder belongs to another model of the family."""
    preset = read_json_object(folder / CONFIG).get("model_name")
    if preset != PRESET:
        raise MethodError(
            f"{NAME}:{folder}: config.json names model {short_repr(preset)}, expected {PRESET!r}: only its output "
            "can be converted to metres with the focal length"
        )


DEPTH_ANYTHING_3_MODEL = HubModel(INFO, REPOSITORY, "depth_anything_3", INSTALL, load_predictor, check_preset)
DEPTH_ANYTHING_3 = lazy_hub_method(DEPTH_ANYTHING_3_MODEL)
"""Depth Anything 3 Metric as in the paper; loading takes the weights from the Hub or its cache."""
