"""An ONNX model with several inputs as a method: a monocular network that is also given the intrinsics.

    rebar-bench predict several_inputs.py:METHOD --data ROOT --out several-inputs.zip

It needs ``pip install '.[onnx]'``. Copy this file beside your ``several_inputs.onnx`` and adapt it: here the
inputs are ``image``, 1 x 3 x H x W, float32, RGB, 0 to 1, and ``K``, 1 x 3 x 3, float32, pixels; the output is
planar depth, metres, 1 x 1 x H x W.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rebar_depth_bench.methods import Method, MethodInfo

MODEL = Path(__file__).with_name("several_inputs.onnx")


def load():
    """Open the model and return the predictor."""
    import onnxruntime

    session = onnxruntime.InferenceSession(MODEL, providers=onnxruntime.get_available_providers())

    def predict(row):
        image = row["left_rgb"].transpose(2, 0, 1)[None].astype(np.float32) / 255
        [depth_m] = session.run(None, {"image": image, "K": row["left_K"][None].astype(np.float32)})
        return depth_m[0, 0]

    return predict


INFO = MethodInfo("my-network", "image and K", ("left_rgb", "left_K"), True, "where it is from", "its licence")
METHOD = Method(INFO, load)
