"""FoundationStereo (``23-51-11``) on the rectified pair, with its authors' code; a raw pair is rectified first.

Input images are RGB with values 0 to 255, padded to multiples of 32 by repeating borders; 32 iterations are run,
as in ``scripts/run_demo.py``. A pixel has no prediction if its match would lie beyond the left border of the right
image, as in that script, or if its parallax is below one pixel.

The cost volume ends at ``max_disp`` of ``cfg.yaml`` (416 px for ``23-51-11``), the range of its training. A single
pass, hierarchical mode or smaller images are chosen from the largest expected disparity (``stereo.passes``), which
comes from one of two sources:

- by default half of the image width, the search range of ``sgbm``: at 1280 x 720 this is 640 px, more than the
  volume holds, and the mode is hierarchical, which the authors recommend for images above 1000 px;
- the distance of the nearest surface if the user declares one, from the sensor's range or the planned capture.

Neither is ground truth. The camera distances of a config's protocol are not used, because the poses of scored
views are ground truth; a distance that the user measured in scored depth, masks, meshes or poses would be as well.
The paper does not state its mode.

This method has never been run with the real network because the weights could not be downloaded. When the network
is built, its code may download DINOv2's code (from GitHub, regardless of ``HF_HUB_OFFLINE``) and timm's
``edgenext_small`` (from the Hub); a notice is printed first if their caches are empty.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray

from rebar_depth_bench.captures.documents import parse_document
from rebar_depth_bench.errors import MethodError, Problem
from rebar_depth_bench.limits import TOML_BYTES
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import crop_margins, margins_to_multiple, padded
from rebar_depth_bench.methods.monocular.third_party import (
    image_tensor,
    import_package,
    import_torch,
    load_checkpoint,
    on_sys_path,
    torch_device,
    translate_errors,
    with_weights_digest,
)
from rebar_depth_bench.methods.stereo.disparity import (
    SEARCH_SHARE_OF_WIDTH,
    STEREO_COLUMNS,
    StereoImages,
    largest_disparity_px,
    rectified_images,
    stereo_depth_m,
)
from rebar_depth_bench.methods.stereo.passes import SMALL_RATIO, choose_passes, full_size_disparity_px, resized
from rebar_depth_bench.reading import read_file
from rebar_depth_bench.validation import short_repr

NAME = "foundation-stereo"
CODE_FILE, SETTINGS_FILE, CHECKPOINT_FILE = "core/foundation_stereo.py", "cfg.yaml", "model_best_bp2.pth"
WEIGHTS_FOLDER = Path("pretrained_models", "23-51-11")
INSTALL_HINT = (
    "git clone https://github.com/NVlabs/FoundationStereo, put the folder 23-51-11 linked in its readme (Google "
    f"Drive) into FoundationStereo/{WEIGHTS_FOLDER.parent}, install its requirements, and pass the clone as "
    f"{NAME}:FoundationStereo"
)
SIDE_MULTIPLE_PX, ITERATIONS = 32, 32
INFO = MethodInfo(
    name=NAME,
    summary="FoundationStereo on the stereo pair, as in the paper",
    columns=STEREO_COLUMNS,
    uses_intrinsics=True,
    source="github.com/NVlabs/FoundationStereo, 23-51-11",
    licence="NVIDIA, research purposes only",
    untested_note="not tested with the real network: its code and weights were not available",
)


class Settings(dict[str, Any]):
    """Dictionary with attribute access, which is all that the network requires of its settings."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{SETTINGS_FILE} has no {name}") from None


def foundation_stereo_method(folder: Path, nearest_m: float | None = None) -> Method:
    """Return FoundationStereo from a clone of its repository, or with other weights in a folder inside a clone.

    ``nearest_m`` is the declared distance of the nearest surface, metres, which chooses the mode (see the module).
    Raises ``MethodError`` if code, checkpoint or ``cfg.yaml`` is missing.
    """
    weights = folder if (folder / CHECKPOINT_FILE).is_file() else folder / WEIGHTS_FOLDER
    start = folder.resolve()
    clone = next((candidate for candidate in (start, *start.parents) if (candidate / CODE_FILE).is_file()), None)
    if not folder.is_dir() or clone is None:
        raise MethodError(
            f"{NAME}:{folder}: no clone of FoundationStereo with {CODE_FILE}; to install it: {INSTALL_HINT}"
        )
    files = [weights / CHECKPOINT_FILE, weights / SETTINGS_FILE]
    for file in files:
        if not file.is_file():
            raise MethodError(f"{NAME}:{folder}: no {file.name} in {weights}; to install it: {INSTALL_HINT}")
    nearest = "" if nearest_m is None else f", nearest distance {nearest_m} m"
    info = with_weights_digest(replace(INFO, summary=f"{INFO.summary}{nearest}"), weights.name, files)
    return Method(info, partial(load_predictor, clone, weights, nearest_m), partial(_notes, weights, nearest_m))


def load_predictor(clone: Path, weights: Path, nearest_m: float | None = None) -> Predictor:
    """Return the predictor with the code of a clone and a folder of weights, on the GPU if torch finds one.

    Raises ``MethodError`` if torch, OpenCV or a module that its code imports is missing, or if the weights are
    incomplete.
    """
    torch = import_torch(NAME)
    import_package("cv2", NAME, "pip install 'rebar-depth-bench[methods]'")
    settings = _read_settings(weights)
    model = _load_network(torch, clone, weights, settings)

    def match(images: StereoImages) -> ndarray:
        passes = choose_passes(largest_disparity_px(images, nearest_m), settings.max_disp)
        left, right = (resized(image, passes.scale) for image in (images.left_rgb, images.right_rgb))
        margins = margins_to_multiple((left.shape[0], left.shape[1]), SIDE_MULTIPLE_PX)
        with (
            translate_errors(NAME, torch, "inference failed"),
            torch.inference_mode(),
            torch.autocast("cuda", enabled=torch.cuda.is_available()),
        ):
            pair = [image_tensor(torch, padded(image, margins)).to(torch_device(torch)) for image in (left, right)]
            if passes.hierarchical:  # Spelled so by its authors.
                disparity_px = model.run_hierachical(
                    *pair, iters=ITERATIONS, test_mode=True, small_ratio=SMALL_RATIO
                )
            else:
                disparity_px = model.forward(*pair, iters=ITERATIONS, test_mode=True)
            padded_px = disparity_px.float().cpu().numpy().reshape(pair[0].shape[-2:])
        cropped_px = np.asarray(crop_margins(padded_px, margins), np.float32)
        return full_size_disparity_px(cropped_px, (images.left_rgb.shape[0], images.left_rgb.shape[1]))

    return partial(stereo_depth_m, match=match)


def _read_settings(weights: Path) -> Settings:
    """Return the network's settings. Raises ``MethodError`` if they or the end of its cost volume are invalid."""
    path, problems = weights / SETTINGS_FILE, list[Problem]()
    settings = Settings(
        parse_document(path.name, read_file(path, TOML_BYTES, "a YAML file", MethodError), problems)
    )
    if problems:
        raise MethodError.from_problems(path, problems)
    settings.setdefault("vit_size", "vitl")
    volume_px = settings.get("max_disp")
    if type(volume_px) is not int or volume_px <= 0:
        raise MethodError(
            f"{path}: max_disp is {short_repr(volume_px)}, expected the end of the cost volume, whole pixels"
        )
    return settings


def _load_network(torch: Any, clone: Path, weights: Path, settings: Settings) -> Any:
    """Return the network with its weights, after a notice of the files that its code may download."""
    if downloads := _possible_downloads(torch):
        print(f"{NAME}: its code may download {' and '.join(downloads)}", file=sys.stderr, flush=True)
    with translate_errors(NAME, torch, f"{weights} cannot be loaded"), on_sys_path(clone):
        code = importlib.import_module("core.foundation_stereo")
        if not Path(str(code.__file__)).resolve().is_relative_to(clone.resolve()):
            raise MethodError(f"{NAME}: core is already imported from {code.__file__}, expected it from {clone}")
        network = code.FoundationStereo(settings)
        return load_checkpoint(NAME, torch, network, weights / CHECKPOINT_FILE, "model")


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


def _notes(weights: Path, nearest_m: float | None, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mode and scale for a row, with the numbers from which they are chosen."""
    volume_px = _read_settings(weights).max_disp
    largest_px = largest_disparity_px(rectified_images(row)[0], nearest_m)
    passes = choose_passes(largest_px, volume_px)
    declared = (
        f"{SEARCH_SHARE_OF_WIDTH:g} of the width" if nearest_m is None else f"nearest distance {nearest_m} m"
    )
    return {
        "mode": passes.mode,
        "scale": round(passes.scale, 4),
        "largest_disparity_px": round(largest_px, 1),
        "largest_disparity_from": declared,
        "cost_volume_px": volume_px,
    }


def _raise_without_folder() -> Predictor:
    """Raise ``MethodError`` with install instructions; the weights cannot be downloaded automatically."""
    raise MethodError(
        f"{NAME}: its weights are on Google Drive and cannot be downloaded automatically; to install it: "
        f"{INSTALL_HINT}"
    )


FOUNDATION_STEREO = Method(
    replace(
        INFO,
        summary=(
            f"{INFO.summary}; hierarchical, and on smaller images, where half of the width or --nearest-distance "
            f"gives disparities beyond its cost volume; a clone and weights of yours: {NAME}:FOLDER"
        ),
    ),
    _raise_without_folder,
)
"""FoundationStereo as in the paper, without a folder; loading raises an error with install instructions."""
