"""UniDepth v2 from one image without intrinsics, with its authors' package.

The network estimates the camera itself and pads and resizes image and output. Its ``depth`` is planar depth along
the optical axis, its ``radius`` the distance along the ray. It runs at its default resolution bounds.

This method has never been run with the real network: its weights could not be downloaded and its package needs
torchvision. Written after ``unidepth/models/unidepthv2/unidepthv2.py`` of its repository.
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
from rebar_depth_bench.methods.monocular.conversions import positive_or_nan
from rebar_depth_bench.methods.monocular.hub import WEIGHTS, HubModel, lazy_hub_method
from rebar_depth_bench.methods.monocular.third_party import (
    check_weights_loaded,
    import_package,
    import_torch,
    safetensors_names,
    translate_errors,
)

NAME, REPOSITORY = "unidepth", "lpiccinelli/unidepth-v2-vitl14"
INSTALL = "pip install 'unidepth @ git+https://github.com/lpiccinelli-eth/UniDepth'"
INFO = MethodInfo(
    name=NAME,
    summary="UniDepth v2 from one picture: depth in metres, the camera not given, as in the paper",
    columns=("left_rgb",),
    uses_intrinsics=False,
    source=f"github.com/lpiccinelli-eth/UniDepth, {REPOSITORY}",
    licence="CC BY-NC 4.0",
    untested_note="not tested with the real network: its code and weights were not available",
)


def load_predictor(folder: Path) -> Predictor:
    """Return the predictor of the network in a folder, on the GPU if torch finds one.

    Raises ``MethodError`` if torch or the package is missing, or if the weights are incomplete.
    """
    torch = import_torch(NAME)
    models = import_package("unidepth.models", NAME, INSTALL)
    with translate_errors(NAME, torch, f"{folder.name} cannot be loaded"):
        model = models.UniDepthV2.from_pretrained(str(folder), local_files_only=True)
        model = check_weights_loaded(NAME, torch, model, safetensors_names(folder / WEIGHTS))

    def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        planes = torch.from_numpy(row["left_rgb"].transpose(2, 0, 1).copy())
        with translate_errors(NAME, torch, "inference failed"), torch.inference_mode():
            raw_output = model.infer(planes)["depth"]
            depth_m = np.asarray(raw_output.float().cpu().numpy())
        if depth_m.shape != (1, 1, *row["left_rgb"].shape[:2]):
            raise MethodError(
                f"{NAME}: the network returned depth of shape {depth_m.shape}, expected 1 x 1 and the image's "
                f"{row['left_rgb'].shape[:2]}"
            )
        return positive_or_nan(depth_m[0, 0])

    return predict


UNIDEPTH_MODEL = HubModel(INFO, REPOSITORY, "unidepth", INSTALL, load_predictor)
UNIDEPTH = lazy_hub_method(UNIDEPTH_MODEL)
"""UniDepth v2 as in the paper; loading takes the weights from the Hub or its cache."""
