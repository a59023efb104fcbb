"""Metric3D v2 (``metric3d_vit_small``) from one image and its focal length, with its authors' code.

The image is letterboxed: resized with its aspect ratio and centred in 616 x 1064 pixels of the mean colour. The
margins of the output are cropped, the rest is brought to the left grid bilinearly and converted from the canonical
camera to metres, as in ``hubconf.py``.

This method has never been run with the real network because its weights could not be downloaded. The code imports
mmcv or mmengine and requires a CUDA GPU in places; without one, the error message states this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.data.files import files_digest
from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import (
    Letterbox,
    crop_margins,
    fit_letterbox,
    metric3d_depth_m,
    padded,
)
from rebar_depth_bench.methods.monocular.hub import announce_download, download_error
from rebar_depth_bench.methods.monocular.third_party import (
    check_folder,
    image_tensor,
    import_torch,
    load_checkpoint,
    shape_error,
    torch_device,
    translate_errors,
    with_weights_digest,
)
from rebar_depth_bench.methods.transformers.model import resized

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
