"""An ONNX model with a uint8 input as a method: a network that contains its own normalisation.

    rebar-bench predict uint8.py:METHOD --data ROOT --out uint8.zip

It needs ``pip install '.[onnx]'``. Copy this file beside your ``uint8.onnx`` and adapt it: here the input is
1 x 3 x H x W, uint8, RGB, and the output planar depth, metres, 1 x 1 x H x W.
"""

from __future__ import annotations

from pathlib import Path

from rebar_depth_bench.methods import Method, MethodInfo

MODEL = Path(__file__).with_name("uint8.onnx")


def load():
    """Open the model and return the predictor."""
    import onnxruntime

    session = onnxruntime.InferenceSession(MODEL, providers=onnxruntime.get_available_providers())
    [image] = session.get_inputs()

    def predict(row):
        [depth_m] = session.run(None, {image.name: row["left_rgb"].transpose(2, 0, 1)[None]})
        return depth_m[0, 0]

    return predict


INFO = MethodInfo("my-network", "uint8 image", ("left_rgb",), False, "where it is from", "its licence")
METHOD = Method(INFO, load)
