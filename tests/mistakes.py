"""Predictions with one mistake each, as users make them, and what the diagnosis says about them.

``python -m tests.mistakes ROOT CONFIG [ARCHIVE ...]`` takes the predictions of each archive, and those of a
made-up learned method, makes every mistake, and prints which mistake is named: "yes" for the right one, its name
for another, "-" for none. A sound prediction must have "-".
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter, shift

from rebar_depth_bench import SubmissionWriter
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.diagnosis.corrections import UNITS, KeptPredictions
from rebar_depth_bench.diagnosis.diagnose import PossibleMistake, diagnose
from rebar_depth_bench.scoring.evaluation import Evaluation, open_evaluation

Image = Float[ndarray, "h w"]
SOUND = "sound"


def main(root: Path, config: str, archives: Sequence[Path]) -> None:
    """Print the table."""
    columns = ("view_id", "left_depth", "left_K", "baseline_m")
    rows = list(iterate_rows(open_folder(root).config(config), columns))
    predictions = {"learned": learned_like([row["left_depth"] for row in rows])}
    for archive in archives:
        with open_evaluation(archive, root) as evaluation:
            images = [evaluation.submission.read(row["view_id"]) for row in rows]
            predictions[evaluation.meta.method] = [np.array(image, np.float32) for image in images]
    cells = {name: mistakes_named(root, rows, images) for name, images in predictions.items()}
    print(f"| mistake | {' | '.join(cells)} |\n|{'---|' * (1 + len(cells))}")
    for name in mistakes(rows):
        print(f"| {name} | {' | '.join(named[name] for named in cells.values())} |")


def mistakes_named(root: Path, rows: Sequence[Mapping[str, ndarray]], images: Sequence[Image]) -> dict[str, str]:
    """Return the cell of each made mistake: what the diagnosis says about the predictions ``images``."""
    cells = {}
    for name, make in mistakes(rows).items():
        with tempfile.TemporaryDirectory() as folder:
            archive = Path(folder) / "submission.zip"
            with SubmissionWriter(archive, method=name) as writer:
                for row, image in zip(rows, make(images), strict=True):
                    writer.add(str(row["view_id"]), image)
            with open_evaluation(archive, root) as evaluation:
                named = [mistake.name for mistake in diagnosed(evaluation)]
        # Logarithms of depth below a metre are negative.
        cells[name] = "yes" if named in ([name], ["negative", name]) else ", ".join(named) or "-"
    return cells


def diagnosed(evaluation: Evaluation) -> list[PossibleMistake]:
    """Return the possible mistakes in the predictions of an archive."""
    kept = [KeptPredictions.of_archive(config, evaluation.submission) for config in evaluation.configs]
    return diagnose(kept, evaluation.meta.prediction, evaluation.meta.depth_scale)


def mistakes(rows: Sequence[Mapping[str, ndarray]]) -> dict[str, Callable[[Sequence[Image]], list[Image]]]:
    """Return functions that make each mistake, by the name of its correction, and one that makes none."""
    count = len(rows)
    as_text = sorted(range(count), key=str)
    focal_baseline = rows[0]["left_K"][0, 0] * rows[0]["baseline_m"]
    range_per_depth = _range_per_depth(rows[0]["left_K"], *rows[0]["left_depth"].shape)
    each: dict[str, Callable[[Image], Image]] = {
        SOUND: lambda p: p,
        **{unit: partial(np.multiply, factor) for unit, factor in UNITS.items()},
        "factor": partial(np.multiply, 0.01),
        "disparity": partial(_divided_by, focal_baseline),
        "inverse": partial(_divided_by, 1.0),
        "right-eye": partial(_seen_from_the_right, focal_baseline=focal_baseline),
        "range": lambda p: p * range_per_depth,
        "mirrored": np.fliplr,
        "upside-down": np.flipud,
        "rotated": lambda p: p[::-1, ::-1],
        "shift": partial(shift, shift=(2, -3), order=0),
        "log": lambda p: np.log(np.where(p > 0, p, np.nan)),
        "log10": lambda p: np.log10(np.where(p > 0, p, np.nan)),
        "normalised": lambda p: p / np.nanmax(p),
        "negative": np.negative,
        "infinite": lambda p: np.full_like(p, np.inf),
        "nan": lambda p: np.full_like(p, np.nan),
    }
    orders = {
        "reversed": range(count)[::-1],
        "one-early": [min(n + 1, count - 1) for n in range(count)],
        "one-late": [max(n - 1, 0) for n in range(count)],
        "as-text": as_text,
        "from-text": [as_text.index(n) for n in range(count)],
        "same-map": [0] * count,
    }
    return {name: partial(_map_images, make) for name, make in each.items()} | {
        name: partial(_reorder, order=order) for name, order in orders.items()
    }


def learned_like(truth_m: Sequence[Image]) -> list[Image]:
    """Return predictions like those of a learned method: too far by 12 %, with smooth errors and blurred edges.

    The smooth errors have a standard deviation of 3 %, over a sixth of the picture's height.
    """
    random = np.random.default_rng(0)
    predictions = []
    for depth_m in truth_m:
        smooth = gaussian_filter(random.normal(size=depth_m.shape), depth_m.shape[0] / 6)
        filled_m = np.where(depth_m > 0, depth_m, 1.2 * depth_m.max())
        error = 1.12 * np.exp(0.03 * smooth / smooth.std())
        predictions.append((gaussian_filter(filled_m, 1.0) * error).astype(np.float32))
    return predictions


def _map_images(make: Callable[[Image], Image], images: Sequence[Image]) -> list[Image]:
    return [np.ascontiguousarray(make(image)).astype(np.float32) for image in images]


def _reorder(images: Sequence[Image], order: Sequence[int]) -> list[Image]:
    return [images[n] for n in order]


def _divided_by(dividend: float, depth_m: Image) -> Image:
    return np.divide(dividend, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)


def _seen_from_the_right(depth_m: Image, focal_baseline: float) -> Image:
    """Return the depth of each pixel in the right picture, 0 where no pixel of the left picture gets to."""
    v, u = np.nonzero(depth_m > 0)
    farthest_first = np.argsort(-depth_m[v, u], kind="stable")
    v, u = v[farthest_first], u[farthest_first]
    right_u = u - focal_baseline / depth_m[v, u]
    seen = np.zeros_like(depth_m)
    for column in (np.floor(right_u).astype(np.intp), np.ceil(right_u).astype(np.intp)):
        inside = column >= 0
        seen[v[inside], column[inside]] = depth_m[v[inside], u[inside]]
    return seen


def _range_per_depth(K: Float[ndarray, "3 3"], height: int, width: int) -> Image:
    v, u = np.ogrid[:height, :width]
    return np.asarray(np.sqrt(1 + ((u - K[0, 2]) / K[0, 0]) ** 2 + ((v - K[1, 2]) / K[1, 1]) ** 2))


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python -m tests.mistakes ROOT CONFIG [ARCHIVE ...]")
    main(Path(sys.argv[1]), sys.argv[2], [Path(name) for name in sys.argv[3:]])
