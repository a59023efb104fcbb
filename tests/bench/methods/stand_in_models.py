"""Stand-ins for third-party depth networks that are not available in the test environment.

A stand-in has the public interface of the original network and returns the red channel times its only weight. The
tests write its code into a folder with the layout of the original; none of it comes from the original authors. The
tests therefore cover only what this project does around a network: the input image, the focal length, the margins,
the resampling to the left grid, and the units.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import dedent

from rebar_depth_bench.methods.paper.third_party import on_sys_path

GAIN = 0.5
"""Factor by which every stand-in multiplies the red channel: its only weight, read from the checkpoint."""

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
            print("as talkative as the original")
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

DA3_API = """
    from types import SimpleNamespace
    import numpy as np
    import torch
    from huggingface_hub import PyTorchModelHubMixin
    from PIL import Image

    class DepthAnything3(torch.nn.Module, PyTorchModelHubMixin):
        def __init__(self, model_name="da3-large", **kwargs):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.zeros(()))

        def inference(self, image, extrinsics=None, intrinsics=None, process_res=504):
            [rgb] = image
            assert isinstance(rgb, np.ndarray) and rgb.dtype == np.uint8
            height, width = rgb.shape[:2]
            scale = process_res / max(height, width)
            w, h = (14 * round(side * scale / 14) for side in (width, height))
            red = np.asarray(Image.fromarray(rgb[..., 0]).resize((w, h), Image.Resampling.BILINEAR), np.float32)
            noise = 1e-3 * torch.rand(1).item()  # as the original's sample of the sky
            return SimpleNamespace(depth=(self.gain.item() + noise) * red[None], intrinsics=None)
"""

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
            return self.forward(image1, image2, iters, test_mode=test_mode)
"""

STEREO_MATCHER = """
    import torch
    import torch.nn.functional as F
    from core.utils.utils import InputPadder

    class FoundationStereo(torch.nn.Module):
        def __init__(self, args):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.zeros(()))
            self.volume_px = args.max_disp

        def forward(self, image1, image2, iters=12, flow_init=None, test_mode=False, init_disp=None):
            assert image1.shape == image2.shape and image1.shape[2] % 32 == image1.shape[3] % 32 == 0
            assert iters == 32 and test_mode
            if init_disp is None:
                start, steps = torch.zeros_like(image1[:, :1]), range(self.volume_px)
            else:
                start, steps = init_disp.round(), range(-4, 5)
            columns = torch.arange(image1.shape[3]).expand_as(start)
            best, disparity = torch.full_like(start, torch.inf), torch.zeros_like(start)
            for step in steps:
                match = (columns - start - step).clamp(0, image1.shape[3] - 1).long()
                seen = image2.gather(3, match.expand_as(image2))
                cost = F.avg_pool2d((image1 - seen).abs().mean(1, keepdim=True), 9, 1, 4)
                disparity = torch.where(cost < best, start + step, disparity)
                best = torch.minimum(cost, best)
            return disparity

        def run_hierachical(self, image1, image2, iters=12, test_mode=False, low_memory=False, small_ratio=0.5):
            height, width = image1.shape[2:]
            pair = [F.interpolate(image, scale_factor=small_ratio, mode="bilinear") for image in (image1, image2)]
            rows, columns = pair[0].shape[2:]
            smaller = [F.pad(image, (0, -columns % 32, 0, -rows % 32), mode="replicate") for image in pair]
            first = self.forward(*smaller, iters, test_mode=True)[:, :, :rows, :columns]
            first = F.interpolate(first, size=(height, width), mode="bilinear") / small_ratio
            return self.forward(image1, image2, iters, test_mode=test_mode, init_disp=first)
"""
"""Code of a stand-in for FoundationStereo that finds disparities below ``max_disp`` by block matching.

It stands in for the modes of the original: a second pass searches near the result of the first.
"""


def metric3d_clone(folder: Path, **weights: float) -> Path:
    """Write a clone of Metric3D that contains its checkpoint, and return the folder."""
    _write(folder / "hubconf.py", METRIC3D_HUBCONF)
    _pickle(folder / "metric_depth_vit_small_800k.pth", "model_state_dict", weights)
    return folder


def unidepth_weights(folder: Path, encoder: str = "dinov2_vitl14", **weights: float) -> Path:
    """Write UniDepth's files as they are on the Hub, and return the folder."""
    return _write_hub_folder(folder, {"model": {"pixel_encoder": {"name": encoder}}}, weights)


def da3_weights(folder: Path, model_name: str = "da3metric-large", **weights: float) -> Path:
    """Write Depth Anything 3's files as they are on the Hub, and return the folder."""
    return _write_hub_folder(folder, {"model_name": model_name}, weights)


def stereo_clone(folder: Path, *, code: str = FOUNDATION_STEREO, max_disp: object = 416, **weights: float) -> Path:
    """Write a clone of FoundationStereo with its weights folder 23-51-11, and return the folder."""
    _write(folder / "core" / "foundation_stereo.py", code)
    _write(folder / "core" / "utils" / "utils.py", INPUT_PADDER)
    trained = folder / "pretrained_models" / "23-51-11"
    trained.mkdir(parents=True)
    (trained / "cfg.yaml").write_text(f"max_disp: {max_disp}\nhidden_dims: [128, 128, 128]\n")
    _pickle(trained / "model_best_bp2.pth", "model", weights)
    return folder


@contextmanager
def stand_in_packages(site: Path) -> Iterator[Path]:
    """Write stand-in packages into ``site`` and make them importable; remove their modules on exit."""
    _write(site / "unidepth" / "models.py", UNIDEPTH_MODELS)
    _write(site / "depth_anything_3" / "api.py", DA3_API)
    with on_sys_path(site):
        importlib.invalidate_caches()
        yield site
    for name in [
        module for module in sys.modules if module.split(".")[0] in ("unidepth", "depth_anything_3", "core")
    ]:
        del sys.modules[name]


def _write(path: Path, code: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(dedent(code))


def _pickle(path: Path, key: str, weights: dict[str, float]) -> None:
    torch = importlib.import_module("torch")
    tensors = {name: torch.tensor(value) for name, value in (weights or {"gain": GAIN}).items()}
    torch.save({key: tensors, "global_step": 1, "epoch": 1}, path)


def _write_hub_folder(folder: Path, config: dict[str, object], weights: dict[str, float]) -> Path:
    torch = importlib.import_module("torch")
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    tensors = {name: torch.tensor(value) for name, value in (weights or {"gain": GAIN}).items()}
    importlib.import_module("safetensors.torch").save_file(tensors, folder / "model.safetensors")
    return folder
