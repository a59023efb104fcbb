"""PatchmatchNet as a method: a multi-view network on the cameras of the dataset, which are ground truth.

    MODELS=FOLDER rebar-bench predict examples/methods/patchmatchnet.py:METHOD --data ROOT --out patchmatchnet.zip

It needs ``pip install '.[torch]'``. FOLDER has ``patchmatchnet_module_000007.pt``, the TorchScript module
``checkpoints/module_000007.pt`` of github.com/FangjinhuaWang/PatchmatchNet (MIT): PatchmatchNet, trained on DTU
(Wang et al., CVPR 2021). It takes images, K, poses and a range of depth. The images are the left image and those
of the four nearest other cameras of the scene, right ones included. The range follows from the view's true steel:
the 1st percentile of its depth times 0.75 to the 99th times 1.25. Poses and range are ground truth, which the
archive declares.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rebar_depth_bench import MethodError
from rebar_depth_bench.methods import MethodInfo, MultiViewMethod, Prepared

SOURCES = 4
EYES = ("left", "right")
CAMERAS = tuple(f"{eye}_{part}" for eye in EYES for part in ("rgb", "K", "cam_from_world"))


def check(views):
    """Raise ``MethodError`` for a config without poses or with a lens distortion."""
    if not views.has_poses:
        raise MethodError(f"{views.config}: has no poses, expected those of the dataset")
    first = next(views.rows("left_distortion"))
    if first["left_distortion"].any():
        raise MethodError(f"{views.config}: has a lens distortion, expected rectified images")


def prepare(views, _work, _progress):
    """Return the predictor of the views of a scene, whose images it keeps."""
    import torch

    network = torch.jit.load(
        Path(os.environ.get("MODELS", "."), "patchmatchnet_module_000007.pt"), map_location="cpu"
    )
    cameras = {}  # Image, K and pose by view id and eye.
    for row in views.rows(*CAMERAS):
        for eye in EYES:
            cameras[row["view_id"], eye] = tuple(row[f"{eye}_{part}"] for part in ("rgb", "K", "cam_from_world"))
    centres = {name: -pose[:3, :3].T @ pose[:3, 3] for name, (_, _, pose) in cameras.items()}

    def predict(row):
        own = row["view_id"], "left"

        def order(name):
            return name != own, np.linalg.norm(centres[name] - centres[own])

        nearest = sorted(cameras, key=order)[: SOURCES + 1]
        images, Ks, poses = zip(*(cameras[name] for name in nearest), strict=True)
        steel = row["left_depth"][(row["left_mask"] > 0) & (row["left_depth"] > 0)]
        if not len(steel):
            return np.full(row["left_depth"].shape, np.nan)
        low, high = np.percentile(steel, (1, 99)) * (0.75, 1.25)
        tensors = [torch.from_numpy(image / 255).float().permute(2, 0, 1)[None] for image in images]
        K, pose = (torch.from_numpy(np.stack(stack)).float()[None] for stack in (Ks, poses))
        with torch.no_grad():
            depth_m, _, _ = network(tensors, K, pose, torch.tensor([low]), torch.tensor([high]))
        return depth_m.numpy().reshape(row["left_depth"].shape)

    return Prepared(predict)


INFO = MethodInfo(
    name="patchmatchnet",
    summary="PatchmatchNet, trained on DTU, on the dataset's poses and range of depth; four source images",
    columns=("left_depth", "left_mask"),
    uses_intrinsics=True,
    source="github.com/FangjinhuaWang/PatchmatchNet, checkpoints/module_000007.pt",
    licence="MIT",
    uses_ground_truth=True,
)
METHOD = MultiViewMethod(INFO, prepare, check)
