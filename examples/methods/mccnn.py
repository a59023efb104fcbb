"""MC-CNN as a method: matching costs of a learned network, aggregated by semi-global matching (SGM).

    pip install --no-deps mccnn==1.4.1 json-checker  # without its OpenCV, which hides cv2.ximgproc
    rebar-bench predict examples/methods/mccnn.py:METHOD --data ROOT --out mccnn.zip

It needs ``pip install '.[onnx]'``. The package ``mccnn`` of CNES (Apache-2.0) contains code and weights: the fast
network in 8 bits, trained on Middlebury. It returns the negative cosine of 64 features of an 11 x 11 window, at
each disparity (Zbontar and LeCun, JMLR 17, 2016). The package has no SGM; the one below sums the costs along four
directions (Hirschmueller, TPAMI 2008). Its penalties were chosen before the first run, not tuned. No prediction
where the disparities of both views differ by more than one pixel.
"""

from __future__ import annotations

import numpy as np

from rebar_depth_bench.methods import Method, MethodInfo

SMALL_STEP, LARGE_STEP = 0.1, 1.0
"""Penalties of a step of one pixel of disparity, and of a larger one, in units of the cosine."""
MARGIN_PX = 5


def load():
    """Return the predictor; the weights are those of the package."""
    from mc_cnn.run import run_mc_cnn_fast
    from mc_cnn.weights import get_weights

    weights = str(get_weights("onnx_fast_int8", "middlebury"))

    def predict(row):
        # The network shortens each side by ten pixels.
        left, right = (
            np.pad(np.asarray(row[eye].mean(-1), np.float32), MARGIN_PX, mode="edge")
            for eye in ("left_rgb", "right_rgb")
        )
        largest_px = row["left_rgb"].shape[1] // 2
        cost = run_mc_cnn_fast(left, right, -largest_px, 0, weights)[..., ::-1]  # H x W x disparities from 0 on
        disparity = consistent_disparity(aggregated(np.where(np.isnan(cost), np.float32(1), cost)))
        parallax = disparity - (row["left_K"][0, 2] - row["right_K"][0, 2])
        depth_m = row["left_K"][0, 0] * row["baseline_m"] / np.maximum(parallax, 1)
        return np.where(parallax >= 1, depth_m, np.nan).astype(np.float32)

    return predict


def aggregated(cost):
    """Return the sum of the costs along paths from left, right, above and below, H x W x disparities."""
    total = np.zeros_like(cost)
    for axis in (0, 1):
        costs, sums = np.moveaxis(cost, axis, 0), np.moveaxis(total, axis, 0)
        for steps in (range(len(costs)), range(len(costs))[::-1]):
            path = np.zeros_like(costs[0])
            for step in steps:
                least = path.min(-1, keepdims=True)
                best = np.minimum(path, least + LARGE_STEP)
                np.minimum(best[:, 1:], path[:, :-1] + SMALL_STEP, out=best[:, 1:])
                np.minimum(best[:, :-1], path[:, 1:] + SMALL_STEP, out=best[:, :-1])
                path = costs[step] + best - least
                sums[step] += path
    return total


def consistent_disparity(total):
    """Return the disparity of least cost with a parabola's fraction, NaN where that of the right view differs."""
    height, width, count = total.shape
    columns = np.arange(width)
    left = total.argmin(-1)
    padded = np.concatenate([total, np.full((height, count, count), np.inf, total.dtype)], 1)
    strides = np.add(padded.strides, (0, 0, padded.strides[1]))  # Pixel x of the right view matches x + disparity.
    right = np.lib.stride_tricks.as_strided(padded, total.shape, strides).argmin(-1)
    match = np.take_along_axis(right, np.maximum(columns - left, 0), 1)
    at = np.clip(left, 1, count - 2)[..., None]
    below, centre, above = (np.take_along_axis(total, at + step, 2)[..., 0] for step in (-1, 0, 1))
    curvature = np.maximum(below - 2 * centre + above, 1e-6)
    is_inside = (left == at[..., 0]) & (columns >= left)
    fraction = np.clip((below - above) / (2 * curvature), -0.5, 0.5)
    return np.where(is_inside & (np.abs(left - match) <= 1), left + fraction, np.nan)


INFO = MethodInfo(
    name="mccnn",
    summary="MC-CNN fast (Middlebury) as matching cost, semi-global matching along four directions",
    columns=("left_rgb", "right_rgb", "left_K", "right_K", "baseline_m"),
    uses_intrinsics=True,
    source="mccnn 1.4.1 of the Python Package Index",
    licence="Apache-2.0",
)
METHOD = Method(INFO, load)
