"""Monocular depth models of ``transformers``, named by their checkpoint: ``hf:ORG/NAME`` or ``hf:FOLDER``.

The meaning of the output is derived from ``config.json``, following the models' code in ``transformers`` 5.23;
this and the conversion to metres do not need torch. Images are processed as the library does: depth is brought
to the left grid by bilinear interpolation for Depth Pro and by bicubic interpolation for the others. Between a
bar and its background, interpolation produces depths that lie on neither surface, as these models do for every
user.

The processing of Depth Pro and the post-processing of ZoeDepth are implemented here, because those of the library
need torchvision. That of DPT and GLPN is the library's, ``post_process_depth_estimation``.

Downloads from the Hub are always announced on standard error.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Float64, UInt8
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, install_command
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.methods.base import (
    Method,
    MethodInfo,
    Predictor,
    files_digest,
    finite_or_nan,
    positive_or_nan,
)
from rebar_depth_bench.methods.paper.third_party import (
    CONFIG,
    Network,
    hub_download,
    image_tensor,
    local_copy_hint,
    read_json_object,
    resampled,
    snapshot,
    torch_device,
)
from rebar_depth_bench.submission.declaration import METRIC

if TYPE_CHECKING:
    from torch import Tensor


PREFIX = "hf"
"""What the names of these methods begin with, before a colon."""
PREPROCESSOR = "preprocessor_config.json"
_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_WEIGHTS = ("*.safetensors", "*.bin")
"""File patterns of weights in order of preference; a checkpoint with both kinds holds the same weights twice."""


@dataclass(frozen=True)
class Checkpoint:
    """Folder with ``config.json``, and its parsed content.

    ``repository`` is the name on the Hub if the folder is a cached snapshot, else None. ``version`` is the digest
    of a local folder or the commit of a snapshot.
    """

    name: str
    folder: Path
    repository: str | None
    version: str
    config: Mapping[str, Any]


def find_checkpoint(name_or_path: str) -> Checkpoint:
    """Return the checkpoint in a local folder, or ``ORG/NAME`` on the Hub.

    At most ``config.json`` is downloaded here. The version of a local folder is the digest of its weights, that of
    a Hub checkpoint its commit.

    Raises ``MethodError`` if neither exists, or it has no readable ``config.json``.
    """
    folder = Path(name_or_path).expanduser()
    if name_or_path and folder.is_dir():
        config = read_settings(folder / CONFIG)
        return Checkpoint(folder.resolve().name, folder, None, _weights_digest(folder), config)
    if not _REPOSITORY.fullmatch(name_or_path) or Path(name_or_path).parent.is_dir():
        raise MethodError(
            f"{name_or_path}: is neither a folder nor the name of a model on the Hub, expected a folder with "
            f"{CONFIG}, or ORG/NAME where there is no folder ORG"
        )
    folder = snapshot(name_or_path, CONFIG, local_copy_hint(PREFIX, name_or_path))
    return Checkpoint(name_or_path, folder, name_or_path, f"commit {folder.name}", read_settings(folder / CONFIG))


def ensure_weights(checkpoint: Checkpoint) -> None:
    """Download weights (of one kind only) and settings of a Hub checkpoint if they are not cached, after a notice.

    Raises ``MethodError`` if the download fails or the checkpoint has no weights.
    """
    repository, folder = checkpoint.repository, checkpoint.folder
    is_complete = _weight_files(folder) and (folder / PREPROCESSOR).is_file()
    if repository and not is_complete:
        from huggingface_hub import HfApi, snapshot_download

        with hub_download(repository, "the weights", local_copy_hint(PREFIX, repository)):
            files = HfApi().model_info(repository, revision=folder.name, files_metadata=True).siblings or []
            sizes = {file.rfilename: file.size or 0 for file in files if "/" not in file.rfilename}
            found = (pattern for pattern in _WEIGHTS if any(Path(name).match(pattern) for name in sizes))
            pattern = next(found, _WEIGHTS[0])
            names = [name for name in sizes if Path(name).match(pattern) or name.endswith(".json")]
            megabytes = sum(sizes[name] for name in names) / 1e6
            print(f"{repository}: {megabytes:.1f} MB", file=sys.stderr, flush=True)
            snapshot_download(repository, revision=folder.name, allow_patterns=names)
    if not _weight_files(folder):
        raise MethodError(f"{checkpoint.name}: no weights, expected {' or '.join(_WEIGHTS)} beside {CONFIG}")


def _weight_files(folder: Path) -> list[Path]:
    """Return the weight files of the first pattern that matches; empty if there are none."""
    return next((paths for pattern in _WEIGHTS if (paths := sorted(folder.glob(pattern)))), [])


def _weights_digest(folder: Path) -> str:
    """Return the digest of config, pre-processing settings and weights, which determine the predictions."""
    files = [folder / CONFIG, folder / PREPROCESSOR, *_weight_files(folder)]
    return f"sha256:{files_digest(path for path in files if path.is_file())}"


def read_settings(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file of a checkpoint. Raises ``MethodError`` if it is missing or unreadable.

    There are no default values: at an input size other than that of training, a network silently performs worse.
    """
    if not path.exists():
        raise MethodError(
            f"{path.parent}: no {path.name}, expected a checkpoint folder as written by save_pretrained"
        )
    return read_json_object(path)


_INSTALL = install_command("models")
DEPTH_PRO_CHECKPOINT = "apple/DepthPro-hf"
INVERSE_DEPTH_BOUNDS_PER_M = (1e-4, 1e4)
"""Bounds of Depth Pro's inverse depth, 1/m: depth between 0.1 mm and 10 km."""
ZOE_PADDING_FACTOR = 3
"""ZoeDepth pads each border by int(3 sqrt(side / 2)) mirrored pixels."""

FAMILIES: Mapping[str, str] = {
    "depth_anything": "Depth Anything",
    "depth_pro": "Depth Pro",
    "dpt": "DPT",
    "glpn": "GLPN",
    "zoedepth": "ZoeDepth",
}
"""Display names of the supported families by ``model_type`` of ``config.json``."""
_UNSUPPORTED: Mapping[str, str] = {
    "chmv2": "it estimates the height of trees, not depth",
    "prompt_depth_anything": "it completes measured depth, which a single image does not have",
}


class OutputKind(Enum):
    """Meaning of a network's output; the value is the text shown to users."""

    METRES = "depth in metres, the camera's focal length not given"
    INVERSE = "disparity up to scale and shift, aligned with the truth of each view when it is scored"
    CANONICAL = "depth in metres, the camera's focal length given"

    @property
    def prediction(self) -> str:
        """Kind of the predictions, one of ``PREDICTION_KINDS``."""
        return "affine-disparity" if self is OutputKind.INVERSE else METRIC


def hf_method(name_or_path: str) -> Method:
    """Return the method of a checkpoint: ``ORG/NAME`` on the Hub, or a folder written by ``save_pretrained``.

    ``config.json`` is read (and downloaded from the Hub if necessary) immediately because it determines whether
    the output is metric or relative; weights are downloaded by ``load``. Downloads are announced on standard
    error.

    Raises ``MethodError`` if there is no such checkpoint or its model type is not supported.
    """
    checkpoint = find_checkpoint(name_or_path)
    model_type = checkpoint.config.get("model_type")
    family, unsupported = FAMILIES.get(str(model_type)), _UNSUPPORTED.get(str(model_type))
    if family is None:
        reason = f" ({unsupported})" if unsupported else ""
        raise MethodError(
            f"{checkpoint.folder / CONFIG}: model_type is {short_repr(model_type)}{reason}, expected one of "
            f"{', '.join(FAMILIES)}"
        )
    output = output_kind(checkpoint.config)
    info = MethodInfo(
        name=f"{PREFIX}:{checkpoint.name}",
        summary=f"{family} from one picture: {output.value}; weights {checkpoint.version}",
        columns=("left_rgb", "left_K") if output is OutputKind.CANONICAL else ("left_rgb",),
        uses_intrinsics=output is OutputKind.CANONICAL,
        source=f"transformers, {checkpoint.name}",
        licence="that of the checkpoint",
        prediction=output.prediction,
    )
    return Method(info, lambda: _load_predictor(Network(info, _INSTALL), checkpoint, output))


DEPTH_PRO = Method(
    MethodInfo(
        name="depth-pro",
        summary=f"Depth Pro from one picture: {OutputKind.CANONICAL.value}, as in the paper; "
        "own weights: hf:FOLDER",
        columns=("left_rgb", "left_K"),
        uses_intrinsics=True,
        source=f"transformers, {DEPTH_PRO_CHECKPOINT}",
        licence="Apple's own; it comes with the weights",
        untested_note="not tested with the real weights: they were not available",
    ),
    lambda: hf_method(DEPTH_PRO_CHECKPOINT).load(),
)
"""Depth Pro as in the paper; loading takes the weights from the Hub or its cache."""


def depth_pro_method() -> Method:
    """Return Depth Pro as in the paper, with the commit of its weights in the summary.

    Raises like ``hf_method``.
    """
    method = hf_method(DEPTH_PRO_CHECKPOINT)
    return replace(method, info=replace(DEPTH_PRO.info, summary=method.info.summary))


def output_kind(config: Mapping[str, Any]) -> OutputKind:
    """Return the meaning of the output of a supported checkpoint by its ``config.json``.

    Depth Anything has metric and relative checkpoints. DPT is relative (MiDaS) except on DINOv2 backbones:
    those are the metric heads that the authors of DINOv2 trained on NYU and KITTI.
    """
    match config["model_type"]:
        case "depth_pro":
            return OutputKind.CANONICAL
        case "depth_anything":
            is_metric = config.get("depth_estimation_type", "relative") == "metric"
        case "dpt":
            backbone = config.get("backbone_config")
            is_metric = isinstance(backbone, dict) and backbone.get("model_type") == "dinov2"
        case _:
            is_metric = True
    return OutputKind.METRES if is_metric else OutputKind.INVERSE


def network_output_to_prediction(
    output: OutputKind, values: Float[ndarray, "h w"], K: Float64[ndarray, "3 3"] | None = None
) -> Float32[ndarray, "h w"]:
    """Return planar depth in metres; relative disparity as it is.

    ``values`` is the network output on the left grid. ``K`` holds the intrinsics of that grid in pixels and is
    required for canonical output, the inverse depth C of a camera whose focal length equals the image width:
    z = 1 / (C * W / fx), where W and fx belong to the left grid, not to the square image which the network
    receives (A. Bochkovskii et al., "Depth Pro", ICLR 2025, and the model's post-processing).

    Depths that are not finite or not above 0 become NaN, which means no prediction.
    """
    if output is OutputKind.INVERSE:
        return finite_or_nan(values)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if output is OutputKind.CANONICAL:
            assert K is not None
            inverse_per_m = values.astype(np.float64) * (values.shape[1] / K[0, 0])
            values = 1 / np.clip(inverse_per_m, *INVERSE_DEPTH_BOUNDS_PER_M)
    return positive_or_nan(values)


def _load_predictor(network: Network, checkpoint: Checkpoint, output: OutputKind) -> Predictor:
    """Return the predictor of a checkpoint, on the GPU if torch finds one.

    Raises ``MethodError`` if torch, ``transformers`` or weights are missing, or if the weights are incomplete.
    """
    network.import_package("torch", _INSTALL)
    transformers = network.import_package("transformers", _INSTALL)
    ensure_weights(checkpoint)
    model_type, settings = checkpoint.config["model_type"], read_settings(checkpoint.folder / PREPROCESSOR)
    with network.errors("cannot be loaded"):
        if model_type == "depth_pro":
            processor, to_network_input = None, depth_pro_preprocessing(settings)
        else:  # The processors on Pillow give the same results with and without torchvision.
            processor = transformers.AutoImageProcessor.from_pretrained(checkpoint.folder, backend="pil")
            options = {"return_tensors": "pt", "input_data_format": "channels_last"}

            def to_network_input(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
                pixels: Tensor = processor(images=rgb, **options).pixel_values
                return pixels.float()

        model = _load_network(transformers, checkpoint).to(torch_device())

    def infer(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        rgb = row["left_rgb"]
        network_output = model(pixel_values=to_network_input(rgb).to(model.device))
        network_output.predicted_depth = network_output.predicted_depth.float().cpu()
        values = to_left_grid(model_type, processor, network_output, rgb.shape[:2])
        return network_output_to_prediction(output, np.asarray(values.numpy()), row.get("left_K"))

    return network.predictor(infer)


def depth_pro_preprocessing(
    settings: Mapping[str, Any],
) -> Callable[[UInt8[ndarray, "H W 3"]], Float[Tensor, "1 3 h w"]]:
    """Return Depth Pro's pre-processing by ``preprocessor_config.json``: normalise, then resize to a square.

    The image is resized bilinearly, as in the authors' code. Raises ``MethodError`` if a setting is missing.
    """
    try:
        size, mean, std = settings["size"], settings["image_mean"], settings["image_std"]
    except KeyError as error:
        raise MethodError(f"Depth Pro: preprocessor_config.json has no {error}") from None
    scale = settings.get("rescale_factor", 1 / 255)

    def to_network_input(rgb: UInt8[ndarray, "H W 3"]) -> Float[Tensor, "1 3 h w"]:
        from torch.nn import functional

        planes = image_tensor((rgb * np.float64(scale) - np.asarray(mean)) / np.asarray(std)).contiguous()
        target = (size["height"], size["width"])
        return functional.interpolate(planes, size=target, mode="bilinear", align_corners=False)

    return to_network_input


def to_left_grid(
    model_type: str, processor: Any, network_output: Any, grid: tuple[int, int]
) -> Float[Tensor, "H W"]:
    """Return the depth of a network's output object on the left grid, (H, W).

    The mirrored borders that the processor of ZoeDepth adds are cropped after resizing.
    """
    raw_depth = network_output.predicted_depth[0]
    if model_type == "depth_pro":
        return resampled(raw_depth, grid, "bilinear")
    if model_type == "zoedepth":
        top, left = (int(ZOE_PADDING_FACTOR * np.sqrt(side / 2)) if processor.do_pad else 0 for side in grid)
        padded = resampled(raw_depth, (grid[0] + 2 * top, grid[1] + 2 * left), "bicubic")
        return padded[top : top + grid[0], left : left + grid[1]]
    [processed] = processor.post_process_depth_estimation(network_output, target_sizes=[grid])
    depth: Tensor = processed["predicted_depth"]
    return depth


def _load_network(transformers: Any, checkpoint: Checkpoint) -> Any:
    """Return the network in evaluation mode.

    Raises ``MethodError`` if weights are missing, which ``transformers`` itself would leave at random values.
    """
    model, loading_info = transformers.AutoModelForDepthEstimation.from_pretrained(
        checkpoint.folder, dtype="float32", output_loading_info=True, local_files_only=True
    )
    missing = sorted(loading_info["missing_keys"])
    if missing:
        raise MethodError(
            f"{checkpoint.name}: the weights lack {len(missing)} of the network's tensors, first {missing[0]}, "
            "expected all of them"
        )
    if getattr(model, "use_fov_model", False):
        model.use_fov_model = False  # The field-of-view head estimates the focal length, which is known here.
    return model.eval()
