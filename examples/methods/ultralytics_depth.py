"""A depth network of Ultralytics (YOLO26-depth) as a method: planar depth of the left image, in metres.

    MODELS=FOLDER rebar-bench predict examples/methods/ultralytics_depth.py:METHOD --data ROOT --out yolo.zip

It needs ``ultralytics`` 8.4.104 or later beside rebar-depth-bench, in an environment of its own (docs/methods.md);
any other scores the archive. FOLDER has ``best.pt`` of a training. Ultralytics stretches the image to the square
size of the training, predicts depth at a quarter of it, and resizes that to the image. It is AGPL-3.0.

``INFO`` names the network and the version that this file was tried with, whatever ``best.pt`` is: edit ``name``,
``summary`` and ``source`` for another network or version, since the archive and its results state them.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from rebar_depth_bench.methods import Method, MethodInfo


def load():
    """Open the checkpoint and return the predictor."""
    from ultralytics import YOLO

    model = YOLO(Path(os.environ.get("MODELS", "."), "best.pt"), task="depth")

    def predict(row):
        bgr = np.ascontiguousarray(row["left_rgb"][..., ::-1])  # the order of channels that it takes of arrays
        [result] = model.predict(bgr, verbose=False)
        return result.depth.data.cpu().numpy()

    return predict


INFO = MethodInfo(
    name="yolo26n-depth",
    summary="YOLO26n-depth of Ultralytics on the left image",
    columns=("left_rgb",),
    uses_intrinsics=False,
    source="ultralytics 8.4.190, yolo26n-depth.yaml",
    licence="AGPL-3.0",
)
METHOD = Method(INFO, load)
