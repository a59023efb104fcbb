"""Metric3D v2 (``metric3d_vit_small``) from one picture, with its authors' code; the focal length is given.

The picture is resized with its ratio kept, in the middle of 616 x 1064 pixels of mean colour; the answer is cut
out, brought to the left grid bilinearly and from the canonical camera to metres, as in ``hubconf.py``.

Never run here with the real network: its weights could not be fetched. Its code imports mmcv or mmengine, and asks
for a CUDA GPU in places; without one that is said in words.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.data.digests import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import (
    Fit,
    fit_keeping_ratio,
    metric3d_depth_m,
    padded,
    without_margins,
)
from rebar_depth_bench.methods.monocular.hub import announce, unavailable
from rebar_depth_bench.methods.monocular.third_party import (
    check_folder,
    device,
    error_words,
    filled,
    torch_for,
    with_weights,
)

NAME, ENTRY = "metric3d", "metric3d_vit_small"
REPOSITORY, CACHED_AS = "yvanyin/metric3d:main", "yvanyin_metric3d_main"
CHECKPOINT = "metric_depth_vit_small_800k.pth"
WEIGHTS_URL = f"https://huggingface.co/JUGGHM/Metric3D/resolve/main/{CHECKPOINT}"
HUBCONF = "hubconf.py"
TARGET = (616, 1064)
MEAN_RGB, STD_RGB = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)
MARGIN_RGB = (124, 116, 104)
"""The mean in whole numbers, as OpenCV writes it into a picture."""
INSTEAD = f"{NAME}:FOLDER, a clone of github.com/YvanYin/Metric3D with {CHECKPOINT} in it"
INFO = MethodInfo(
    name=NAME,
    summary="Metric3D v2 (ViT-small) from one picture: depth in metres, the focal length given, as in the paper",
    columns=("left_rgb", "left_K"),
    uses_intrinsics=True,
    source=f"github.com/YvanYin/Metric3D, {ENTRY}",
    licence="BSD-2-Clause",
    unexercised="never run with the real network where this was written: its code and weights were not to be had",
)


def metric3d_method(folder: Path) -> Method:
    """Return Metric3D v2 of a clone of its repository, with the checkpoint in it or in its folder ``weight``.

    Raises ``MethodError`` for a folder without them.
    """
    check_folder(folder, NAME, (HUBCONF,))
    places = (folder / CHECKPOINT, folder / "weight" / CHECKPOINT)
    checkpoint = next((place for place in places if place.is_file()), None)
    if checkpoint is None:
        raise MethodError(
            f"{NAME}:{folder}: no {CHECKPOINT} in it or in its weight/, expected that of {WEIGHTS_URL}"
        )
    return Method(
        with_weights(INFO, folder.resolve().name, [checkpoint]), lambda: load_predictor(folder, checkpoint)
    )


def load_predictor(folder: Path, checkpoint: Path) -> Predictor:
    """Load the network of a folder with ``hubconf.py``, on the GPU if torch sees one.

    Raises ``MethodError`` where torch, or what that code imports, is missing, or weights that fill the network.
    """
    torch = torch_for(NAME)
    with error_words(NAME, torch, f"{folder.name} cannot be loaded"):
        model = torch.hub.load(str(folder), ENTRY, source="local", pretrain=False)
        weights = torch.load(checkpoint, map_location="cpu", weights_only=False)["model_state_dict"]
        model.load_state_dict(weights, strict=False)
        model = filled(NAME, torch, model, weights)

    def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        grid = row["left_rgb"].shape[:2]
        fit = fit_keeping_ratio(grid, TARGET)
        with error_words(NAME, torch, "fails on a picture"), torch.inference_mode():
            found = model.inference({"input": network_input(row["left_rgb"], fit).to(device(torch))})[0]
            seen = found.float().cpu().reshape(found.shape[-2:])
        if tuple(seen.shape) != TARGET:
            raise MethodError(
                f"{NAME}: the network returned depth of shape {tuple(seen.shape)}, expected {TARGET}"
            )
        canonical = _resized(torch, without_margins(seen, fit.margins)[None, None], grid)[0, 0]
        return metric3d_depth_m(np.asarray(canonical.numpy()), row["left_K"], fit.scale)

    return run


def network_input(rgb: UInt8[ndarray, "H W 3"], fit: Fit) -> Any:
    """Return the picture as the network takes it: a tensor of 1 x 3 x 616 x 1064, normalised. Needs torch.

    Source: ``hubconf.py`` of Metric3D, with torch's bilinear interpolation for OpenCV's, which is the same.
    """
    torch = torch_for(NAME)
    planes = torch.from_numpy(rgb.transpose(2, 0, 1).astype(np.float32))[None]
    small = _resized(torch, planes, (fit.height_px, fit.width_px))[0].round().numpy().transpose(1, 2, 0)
    picture = (padded(small, fit.margins, MARGIN_RGB) - MEAN_RGB) / STD_RGB
    return torch.from_numpy(picture.astype(np.float32).transpose(2, 0, 1).copy())[None]


def _resized(torch: Any, planes: Any, grid: tuple[int, int]) -> Any:
    return torch.nn.functional.interpolate(planes, size=grid, mode="bilinear", align_corners=False)


def cached_metric3d_method() -> Method:
    """Return Metric3D v2 of torch.hub's cache; what is not in it is fetched, and said first.

    torch.hub takes the main branch and keeps no commit of it: the summary names its folder, and the digests of the
    Python files in it and of the checkpoint. They are not to be known before both are there.

    Raises ``MethodError`` where torch is missing, or what is not to be had.
    """
    torch = torch_for(NAME)
    cache = Path(torch.hub.get_dir())
    folder, checkpoint = cache / CACHED_AS, cache / "checkpoints" / CHECKPOINT
    if not (folder / HUBCONF).is_file():
        where = "https://github.com/YvanYin/Metric3D"
        announce(NAME, "its code, which is then run,", where, INSTEAD)
        with error_words(NAME, torch, f"its code of {where} cannot be fetched or run; {INSTEAD}"):
            torch.hub.load(REPOSITORY, ENTRY, pretrain=False, trust_repo=True)
    if not checkpoint.is_file():
        announce(NAME, "the weights", WEIGHTS_URL, INSTEAD)
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        try:
            torch.hub.download_url_to_file(WEIGHTS_URL, str(checkpoint), progress=False)
        except OSError as error:
            raise unavailable(NAME, WEIGHTS_URL, error, INSTEAD) from None
    code = files_digest(sorted(folder.rglob("*.py")))
    versions = f"code {CACHED_AS} sha256:{code}; weights sha256:{files_digest([checkpoint])}"
    info = replace(INFO, summary=f"{INFO.summary}; {versions}")
    return Method(info, lambda: load_predictor(folder, checkpoint))


METRIC3D = Method(
    replace(INFO, summary=f"{INFO.summary}; own clone and weights: {NAME}:FOLDER"),
    lambda: cached_metric3d_method().load(),
)
"""The paper's Metric3D v2. torch.hub fetches its code, which is run, and its weights when it is loaded."""
