"""An ONNX model with the layout N H W C as a method: a network that was converted from TensorFlow.

    rebar-bench predict channels_last.py:METHOD --data ROOT --out channels-last.zip

It needs ``pip install '.[onnx]'``. Copy this file beside your ``channels_last.onnx`` and adapt it: here the input
is 1 x 256 x 256 x 3, float32, RGB, 0 to 1, and the output planar depth, metres, 1 x 256 x 256 x 1. The depth of a
pixel is that of the nearest cell: interpolation would give depth between a bar and what is behind it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from rebar_depth_bench.methods import Method, MethodInfo

MODEL = Path(__file__).with_name("channels_last.onnx")
SIDE_PX = 256


def load():
    """Open the model and return the predictor."""
    import onnxruntime

    session = onnxruntime.InferenceSession(MODEL, providers=onnxruntime.get_available_providers())
    [image] = session.get_inputs()

    def predict(row):
        height, width, _ = row["left_rgb"].shape
        resized = Image.fromarray(row["left_rgb"]).resize((SIDE_PX, SIDE_PX), Image.Resampling.BILINEAR)
        [depth_m] = session.run(None, {image.name: np.asarray(resized, np.float32)[None] / 255})
        return np.asarray(Image.fromarray(depth_m[0, ..., 0]).resize((width, height), Image.Resampling.NEAREST))

    return predict


INFO = MethodInfo("my-network", "N H W C image", ("left_rgb",), False, "where it is from", "its licence")
METHOD = Method(INFO, load)
