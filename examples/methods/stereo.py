"""An ONNX model with two image inputs as a method: a stereo network that returns disparity.

    rebar-bench predict stereo.py:METHOD --data ROOT --out stereo.zip

It needs ``pip install '.[onnx]'``. Copy this file beside your ``stereo.onnx`` and adapt it: here the inputs
``left`` and ``right`` are 1 x 3 x H x W, float32, RGB, 0 to 1, with sides that are multiples of 32; the output is
the disparity of the left image in pixels, 1 x 1 x H x W. Images with a lens distortion are rectified before.
Networks that search D pixels cannot express surfaces nearer than f B / D.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rebar_depth_bench.methods import Method, MethodInfo

MODEL = Path(__file__).with_name("stereo.onnx")
MULTIPLE_PX = 32


def load():
    """Open the model and return the predictor."""
    import onnxruntime

    session = onnxruntime.InferenceSession(MODEL, providers=onnxruntime.get_available_providers())

    def tensor(rgb):
        height, width, _ = rgb.shape
        padding = ((0, -height % MULTIPLE_PX), (0, -width % MULTIPLE_PX), (0, 0))
        padded = np.pad(rgb, padding, mode="edge")
        return padded.transpose(2, 0, 1)[None].astype(np.float32) / 255

    def predict(row):
        height, width, _ = row["left_rgb"].shape
        inputs = {"left": tensor(row["left_rgb"]), "right": tensor(row["right_rgb"])}
        [output] = session.run(None, inputs)
        disparity = output[0, 0, :height, :width]
        parallax = disparity - (row["left_K"][0, 2] - row["right_K"][0, 2])
        depth_m = row["left_K"][0, 0] * row["baseline_m"] / np.maximum(parallax, 1)
        return np.where(parallax >= 1, depth_m, np.nan).astype(np.float32)

    return predict


COLUMNS = ("left_rgb", "right_rgb", "left_K", "right_K", "baseline_m")
INFO = MethodInfo("my-stereo", "a stereo network", COLUMNS, True, "where it is from", "its licence")
METHOD = Method(INFO, load)
