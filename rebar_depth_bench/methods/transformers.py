"""Monocular depth models of ``transformers``, named by their checkpoint: ``hf:ORG/NAME`` or ``hf:FOLDER``.

The meaning of the output is derived from ``config.json``, following the models' code in ``transformers`` 5.23.
Images are processed as the library does: depth is brought to the left grid by bilinear interpolation for Depth Pro
and by bicubic interpolation for the others. Between a bar and its background, interpolation produces depths that
lie on neither surface, as these models do for every user.

The processing of Depth Pro and the post-processing of ZoeDepth are implemented here, because those of the library
need torchvision. That of DPT and GLPN is the library's, ``post_process_depth_estimation``.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor, finite_or_nan, positive_or_nan
from rebar_depth_bench.methods.paper.third_party import (
    CONFIG,
    Network,
    hub_download,
    image_tensor,
    local_copy_hint,
    read_json_object,
    snapshot,
    torch_device,
)
from rebar_depth_bench.submission.declaration import METRIC

PREPROCESSOR = "preprocessor_config.json"
FAMILIES: Mapping[str, str] = {
    "depth_anything": "Depth Anything",
    "depth_pro": "Depth Pro",
    "dpt": "DPT",
    "glpn": "GLPN",
    "zoedepth": "ZoeDepth",
}
"""Display names of the supported families by ``model_type`` of ``config.json``."""
_UNSUPPORTED: Mapping[str, str] = {
    "chmv2": " (it estimates the height of trees, not depth)",
    "prompt_depth_anything": " (it completes measured depth, which a single image does not have)",
}
_METRES = "depth in metres, the camera's focal length not given"
_METRES_WITH_FOCAL = "depth in metres, the camera's focal length given"
_DISPARITY = "disparity up to scale and shift, aligned with the truth of each view when it is scored"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_WEIGHTS = ("*.safetensors", "*.bin")
"""File patterns of weights in order of preference; a checkpoint with both kinds holds the same weights twice."""
_EXPECTED = "a checkpoint folder as written by save_pretrained"
_INSTALL = install_command("models")
_DEPTH_PRO_CHECKPOINT = "apple/DepthPro-hf"


def hf_method(name_or_path: str) -> Method:
    """Return the method of a checkpoint: ``ORG/NAME`` on the Hub, or a folder written by ``save_pretrained``.

    ``config.json`` is read (and downloaded from the Hub if necessary) immediately because it determines whether
    the output is metric or relative; weights are downloaded by ``load``. Downloads are announced on standard
    error. The commit of a checkpoint of the Hub is in the summary.

    Raises ``MethodError`` if there is no such checkpoint or its model type is not supported.
    """
    folder, name, version = Path(name_or_path).expanduser(), name_or_path, ""
    is_local = bool(name_or_path) and folder.is_dir()
    if is_local:
        name = folder.resolve().name
    elif _REPOSITORY.fullmatch(name) and not Path(name).parent.is_dir():
        folder = snapshot(name, CONFIG, local_copy_hint("hf", name))
        version = f"; weights commit {folder.name}"
    else:
        raise MethodError(
            f"{name}: is neither a folder nor the name of a model on the Hub, expected a folder with {CONFIG}, or "
            "ORG/NAME where there is no folder ORG"
        )
    config = read_json_object(folder / CONFIG, _EXPECTED)
    model_type = config.get("model_type")
    if str(model_type) not in FAMILIES:
        found = f"model_type is {short_repr(model_type)}{_UNSUPPORTED.get(str(model_type), '')}"
        raise MethodError(f"{folder / CONFIG}: {found}, expected one of {', '.join(FAMILIES)}")
    is_depth_pro, is_relative = model_type == "depth_pro", False
    if model_type == "depth_anything":
        is_relative = config.get("depth_estimation_type", "relative") != "metric"
    elif (
        model_type == "dpt"
    ):  # MiDaS, except the metric heads that the authors of DINOv2 trained on NYU and KITTI.
        backbone = config.get("backbone_config")
        is_relative = not (isinstance(backbone, dict) and backbone.get("model_type") == "dinov2")
    meaning = _METRES_WITH_FOCAL if is_depth_pro else _DISPARITY if is_relative else _METRES
    info = MethodInfo(
        name=f"hf:{name}",
        summary=f"{FAMILIES[str(model_type)]} from one picture: {meaning}{version}",
        columns=("left_rgb", "left_K") if is_depth_pro else ("left_rgb",),
        uses_intrinsics=is_depth_pro,
        source=f"transformers, {name}",
        licence="that of the checkpoint",
        prediction="affine-disparity" if is_relative else METRIC,
    )
    network = Network(info, _INSTALL)

    def load() -> Predictor:
        torch = network.import_package("torch", _INSTALL)
        transformers = network.import_package("transformers", _INSTALL)
        has_weights = any(file.match(pattern) for pattern in _WEIGHTS for file in folder.iterdir())
        if not is_local and not (has_weights and (folder / PREPROCESSOR).is_file()):
            _download(name, folder.name)
        # At an input size other than that of training, a network silently performs worse: there are no defaults.
        settings = read_json_object(folder / PREPROCESSOR, _EXPECTED)
        with network.errors("cannot be loaded"):
            if not is_depth_pro:  # The processors on Pillow give the same results with and without torchvision.
                processor = transformers.AutoImageProcessor.from_pretrained(folder, backend="pil")
            model, loading = transformers.AutoModelForDepthEstimation.from_pretrained(
                folder, dtype="float32", output_loading_info=True, local_files_only=True
            )
            if missing := sorted(loading["missing_keys"]):  # The library leaves them at random values.
                raise MethodError(
                    f"{name}: the weights lack {len(missing)} of the network's tensors, first {missing[0]}, "
                    "expected all of them"
                )
            if is_depth_pro:
                model.use_fov_model = False  # This head estimates the focal length, which is known here.
                scale, size = settings.get("rescale_factor", 1 / 255), settings["size"]
                mean, std = np.asarray(settings["image_mean"]), np.asarray(settings["image_std"])
            model = model.to(torch_device()).eval()

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            rgb, interpolate = row["left_rgb"], torch.nn.functional.interpolate
            height, width = grid = rgb.shape[:2]
            with network.errors("inference failed"), torch.inference_mode():
                if is_depth_pro:  # As in the authors' code: normalised, then resized to a square.
                    planes = image_tensor((rgb * np.float64(scale) - mean) / std).contiguous()
                    pixels = interpolate(planes, (size["height"], size["width"]), mode="bilinear")
                else:
                    options = {"return_tensors": "pt", "input_data_format": "channels_last"}
                    pixels = processor(images=rgb, **options).pixel_values.float()
                output = model(pixel_values=pixels.to(model.device))
                output.predicted_depth = output.predicted_depth.float().cpu()
                raw = output.predicted_depth[None, :1]
                if is_depth_pro:
                    on_grid = interpolate(raw, grid, mode="bilinear")[0, 0]
                elif model_type == "zoedepth":  # Its processor pads each border by so many mirrored pixels.
                    top, left = (int(3 * np.sqrt(side / 2)) if processor.do_pad else 0 for side in grid)
                    padded = interpolate(raw, (height + 2 * top, width + 2 * left), mode="bicubic")[0, 0]
                    on_grid = padded[top : top + height, left : left + width]
                else:
                    [processed] = processor.post_process_depth_estimation(output, target_sizes=[grid])
                    on_grid = processed["predicted_depth"]
                values = np.asarray(on_grid.numpy())
            if is_relative:
                return finite_or_nan(values)
            if is_depth_pro:
                # The inverse depth of a camera whose focal length is the image width; W and fx are those of the
                # left grid, not of the square. Depth lies between 0.1 mm and 10 km.
                values = 1 / np.clip(values.astype(np.float64) * (width / row["left_K"][0, 0]), 1e-4, 1e4)
            return positive_or_nan(values)

        return predict

    return Method(info, load)


def _download(repository: str, commit: str) -> None:
    """Download weights (of one kind only) and settings of a checkpoint of the Hub, after a notice.

    Raises ``MethodError`` if the download fails.
    """
    from huggingface_hub import HfApi, snapshot_download

    with hub_download(repository, "the weights", local_copy_hint("hf", repository)):
        files = HfApi().model_info(repository, revision=commit, files_metadata=True).siblings or []
        sizes = {file.rfilename: file.size or 0 for file in files if "/" not in file.rfilename}
        patterns = [pattern for pattern in _WEIGHTS if any(Path(name).match(pattern) for name in sizes)]
        wanted = (*patterns[:1], "*.json")
        names = [name for name in sizes if any(Path(name).match(pattern) for pattern in wanted)]
        print(f"{repository}: {sum(sizes[name] for name in names) / 1e6:.1f} MB", file=sys.stderr, flush=True)
        snapshot_download(repository, revision=commit, allow_patterns=names)


def depth_pro_method(folder: Path | None) -> Method:
    """Return the checkpoint in a folder, or for None Depth Pro as in the paper from the Hub; see ``hf_method``."""
    if folder is not None:
        return hf_method(str(folder))
    method = hf_method(_DEPTH_PRO_CHECKPOINT)
    return replace(method, info=replace(DEPTH_PRO.info, summary=method.info.summary))


DEPTH_PRO = Network(
    MethodInfo(
        name="depth-pro",
        summary=f"Depth Pro from one picture: {_METRES_WITH_FOCAL}, as in the paper",
        columns=("left_rgb", "left_K"),
        uses_intrinsics=True,
        source=f"transformers, {_DEPTH_PRO_CHECKPOINT}",
        licence="Apple's own; it comes with the weights",
        untested_note="not tested with the real weights: they were not available",
    ),
    _INSTALL,
).listed(depth_pro_method, "own weights: hf:FOLDER")
"""Depth Pro as in the paper; loading takes the weights from the Hub or its cache."""
