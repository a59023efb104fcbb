"""FoundationStereo (``23-51-11``) on the rectified pair, with its authors' code; a raw pair is rectified first.

Input images are RGB with values 0 to 255, padded to multiples of 32 by repeating borders; 32 iterations are run,
as in ``scripts/run_demo.py``. A pixel has no prediction if its match would lie beyond the left border of the right
image that the network receives, as in that script, or if its parallax is below one pixel.

The cost volume ends at ``max_disp`` of ``cfg.yaml`` (416 px for ``23-51-11``), the range of its training. The demo
has two options that extend the range: ``--hiera 1`` starts a pass at full size from the result of a pass at half
the size, and ``--scale`` makes the images smaller. The choice follows from the largest expected disparity:

- One pass at full size, where the volume holds the largest expected disparity.
- Two passes (hierarchical) where it holds half of it. The second pass has the full resolution; at disparities
  beyond the end of the volume it refines with the correlation of the two images' features alone.
- Two passes on smaller images otherwise, as large as the volume of the first pass allows.

The largest expected disparity comes from one of two sources:

- by default half of the image width, the search range of ``sgbm``: at 1280 x 720 this is 640 px, more than the
  volume holds, and the mode is hierarchical, which the authors recommend for images above 1000 px;
- the distance of the nearest surface if the user declares one, from the sensor's range or the planned capture.

Neither is ground truth. The camera distances of a config's protocol are not used, because the poses of scored
views are ground truth; a distance that the user measured in scored depth, masks, meshes or poses would be as well.
The paper does not state its mode.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from rebar_depth_bench.base.errors import MethodError, Problem, install_command
from rebar_depth_bench.base.limits import TOML_BYTES
from rebar_depth_bench.base.reading import read_file
from rebar_depth_bench.base.terminal import print_notice
from rebar_depth_bench.base.validation import short_repr
from rebar_depth_bench.captures.documents import parse_document
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.paper.third_party import (
    Network,
    image_tensor,
    on_sys_path,
    scaled_image,
    torch_device,
)
from rebar_depth_bench.methods.sgbm import (
    SEARCH_SHARE_OF_WIDTH,
    STEREO_COLUMNS,
    largest_disparity_px,
    rectified_row,
    stereo_depth_m,
    without_invisible,
)

NAME = "foundation-stereo"
CODE_FILE, SETTINGS_FILE, CHECKPOINT_FILE = "core/foundation_stereo.py", "cfg.yaml", "model_best_bp2.pth"
WEIGHTS_FOLDER = Path("pretrained_models", "23-51-11")
INSTALL_HINT = (
    "git clone https://github.com/NVlabs/FoundationStereo, put the folder 23-51-11 linked in its readme (Google "
    f"Drive) into FoundationStereo/{WEIGHTS_FOLDER.parent}, install its requirements, and pass the clone as "
    f"{NAME}:FoundationStereo"
)
SMALL_RATIO = 0.5
"""Size of the first of two passes, relative to the second."""
NETWORK = Network(
    MethodInfo(
        name=NAME,
        summary="FoundationStereo on the stereo pair, as in the paper",
        columns=STEREO_COLUMNS,
        uses_intrinsics=True,
        source="github.com/NVlabs/FoundationStereo, 23-51-11",
        licence="NVIDIA, research purposes only",
        untested_note=(
            "run only with its authors' code and random weights on a CPU, in a single pass: its weights were not "
            "available"
        ),
    ),
    install="pip install open3d trimesh pandas joblib imageio timm torchvision",
)


class Settings(dict[str, Any]):
    """Dictionary with attribute access, which is all that the network requires of its settings."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{SETTINGS_FILE} has no {name}") from None


def foundation_stereo_method(folder: Path | None, nearest_m: float | None = None) -> Method:
    """Return FoundationStereo from a clone of its repository, or with other weights in a folder inside a clone.

    ``nearest_m`` is the declared distance of the nearest surface, metres, which chooses the mode (see the module).
    Raises ``MethodError`` if code, checkpoint or ``cfg.yaml`` is missing or invalid, and with install instructions
    if ``folder`` is None, because the weights cannot be downloaded automatically.
    """
    if folder is None:
        found = "its weights are on Google Drive and cannot be downloaded automatically"
        raise MethodError(f"{NAME}: {found}; to install it: {INSTALL_HINT}")
    weights = folder if (folder / CHECKPOINT_FILE).is_file() else folder / WEIGHTS_FOLDER
    start = folder.resolve()
    clone = next((candidate for candidate in (start, *start.parents) if (candidate / CODE_FILE).is_file()), None)
    if not folder.is_dir() or clone is None:
        found = f"no clone of FoundationStereo with {CODE_FILE}"
        raise MethodError(f"{NAME}:{folder}: {found}; to install it: {INSTALL_HINT}")
    for file in (CHECKPOINT_FILE, SETTINGS_FILE):
        if not (weights / file).is_file():
            raise MethodError(f"{NAME}:{folder}: no {file} in {weights}; to install it: {INSTALL_HINT}")
    path, problems = weights / SETTINGS_FILE, list[Problem]()
    content = read_file(path, TOML_BYTES, "a YAML file", MethodError)
    settings = Settings(parse_document(path.name, content, problems))
    if problems:
        raise MethodError.from_problems(path, problems)
    settings.setdefault("vit_size", "vitl")
    volume_px = settings.get("max_disp")
    if type(volume_px) is not int or volume_px <= 0:
        expected = "expected the end of the cost volume, whole pixels"
        raise MethodError(f"{path}: max_disp is {short_repr(volume_px)}, {expected}")
    declared = "" if nearest_m is None else f", nearest distance {nearest_m} m"
    name = f"{NAME}:{weights.resolve().name}"
    info = replace(NETWORK.info, name=name, summary=f"{NETWORK.info.summary}{declared}")

    def load() -> Predictor:
        torch = NETWORK.import_package("torch", install_command("torch"))
        NETWORK.import_package("cv2", install_command("methods"))
        print_notice(
            f"{NAME}: its code downloads what is not cached: DINOv2's code (https://github.com/facebookresearch/"
            "dinov2, even if HF_HUB_OFFLINE is set), which is then executed, and timm's edgenext_small (from the "
            "Hub)"
        )
        with NETWORK.errors(f"{weights} cannot be loaded"), on_sys_path(clone):
            code = importlib.import_module("core.foundation_stereo")
            if not Path(str(code.__file__)).resolve().is_relative_to(clone):
                raise MethodError(
                    f"{NAME}: core is already imported from {code.__file__}, expected it from {clone}"
                )
            model = code.FoundationStereo(settings)
            model = NETWORK.load_checkpoint(model, weights / CHECKPOINT_FILE, "model")

        def match(rectified: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            is_hierarchical, scale = choose_passes(largest_disparity_px(rectified, nearest_m), volume_px)
            # The demo rounds to the nearest whole side; rounding down never enlarges the disparity.
            images = [scaled_image(rectified[name], scale) for name in ("left_rgb", "right_rgb")]
            pair = [image_tensor(image).to(torch_device()) for image in images]
            padder = code.InputPadder(pair[0].shape, divis_by=32, force_square=False)
            options = {"iters": 32, "test_mode": True}
            with torch.autocast("cuda", enabled=torch.cuda.is_available()):
                if is_hierarchical:  # Spelled so by its authors.
                    disparity_px = model.run_hierachical(*padder.pad(*pair), small_ratio=SMALL_RATIO, **options)
                else:
                    disparity_px = model.forward(*padder.pad(*pair), **options)
            cropped_px = padder.unpad(disparity_px.float()).cpu().numpy().reshape(pair[0].shape[-2:])
            return full_size_disparity_px(without_invisible(cropped_px), rectified["left_rgb"].shape[:2])

        def predict(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
            with NETWORK.errors("inference failed"), torch.inference_mode():
                return stereo_depth_m(row, match)

        return predict

    def notes(row: Mapping[str, Any]) -> dict[str, Any]:
        largest_px = largest_disparity_px(rectified_row(row)[0], nearest_m)
        is_hierarchical, scale = choose_passes(largest_px, volume_px)
        from_width = f"{SEARCH_SHARE_OF_WIDTH:g} of the width"
        return {
            "mode": "hierarchical" if is_hierarchical else "single pass",
            "scale": round(scale, 4),
            "largest_disparity_px": round(largest_px, 1),
            "largest_disparity_from": from_width if nearest_m is None else f"nearest distance {nearest_m} m",
            "cost_volume_px": volume_px,
        }

    return Method(info, load, notes)


def choose_passes(largest_px: float, volume_px: int) -> tuple[bool, float]:
    """Return whether there are two passes (hierarchical), and the largest scale of the images, at most 1.

    A cost volume of ``volume_px`` then holds ``largest_px``, the largest expected disparity.
    """
    if largest_px <= volume_px:
        return False, 1.0
    return True, min(1.0, volume_px / (SMALL_RATIO * largest_px))


def full_size_disparity_px(
    disparity_px: Float32[ndarray, "hs ws"], grid: tuple[int, ...]
) -> Float32[ndarray, "h w"]:
    """Return a resized image's disparity on the original ``grid`` = (H, W), in pixels of that grid.

    Each pixel takes the disparity of the resized pixel that contains its centre, because interpolation would place
    surfaces between a bar and its background. The factor is that of the widths, which rounding moves away from
    ``scale``.
    """
    rows, columns = (
        ((np.arange(full) + 0.5) * small / full).astype(np.int64)
        for full, small in zip(grid, disparity_px.shape, strict=True)
    )
    factor = np.float32(grid[1] / disparity_px.shape[1])
    return np.asarray(disparity_px[rows[:, None], columns] * factor, np.float32)


FOUNDATION_STEREO = NETWORK.listed(
    foundation_stereo_method,
    "hierarchical, and on smaller images, where half of the width or --nearest-distance gives disparities beyond "
    f"its cost volume; a clone and weights of yours: {NAME}:FOLDER",
)
"""FoundationStereo as in the paper, without a folder; loading raises an error with install instructions."""
