"""UniDepth v2 from one picture, with its authors' package; the camera is not given.

Its network finds a camera of its own, pads and resizes the picture and its answer itself; depth along the optical
axis is its ``depth``, along the ray its ``radius``. It runs at its default resolution bounds.

Never run here with the real network: its weights could not be fetched and its package needs torchvision.
Read off ``unidepth/models/unidepthv2/unidepthv2.py`` of its repository.
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
from rebar_depth_bench.methods.monocular.hub import WEIGHTS, HubModel, listed_method
from rebar_depth_bench.methods.monocular.third_party import (
    error_words,
    filled,
    package,
    safetensors_names,
    torch_for,
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
    unexercised="never run with the real network where this was written: its code and weights were not to be had",
)


def load_predictor(folder: Path) -> Predictor:
    """Load the network of a folder, on the GPU if torch sees one.

    Raises ``MethodError`` where torch or the package is missing, or weights that fill the network.
    """
    torch = torch_for(NAME)
    models = package("unidepth.models", NAME, INSTALL)
    with error_words(NAME, torch, f"{folder.name} cannot be loaded"):
        model = models.UniDepthV2.from_pretrained(str(folder), local_files_only=True)
        model = filled(NAME, torch, model, safetensors_names(folder / WEIGHTS))

    def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        planes = torch.from_numpy(row["left_rgb"].transpose(2, 0, 1).copy())
        with error_words(NAME, torch, "fails on a picture"), torch.inference_mode():
            found = model.infer(planes)["depth"]
            depth_m = np.asarray(found.float().cpu().numpy())
        if depth_m.shape != (1, 1, *row["left_rgb"].shape[:2]):
            raise MethodError(
                f"{NAME}: the network returned depth of shape {depth_m.shape}, expected 1 x 1 and the picture's "
                f"{row['left_rgb'].shape[:2]}"
            )
        return positive_or_nan(depth_m[0, 0])

    return run


UNIDEPTH_MODEL = HubModel(INFO, REPOSITORY, "unidepth", INSTALL, load_predictor)
UNIDEPTH = listed_method(UNIDEPTH_MODEL)
"""The paper's UniDepth v2. Its weights come from the Hub, or its cache, when it is loaded."""
