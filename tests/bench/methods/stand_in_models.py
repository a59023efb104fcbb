"""Stand-ins for third-party depth networks that are not available in the test environment.

A stand-in has the public interface of the original network and returns the red channel times its only weight. The
tests write its code into a folder with the layout of the original; none of it comes from the original authors. The
tests therefore cover only what this project does around a network: units, resizing and back, and missing parts.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np

from rebar_depth_bench.methods.paper.third_party import on_sys_path

GAIN = 0.5
"""Factor by which every stand-in multiplies the red channel: its only weight, read from the checkpoint."""
FX, FY, BASELINE_M = 87.5, 80.0, 0.12

METRIC3D_HUBCONF = """
    dependencies = ["torch"]
    import torch

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.zeros(()))

        def inference(self, data):
            pixels = data["input"]
            assert pixels.shape == (1, 3, 616, 1064) and pixels.dtype == torch.float32
            red = pixels[:, :1] * 58.395 + 123.675
            return self.gain * red, torch.ones_like(red), {}

    def metric3d_vit_small(pretrain=False, **kwargs):
        assert not pretrain
        return Net()
"""

UNIDEPTH_MODELS = """
    import torch
    from huggingface_hub import PyTorchModelHubMixin

    class UniDepthV2(torch.nn.Module, PyTorchModelHubMixin):
        def __init__(self, config, **kwargs):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.zeros(()))

        def infer(self, rgb, camera=None, normalize=True):
            assert rgb.dtype == torch.uint8 and rgb.ndim == 3 and rgb.shape[0] == 3 and camera is None
            depth = self.gain * rgb[None, :1].float()
            return {"depth": depth, "radius": 1.2 * depth, "intrinsics": torch.eye(3)[None]}
"""

DEPTH_ANYTHING_3_API = """
    from types import SimpleNamespace
    import numpy as np
    import torch
    from huggingface_hub import PyTorchModelHubMixin
    from PIL import Image

    class DepthAnything3(torch.nn.Module, PyTorchModelHubMixin):
        def __init__(self, model_name, **kwargs):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.zeros(()))

        def inference(self, images):
            [rgb] = images
            assert rgb.dtype == np.uint8
            red = Image.fromarray(rgb[..., 0]).resize((504, 280), Image.Resampling.BILINEAR)
            noise = 1e-3 * torch.rand(1).item()
            return SimpleNamespace(depth=(self.gain.item() + noise) * np.asarray(red, np.float32)[None])
"""
"""Code of a stand-in for Depth Anything 3, whose sky is as random as that of the original."""

INPUT_PADDER = """
    import torch.nn.functional as F

    class InputPadder:
        def __init__(self, dims, mode="sintel", divis_by=8, force_square=False):
            assert divis_by == 32 and not force_square
            rows, columns = (-side % divis_by for side in dims[-2:])
            self.margins = (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2)

        def pad(self, *images):
            return [F.pad(image, self.margins, mode="replicate") for image in images]

        def unpad(self, image):
            left, right, top, bottom = self.margins
            return image[..., top : image.shape[-2] - bottom, left : image.shape[-1] - right]
"""

FOUNDATION_STEREO = """
    import torch
    from core.utils.utils import InputPadder

    class FoundationStereo(torch.nn.Module):
        def __init__(self, args):
            super().__init__()
            assert args.vit_size == "vitl" and args["max_disp"] == 416 and args.get("low_memory", 0) == 0
            self.gain = torch.nn.Parameter(torch.zeros(()))

        def forward(self, image1, image2, iters=12, flow_init=None, test_mode=False):
            assert image1.shape == image2.shape and image1.dtype == torch.float32
            assert image1.shape[2] % 32 == image1.shape[3] % 32 == 0
            assert iters == 32 and test_mode and image1.max() > 1
            return self.gain * image1[:, :1]

        def run_hierachical(self, image1, image2, iters=12, test_mode=False, low_memory=False, small_ratio=0.5):
            assert small_ratio == 0.5
            return 2 * self.forward(image1, image2, iters, test_mode=test_mode)
"""
"""Code of a stand-in for FoundationStereo, whose hierarchical mode returns twice the disparity."""


def metric3d_clone(folder: Path, gain: float = GAIN, key: str = "gain") -> Path:
    """Write a clone of Metric3D that contains its checkpoint, and return the folder."""
    _write(folder / "hubconf.py", METRIC3D_HUBCONF)
    _pickle(folder / "metric_depth_vit_small_800k.pth", {"model_state_dict": _tensors(gain, key)})
    return folder


def unidepth_weights(folder: Path, gain: float = GAIN, key: str = "gain") -> Path:
    """Write UniDepth's files as they are on the Hub, and return the folder."""
    return _write_hub_folder(folder, {"model": {"pixel_encoder": {"name": "dinov2_vitl14"}}}, gain, key)


def da3_weights(folder: Path, gain: float = GAIN, key: str = "gain") -> Path:
    """Write Depth Anything 3's files as they are on the Hub, and return the folder."""
    return _write_hub_folder(folder, {"model_name": "da3metric-large"}, gain, key)


def stereo_clone(folder: Path, gain: float = GAIN, key: str = "gain") -> Path:
    """Write a clone of FoundationStereo with its weights folder 23-51-11, and return the folder."""
    _write(folder / "core" / "foundation_stereo.py", FOUNDATION_STEREO)
    _write(folder / "core" / "utils" / "utils.py", INPUT_PADDER)
    trained = folder / "pretrained_models" / "23-51-11"
    _write(trained / "cfg.yaml", "max_disp: 416\nhidden_dims: [128, 128, 128]\n")
    _pickle(trained / "model_best_bp2.pth", {"model": _tensors(gain, key), "global_step": 1})
    return folder


BUILDERS: Mapping[str, Callable[..., Path]] = {
    "depth-anything-3": da3_weights,
    "foundation-stereo": stereo_clone,
    "metric3d": metric3d_clone,
    "unidepth": unidepth_weights,
}
"""Writers of the folder of each method that takes ``NAME:FOLDER``."""


_PACKAGES = ("unidepth", "depth_anything_3", "core")


@contextmanager
def stand_in_packages(site: Path) -> Iterator[Path]:
    """Write the stand-in packages into ``site`` and make them importable; remove their modules on exit."""
    _write(site / "unidepth" / "models.py", UNIDEPTH_MODELS)
    _write(site / "depth_anything_3" / "api.py", DEPTH_ANYTHING_3_API)
    with on_sys_path(site):
        importlib.invalidate_caches()
        yield site
    for name in [module for module in sys.modules if module.split(".")[0] in _PACKAGES]:
        del sys.modules[name]


def stereo_row(red: np.ndarray, fx: float = FX) -> dict[str, Any]:
    """Return a stereo view whose left eye has the given red channel; the other channels are noise."""
    height, width = red.shape
    left, right = np.random.default_rng(1).integers(0, 256, (2, height, width, 3), np.uint8)
    left[..., 0] = red
    K = np.array([[fx, 0, (width - 1) / 2], [0, FY, (height - 1) / 2], [0, 0, 1]])
    right_cam_from_world = np.eye(4)
    right_cam_from_world[0, 3] = -BASELINE_M
    return {
        "view_id": "a/0",
        "left_rgb": left,
        "right_rgb": right,
        **dict.fromkeys(("left_K", "right_K"), K),
        **dict.fromkeys(("left_distortion", "right_distortion"), np.zeros(5)),
        "left_cam_from_world": np.eye(4),
        "right_cam_from_world": right_cam_from_world,
        "baseline_m": BASELINE_M,
    }


def _write(path: Path, code: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(dedent(code))


def _tensors(gain: float, key: str) -> dict[str, Any]:
    return {key: importlib.import_module("torch").tensor(gain)}


def _pickle(path: Path, content: dict[str, Any]) -> None:
    importlib.import_module("torch").save(content, path)


def _write_hub_folder(folder: Path, config: dict[str, object], gain: float, key: str) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    save_file = importlib.import_module("safetensors.torch").save_file
    save_file(_tensors(gain, key), folder / "model.safetensors")
    return folder
