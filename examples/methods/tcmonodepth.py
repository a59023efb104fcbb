"""TCMonoDepth as a method: a monocular network of relative inverse depth, which is not metric.

    MODELS=FOLDER rebar-bench predict examples/methods/tcmonodepth.py:METHOD --data ROOT --out tcmonodepth.zip

It needs ``pip install '.[onnx]'``. FOLDER has ``tcmonodepth_tcsmallnet_192x320.onnx`` of
github.com/royshil/obs-backgroundremoval, ``data/models``: the small TCMonoDepth (Li et al., ICCV Workshops 2021;
the network is MIT, the plugin that contains the file GPL-3). Its output is 1/z up to an unknown factor and offset,
which the archive declares as ``affine-disparity``: both are fitted to the truth of each view before it is scored.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from PIL import Image

from rebar_depth_bench.methods import Method, MethodInfo

SIZE_PX = (320, 192)
"""Width and height of the input."""


def load():
    """Open the model and return the predictor of relative inverse depth."""
    import onnxruntime

    model = Path(os.environ.get("MODELS", "."), "tcmonodepth_tcsmallnet_192x320.onnx")
    session = onnxruntime.InferenceSession(model, providers=onnxruntime.get_available_providers())

    def predict(row):
        height, width, _ = row["left_rgb"].shape
        resized = Image.fromarray(row["left_rgb"]).resize(SIZE_PX, Image.Resampling.BILINEAR)
        tensor = np.asarray(resized, np.float32).transpose(2, 0, 1)[None]  # 1 x 3 x H x W, RGB, 0 to 255
        [output] = session.run(None, {"input": tensor})
        inverse_depth = Image.fromarray(output[0, 0])
        return np.asarray(inverse_depth.resize((width, height), Image.Resampling.BILINEAR))

    return predict


INFO = MethodInfo(
    name="tcmonodepth",
    summary="TCMonoDepth (small) on the left image; relative inverse depth",
    columns=("left_rgb",),
    uses_intrinsics=False,
    source="github.com/royshil/obs-backgroundremoval, data/models/tcmonodepth_tcsmallnet_192x320.onnx",
    licence="MIT (network)",
    prediction="affine-disparity",
)
METHOD = Method(INFO, load)
