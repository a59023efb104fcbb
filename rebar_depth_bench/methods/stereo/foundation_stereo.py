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
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
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
from rebar_depth_bench.methods.stereo.disparity import (
    SEARCH_SHARE_OF_WIDTH,
    STEREO_COLUMNS,
    Matcher,
    StereoImages,
    largest_disparity_px,
    rectified_images,
    stereo_depth_m,
)
from rebar_depth_bench.methods.stereo.foundation_stereo_files import (
    CHECKPOINT_FILE,
    INSTALL_HINT,
    NAME,
    SETTINGS_FILE,
    Installation,
    find_installation,
    read_settings,
)
from rebar_depth_bench.methods.stereo.passes import (
    SMALL_RATIO,
    Passes,
    choose_passes,
    full_size_disparity_px,
    resized,
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


def foundation_stereo_method(folder: Path, nearest_m: float | None = None) -> Method:
    """Return FoundationStereo from a clone of its repository, or with other weights in a folder inside a clone.

    ``nearest_m`` is the declared distance of the nearest surface, metres, which chooses the mode (see the module).
    Raises ``MethodError`` if code, checkpoint or ``cfg.yaml`` is missing.
    """
    installation = find_installation(folder)
    nearest = "" if nearest_m is None else f", nearest distance {nearest_m} m"
    info = with_weights_digest(
        replace(INFO, summary=f"{INFO.summary}{nearest}"),
        installation.weights.name,
        [installation.weights / CHECKPOINT_FILE, installation.weights / SETTINGS_FILE],
    )
    return Method(
        info,
        load=partial(load_predictor, installation, nearest_m),
        notes=partial(_notes, installation, nearest_m),
    )


def load_predictor(installation: Installation, nearest_m: float | None = None) -> Predictor:
    """Return the predictor of an installation, on the GPU if torch finds one.

    Raises ``MethodError`` if torch, OpenCV or a module that its code imports is missing, or if the weights are
    incomplete.
    """
    torch = import_torch(NAME)
    import_package("cv2", NAME, "pip install 'rebar-depth-bench[methods]'")
    settings = read_settings(installation)
    if downloads := _possible_downloads(torch):
        print(f"{NAME}: its code may download {' and '.join(downloads)}", file=sys.stderr, flush=True)
    with (
        translate_errors(NAME, torch, f"{installation.weights} cannot be loaded"),
        on_sys_path(installation.clone),
    ):
        code = importlib.import_module("core.foundation_stereo")
        _check_module_origin(code, installation.clone)
        checkpoint = torch.load(installation.weights / CHECKPOINT_FILE, map_location="cpu", weights_only=False)[
            "model"
        ]
        model = code.FoundationStereo(settings)
        model.load_state_dict(checkpoint)
        model = check_weights_loaded(NAME, torch, model, checkpoint)

    def passes_of(images: StereoImages) -> Passes:
        return choose_passes(largest_disparity_px(images, nearest_m), settings.max_disp)

    return partial(stereo_depth_m, match=_matcher(torch, model, passes_of))


def _matcher(torch: Any, model: Any, passes_of: Callable[[StereoImages], Passes]) -> Matcher:
    """Return the matcher that runs a loaded network with the passes chosen for the images."""

    def match(images: StereoImages) -> ndarray:
        passes = passes_of(images)
        left, right = (resized(image, passes.scale) for image in (images.left_rgb, images.right_rgb))
        margins = margins_to_multiple((left.shape[0], left.shape[1]), SIDE_MULTIPLE_PX)
        cuda = torch.cuda.is_available()
        with (
            translate_errors(NAME, torch, "inference failed"),
            torch.inference_mode(),
            torch.autocast("cuda", enabled=cuda),
        ):
            pair = [_to_tensor(torch, padded(image, margins)) for image in (left, right)]
            if passes.hierarchical:  # Spelled so by its authors.
                disparity_px = model.run_hierachical(
                    *pair, iters=ITERATIONS, test_mode=True, small_ratio=SMALL_RATIO
                )
            else:
                disparity_px = model.forward(*pair, iters=ITERATIONS, test_mode=True)
            padded_px = disparity_px.float().cpu().numpy().reshape(pair[0].shape[-2:])
        cropped_px = np.asarray(crop_margins(padded_px, margins), np.float32)
        return full_size_disparity_px(cropped_px, (images.left_rgb.shape[0], images.left_rgb.shape[1]))

    return match


def _notes(installation: Installation, nearest_m: float | None, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the mode and scale for a row, with the numbers from which they are chosen."""
    volume_px = read_settings(installation).max_disp
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
