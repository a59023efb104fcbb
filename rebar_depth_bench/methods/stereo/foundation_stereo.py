"""FoundationStereo (``23-51-11``) on the rectified pair, with its authors' code; a raw pair is rectified first.

Pictures go in as RGB of 0 to 255, their sides brought to multiples of 32 by repeating borders, 32 iterations, as
in ``scripts/run_demo.py``. Where the match lies left of the right picture there is no answer, as in that script; a
parallax below a pixel is none either.

Never run here with the real network: its weights could not be fetched. When it is built, its code may fetch that
of DINOv2 (GitHub, which knows nothing of ``HF_HUB_OFFLINE``) and timm's ``edgenext_small`` (the Hub): where their
caches hold nothing of the kind, that is said first.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from rebar_depth_bench.errors import MethodError
from rebar_depth_bench.methods.base import Method, MethodInfo, Predictor
from rebar_depth_bench.methods.monocular.conversions import margins_to_multiple, padded, without_margins
from rebar_depth_bench.methods.monocular.third_party import (
    device,
    error_words,
    filled,
    importable,
    package,
    torch_for,
    with_weights,
)
from rebar_depth_bench.methods.stereo.disparity import STEREO_COLUMNS, stereo_depth_m

NAME = "foundation-stereo"
CODE, SETTINGS, CHECKPOINT = "core/foundation_stereo.py", "cfg.yaml", "model_best_bp2.pth"
WEIGHTS = Path("pretrained_models", "23-51-11")
STEP_PX, ITERATIONS = 32, 32
HOW = (
    "git clone https://github.com/NVlabs/FoundationStereo, put the folder 23-51-11 that its readme links (Google "
    f"Drive) into FoundationStereo/{WEIGHTS.parent}, install its requirements, and name it: "
    f"{NAME}:FoundationStereo"
)
INFO = MethodInfo(
    name=NAME,
    summary="FoundationStereo on the stereo pair, as in the paper",
    columns=STEREO_COLUMNS,
    uses_intrinsics=True,
    source="github.com/NVlabs/FoundationStereo, 23-51-11",
    licence="NVIDIA, research purposes only",
    unexercised="never run with the real network where this was written: its code and weights were not to be had",
)


@dataclass(frozen=True)
class Installation:
    """A clone of the repository, and a folder with a checkpoint and its ``cfg.yaml``."""

    clone: Path
    weights: Path


class _Settings(dict[str, Any]):
    """A mapping whose keys are attributes too: all that the network asks of its settings."""

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"{SETTINGS} has no {name}") from None


def foundation_stereo_method(place: Path) -> Method:
    """Return FoundationStereo of a clone of its repository, or with other weights of a folder below a clone.

    Raises ``MethodError`` where code, checkpoint or ``cfg.yaml`` is missing.
    """
    found = _installation(place)
    info = with_weights(INFO, found.weights.name, [found.weights / CHECKPOINT, found.weights / SETTINGS])
    return Method(info, lambda: load_predictor(found))


def load_predictor(found: Installation) -> Predictor:
    """Load the network, on the GPU if torch sees one.

    Raises ``MethodError`` where torch, OpenCV or what its code imports is missing, or weights that fill it.
    """
    torch = torch_for(NAME)
    package("cv2", NAME, "pip install 'rebar-depth-bench[methods]'")
    yaml = package("yaml", NAME, "pip install pyyaml")
    if fetches := _may_fetch(torch):
        print(f"{NAME}: its code may fetch {' and '.join(fetches)}", file=sys.stderr, flush=True)
    with error_words(NAME, torch, f"{found.weights} cannot be loaded"), importable(found.clone):
        settings = _Settings(yaml.safe_load((found.weights / SETTINGS).read_text(encoding="utf-8")))
        settings.setdefault("vit_size", "vitl")
        code = importlib.import_module("core.foundation_stereo")
        _check_origin(code, found.clone)
        checkpoint = torch.load(found.weights / CHECKPOINT, map_location="cpu", weights_only=False)["model"]
        model = code.FoundationStereo(settings)
        model.load_state_dict(checkpoint)
        model = filled(NAME, torch, model, checkpoint)

    def match(left: UInt8[ndarray, "h w 3"], right: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
        margins = margins_to_multiple((left.shape[0], left.shape[1]), STEP_PX)
        cuda = torch.cuda.is_available()
        with (
            error_words(NAME, torch, "fails on a pair"),
            torch.inference_mode(),
            torch.autocast("cuda", enabled=cuda),
        ):
            pair = [_pixels(torch, padded(eye, margins)) for eye in (left, right)]
            found_px = model.forward(*pair, iters=ITERATIONS, test_mode=True)
            seen_px = found_px.float().cpu().numpy().reshape(pair[0].shape[-2:])
        return np.asarray(without_margins(seen_px, margins), np.float32)

    def run(row: Mapping[str, Any]) -> Float32[ndarray, "h w"]:
        return stereo_depth_m(row, match)

    return run


def _may_fetch(torch: Any) -> list[str]:
    """Return what its code asks for when it is built and no cache has anything of, in words."""
    from huggingface_hub import constants

    found = []
    if not any(Path(torch.hub.get_dir()).glob("facebookresearch_dinov2_*")):
        found.append(
            "DINOv2's code (https://github.com/facebookresearch/dinov2, whatever HF_HUB_OFFLINE says), which is "
            "then run,"
        )
    if not any(Path(constants.HF_HUB_CACHE).glob("models--timm--edgenext_small*")):
        found.append("timm's edgenext_small (the Hub)")
    return found


def _pixels(torch: Any, rgb: UInt8[ndarray, "h w 3"]) -> Any:
    """Return 1 x 3 x h x w, 0 to 255."""
    return torch.from_numpy(rgb.transpose(2, 0, 1).astype(np.float32))[None].to(device(torch))


def _installation(place: Path) -> Installation:
    weights = place if (place / CHECKPOINT).is_file() else place / WEIGHTS
    start = place.resolve()
    clone = next((folder for folder in (start, *start.parents) if (folder / CODE).is_file()), None)
    if not place.is_dir() or clone is None:
        raise MethodError(f"{NAME}:{place}: no clone of FoundationStereo with {CODE}, expected: {HOW}")
    for name in (CHECKPOINT, SETTINGS):
        if not (weights / name).is_file():
            raise MethodError(f"{NAME}:{place}: no {name} in {weights}, expected: {HOW}")
    return Installation(clone, weights)


def _check_origin(code: Any, clone: Path) -> None:
    """Refuse another package that is called ``core`` as well."""
    if not Path(code.__file__).resolve().is_relative_to(clone.resolve()):
        raise MethodError(f"{NAME}: core is imported from {code.__file__} already, expected it from {clone}")


def _cannot_be_fetched() -> Predictor:
    raise MethodError(f"{NAME}: its weights lie on Google Drive and cannot be fetched from here: {HOW}")


FOUNDATION_STEREO = Method(
    replace(INFO, summary=f"{INFO.summary}; a clone and weights of yours: {NAME}:FOLDER"), _cannot_be_fetched
)
"""The paper's FoundationStereo, without a folder: says what to clone and download."""
