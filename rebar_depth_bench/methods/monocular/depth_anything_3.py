"""Depth Anything 3 Metric from one picture, with its authors' package; the focal length is given.

The package resizes the picture (long side 504, both sides to multiples of 14); its answer is brought to the left
grid bilinearly. Sky is left as the package fills it, from a random sample: torch's numbers are seeded for each
view.

Run here with the package's own code (0.1.1, a stand-in for torchvision) and a small network of random numbers,
which a test repeats where the package is installed; never with its weights, which could not be fetched.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import da3_depth_m, da3_focal_px
from rebar_depth_bench.methods.monocular.hub import CONFIG, WEIGHTS, HubModel, listed_method
from rebar_depth_bench.methods.monocular.third_party import (
    error_words,
    filled,
    package,
    safetensors_names,
    torch_for,
)

NAME, REPOSITORY = "depth-anything-3", "depth-anything/DA3METRIC-LARGE"
PRESET = "da3metric-large"
"""Only this network's output becomes metres by the focal length: others are relative, or metres already."""
SEED = 1
INSTALL = "pip install depth-anything-3"
INFO = MethodInfo(
    name=NAME,
    summary="Depth Anything 3 Metric from one picture: depth in metres, the focal length given, as in the paper",
    columns=("left_rgb", "left_K"),
    uses_intrinsics=True,
    source=f"depth-anything-3, {REPOSITORY}",
    licence="Apache-2.0",
    unexercised="tried with its real code and a small random network only: its weights were not to be had",
)


def load_predictor(folder: Path) -> Predictor:
    """Load the network of a folder, on the GPU if torch sees one.

    Raises ``MethodError`` where torch or the package is missing, or weights that fill the network.
    """
    torch = torch_for(NAME)
    api = package("depth_anything_3.api", NAME, INSTALL)
    with error_words(NAME, torch, f"{folder.name} cannot be loaded"):
        model = api.DepthAnything3.from_pretrained(str(folder), local_files_only=True)
        model = filled(NAME, torch, model, safetensors_names(folder / WEIGHTS))

    def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb, grid = row["left_rgb"], row["left_rgb"].shape[:2]
        with (
            error_words(NAME, torch, "fails on a picture"),
            torch.random.fork_rng(range(torch.cuda.device_count())),
        ):
            torch.manual_seed(SEED)
            seen = np.asarray(model.inference([rgb]).depth, np.float32)
        if seen.ndim != 3 or len(seen) != 1:
            raise MethodError(f"{NAME}: the network returned depth of shape {seen.shape}, expected 1 x h x w")
        values, values_grid = _on_left_grid(torch, seen[0], grid), (seen.shape[1], seen.shape[2])
        return da3_depth_m(values, da3_focal_px(row["left_K"], grid, values_grid))

    return run


def _on_left_grid(torch: Any, seen: Float32[ndarray, "h w"], grid: tuple[int, int]) -> Float32[ndarray, "H W"]:
    from rebar_depth_bench.methods.huggingface.families import resized

    return np.asarray(resized(torch.from_numpy(seen), grid, "bilinear").numpy())


def check_preset(folder: Path) -> None:
    """Raise ``MethodError`` where a folder's ``config.json`` is that of another model of the family."""
    try:
        preset = json.loads((folder / CONFIG).read_text(encoding="utf-8")).get("model_name")
    except (OSError, ValueError, AttributeError) as error:
        raise MethodError(f"{folder / CONFIG}: cannot be read as a JSON object: {error}") from None
    if preset != PRESET:
        raise MethodError(
            f"{NAME}:{folder}: config.json names model {preset!r}, expected {PRESET!r}: only its output becomes "
            "metres by the focal length"
        )


DEPTH_ANYTHING_3_MODEL = HubModel(INFO, REPOSITORY, "depth_anything_3", INSTALL, load_predictor, check_preset)
DEPTH_ANYTHING_3 = listed_method(DEPTH_ANYTHING_3_MODEL)
"""The paper's Depth Anything 3 Metric. Its weights come from the Hub, or its cache, when it is loaded."""
