"""FoundationStereo (``23-51-11``) on the rectified pair, with its authors' code; a raw pair is rectified first.

Input images are RGB with values 0 to 255, padded to multiples of 32 by repeating borders; 32 iterations are run,
as in ``scripts/run_demo.py``. A pixel has no prediction if its match would lie beyond the left border of the right
image, as in that script, or if its parallax is below one pixel.

This method has never been run with the real network because the weights could not be downloaded. When the network
is built, its code may download DINOv2's code (from GitHub, regardless of ``HF_HUB_OFFLINE``) and timm's
``edgenext_small`` (from the Hub); a notice is printed first if their caches are empty.
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError, exception_summary
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import crop_margins, margins_to_multiple, padded
from rebar_depth_bench.methods.monocular.third_party import (
    check_weights_loaded,
    import_package,
    import_torch,
    on_sys_path,
    torch_device,
    translate_errors,
    with_weights_digest,
)
from rebar_depth_bench.methods.stereo.disparity import STEREO_COLUMNS, stereo_depth_m
from rebar_depth_bench.reading import MAX_NESTING, read_file

NAME = "foundation-stereo"
CODE_FILE, SETTINGS_FILE, CHECKPOINT_FILE = "core/foundation_stereo.py", "cfg.yaml", "model_best_bp2.pth"
WEIGHTS_FOLDER = Path("pretrained_models", "23-51-11")
SIDE_MULTIPLE_PX, ITERATIONS = 32, 32
INSTALL_HINT = (
    "git clone https://github.com/NVlabs/FoundationStereo, put the folder 23-51-11 linked in its readme (Google "
    f"Drive) into FoundationStereo/{WEIGHTS_FOLDER.parent}, install its requirements, and pass the clone as "
    f"{NAME}:FoundationStereo"
)
INFO = MethodInfo(
    name=NAME,
    summary="FoundationStereo on the stereo pair, as in the paper",
    columns=STEREO_COLUMNS,
    uses_intrinsics=True,
    source="github.com/NVlabs/FoundationStereo, 23-51-11",
    licence="NVIDIA, research purposes only",
    untested_note="not tested with the real network: its code and weights were not available",
)


@dataclass(frozen=True)
class Installation:
    """Folders of a FoundationStereo installation.

    ``clone`` is a clone of the repository, ``weights`` a folder with a checkpoint and its ``cfg.yaml``.
    """

    clone: Path
    weights: Path


class _Settings(dict[str, Any]):
    """Dictionary with attribute access, which is all that the network requires of its settings."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{SETTINGS_FILE} has no {name}") from None


def foundation_stereo_method(folder: Path) -> Method:
    """Return FoundationStereo from a clone of its repository, or with other weights in a folder inside a clone.

    Raises ``MethodError`` if code, checkpoint or ``cfg.yaml`` is missing.
    """
    installation = _find_installation(folder)
    info = with_weights_digest(
        INFO,
        installation.weights.name,
        [installation.weights / CHECKPOINT_FILE, installation.weights / SETTINGS_FILE],
    )
    return Method(info, lambda: load_predictor(installation))


def load_predictor(installation: Installation) -> Predictor:
    """Return the predictor of an installation, on the GPU if torch finds one.

    Raises ``MethodError`` if torch, OpenCV or a module that its code imports is missing, or if the weights are
    incomplete.
    """
    torch = import_torch(NAME)
    import_package("cv2", NAME, "pip install 'rebar-depth-bench[methods]'")
    yaml = import_package("yaml", NAME, "pip install pyyaml")
    if downloads := _possible_downloads(torch):
        print(f"{NAME}: its code may download {' and '.join(downloads)}", file=sys.stderr, flush=True)
    with (
        translate_errors(NAME, torch, f"{installation.weights} cannot be loaded"),
        on_sys_path(installation.clone),
    ):
        settings = _read_settings(yaml, installation.weights / SETTINGS_FILE)
        settings.setdefault("vit_size", "vitl")
        code = importlib.import_module("core.foundation_stereo")
        _check_module_origin(code, installation.clone)
        checkpoint = torch.load(installation.weights / CHECKPOINT_FILE, map_location="cpu", weights_only=False)[
            "model"
        ]
        model = code.FoundationStereo(settings)
        model.load_state_dict(checkpoint)
        model = check_weights_loaded(NAME, torch, model, checkpoint)

    def match(left: UInt8[ndarray, "h w 3"], right: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        margins = margins_to_multiple((left.shape[0], left.shape[1]), SIDE_MULTIPLE_PX)
        cuda = torch.cuda.is_available()
        with (
            translate_errors(NAME, torch, "inference failed"),
            torch.inference_mode(),
            torch.autocast("cuda", enabled=cuda),
        ):
            pair = [_to_tensor(torch, padded(image, margins)) for image in (left, right)]
            disparity_px = model.forward(*pair, iters=ITERATIONS, test_mode=True)
            padded_px = disparity_px.float().cpu().numpy().reshape(pair[0].shape[-2:])
        return np.asarray(crop_margins(padded_px, margins), np.float32)

    return lambda row: stereo_depth_m(row, match)


def _read_settings(yaml: Any, path: Path) -> _Settings:
    """Return the content of a YAML file. Raises ``MethodError`` if it is no plain mapping.

    Aliases let a small file grow without bounds; the settings of the network have none.
    """
    text = read_file(path, TOML_BYTES, "a YAML file", MethodError)
    starts = (yaml.FlowSequenceStartToken, yaml.FlowMappingStartToken, yaml.BlockMappingStartToken)
    ends = (yaml.FlowSequenceEndToken, yaml.FlowMappingEndToken, yaml.BlockEndToken)
    depth = 0
    try:
        for token in yaml.scan(text):
            depth += isinstance(token, (*starts, yaml.BlockSequenceStartToken)) - isinstance(token, ends)
            if isinstance(token, yaml.AliasToken) or depth > MAX_NESTING:
                raise MethodError(
                    f"{path}: has an alias or more than {MAX_NESTING} levels, expected plain settings"
                )
        values = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise MethodError(f"{path}: cannot be read as YAML: {exception_summary(error)}") from None
    if not isinstance(values, dict):
        raise MethodError(f"{path}: is {type(values).__name__}, expected a mapping")
    return _Settings(values)


def _possible_downloads(torch: Any) -> list[str]:
    """Return descriptions of the files that the network's code downloads because they are not cached."""
    from huggingface_hub import constants

    downloads = []
    if not any(Path(torch.hub.get_dir()).glob("facebookresearch_dinov2_*")):
        downloads.append(
            "DINOv2's code (https://github.com/facebookresearch/dinov2, even if HF_HUB_OFFLINE is set), which is "
            "then executed,"
        )
    if not any(Path(constants.HF_HUB_CACHE).glob("models--timm--edgenext_small*")):
        downloads.append("timm's edgenext_small (from the Hub)")
    return downloads


def _to_tensor(torch: Any, rgb: UInt8[ndarray, "h w 3"]) -> Any:
    """Return an image as a 1 x 3 x h x w float32 tensor, values 0 to 255."""
    return torch.from_numpy(rgb.transpose(2, 0, 1).astype(np.float32))[None].to(torch_device(torch))


def _find_installation(folder: Path) -> Installation:
    """Return the clone and weights folders for a folder given by the user.

    Raises ``MethodError`` if code, checkpoint or settings are missing.
    """
    weights = folder if (folder / CHECKPOINT_FILE).is_file() else folder / WEIGHTS_FOLDER
    start = folder.resolve()
    clone = next((candidate for candidate in (start, *start.parents) if (candidate / CODE_FILE).is_file()), None)
    if not folder.is_dir() or clone is None:
        raise MethodError(
            f"{NAME}:{folder}: no clone of FoundationStereo with {CODE_FILE}; to install it: {INSTALL_HINT}"
        )
    for name in (CHECKPOINT_FILE, SETTINGS_FILE):
        if not (weights / name).is_file():
            raise MethodError(f"{NAME}:{folder}: no {name} in {weights}; to install it: {INSTALL_HINT}")
    return Installation(clone, weights)


def _check_module_origin(code: Any, clone: Path) -> None:
    """Raise ``MethodError`` if ``core`` was imported from another package of the same name."""
    if not Path(code.__file__).resolve().is_relative_to(clone.resolve()):
        raise MethodError(f"{NAME}: core is already imported from {code.__file__}, expected it from {clone}")


def _raise_without_folder() -> Predictor:
    """Raise ``MethodError`` with install instructions; the weights cannot be downloaded automatically."""
    raise MethodError(
        f"{NAME}: its weights are on Google Drive and cannot be downloaded automatically; to install it: "
        f"{INSTALL_HINT}"
    )


FOUNDATION_STEREO = Method(
    replace(INFO, summary=f"{INFO.summary}; a clone and weights of yours: {NAME}:FOLDER"), _raise_without_folder
)
"""FoundationStereo as in the paper, without a folder; loading raises an error with install instructions."""
