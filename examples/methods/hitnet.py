"""HITNet as a method: a stereo network whose one input holds the left and the right grey image as channels.

    MODELS=FOLDER rebar-bench predict examples/methods/hitnet.py:METHOD --data ROOT --out hitnet.zip

It needs ``pip install '.[onnx]'``. FOLDER has ``hitnet_eth3d.onnx``, which tf2onnx makes of ``models/eth3d.pb`` of
github.com/jimtete/thesis-HITNET-Stereo-Depth-estimation: HITNet, trained on ETH3D (Tankovich et al., CVPR 2021).
The code of google-research is Apache-2.0; no licence of the weights is stated. The network returns disparities of
at most 128 px: surfaces nearer than f B / 128 px (f: focal length in pixels, B: baseline) it cannot express.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rebar_depth_bench.methods import Method, MethodInfo

MULTIPLE_PX = 64
"""Sides of the input are multiples of this."""
GREY = (0.299, 0.587, 0.114)


def load():
    """Open the model and return the predictor."""
    import onnxruntime

    model = Path(os.environ.get("MODELS", "."), "hitnet_eth3d.onnx")
    session = onnxruntime.InferenceSession(model, providers=onnxruntime.get_available_providers())
    [stereo] = session.get_inputs()

    def predict(row):
        height, width, _ = row["left_rgb"].shape
        pair = np.stack([row[eye] @ np.array(GREY) / 255 for eye in ("left_rgb", "right_rgb")])
        padding = ((0, 0), (0, -height % MULTIPLE_PX), (0, -width % MULTIPLE_PX))
        tensor = np.pad(pair, padding, mode="edge")[None].astype(np.float32)  # 1 x 2 x H x W
        [output] = session.run(None, {stereo.name: tensor})
        disparity = output.reshape(tensor.shape[2:])[:height, :width]
        parallax = disparity - (row["left_K"][0, 2] - row["right_K"][0, 2])
        depth_m = row["left_K"][0, 0] * row["baseline_m"] / np.maximum(parallax, 1)
        return np.where(parallax >= 1, depth_m, np.nan).astype(np.float32)

    return predict


INFO = MethodInfo(
    name="hitnet",
    summary="HITNet, trained on ETH3D; disparities of at most 128 px",
    columns=("left_rgb", "right_rgb", "left_K", "right_K", "baseline_m"),
    uses_intrinsics=True,
    source="github.com/jimtete/thesis-HITNET-Stereo-Depth-estimation, models/eth3d.pb",
    licence="code Apache-2.0; none stated for the weights",
)
METHOD = Method(INFO, load)
