"""Results of learned networks beside SGBM, on the views of ``subset`` and ``cages`` of ``benchmarks.reference``.

    SIZE="--width 640 --height 360 --quality preview"
    rebar-build --out ROOT --config lattice pile pier --views 72 $SIZE
    rebar-build --out ROOT --config cages --split test --scenes 40 --views-per-scene 4 $SIZE
    pip install '.[methods,onnx,torch]'
    pip install --no-deps mccnn==1.4.1 json-checker
    python -m benchmarks.learned ROOT MODELS OUT

MODELS is the folder of the weights that the files in ``examples/methods`` name. Each method predicts each config
of ROOT into ``OUT/METHOD-CONFIG.zip``; archives that are newer than the config are used again, so that the command
continues after an interruption. It prints the tables as Markdown and, if every method has an archive of
every config, writes their numbers to ``cards/reference/learned.json``, from which ``make cards`` writes its pages.
If methods are named after OUT, only these run (``none``: no method); the tables contain all that have an archive.

The numbers are those of ``rebar-bench score``, with and without ``--align affine-disparity``, and of the disparity
f B / z of the scored pixels:

- the bias: median of predicted minus true disparity, pixels, of all valid pixels of a config;
- the reach: share of the pixels with at most the disparity that a method searches, number of the views that have
  only such pixels, and the mean rank error of these views for HITNet's limit.
"""

from __future__ import annotations

import json
import math
import os
import statistics
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt32
from numpy import ndarray

from cards.learned import LEARNED, learned_tables
from cards.reference import results_file
from rebar_depth_bench import score
from rebar_depth_bench.base.names import TEST_SPLIT
from rebar_depth_bench.base.writing import write_text
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.scoring.columns import rounded
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.scoring.metrics import is_valid_prediction
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.truth import reference_errors

EXAMPLES = Path(__file__).parents[1] / "examples" / "methods"
METHODS = {
    "sgbm": "sgbm",
    **{name: f"{EXAMPLES / name}.py:METHOD" for name in ("hitnet", "tcmonodepth", "mccnn", "patchmatchnet")},
}
"""Methods as ``rebar-bench predict`` names them; the slowest are last."""
REACHES_PX = (128, 320)
"""Largest disparities of HITNet, and of SGBM and MC-CNN, which search half of the width (640 px)."""
KIND = "affine-disparity"
TRUTH_COLUMNS = ("left_depth", "left_mask", "left_K", "baseline_m")


class ViewTruth(NamedTuple):
    """Flat indices and true disparities, pixels, of the scored pixels of a view, and its f B, pixels x metres."""

    pixels: UInt32[ndarray, " n"]
    disparity_px: Float64[ndarray, " n"]
    fx_baseline: float


def main(root: Path, models: Path, out: Path, methods: list[str]) -> int:
    """Compute missing archives, write and print their numbers; return the exit status."""
    os.environ["MODELS"] = str(models.resolve())
    out.mkdir(parents=True, exist_ok=True)
    folder = open_folder(root)
    configs = {name: config.of_split(TEST_SPLIT) for name, config in folder.config_by_name.items()}
    for method in methods:
        for name in configs:
            archive = _archive(out, method, name)
            predict = ("predict", METHODS[method], "--data", str(root), "--config", name, "--out", str(archive))
            if is_stale(archive, root / name) and (status := rebar_bench(list(predict))):
                return status
    numbers = {name: config_numbers(config, root, out) for name, config in configs.items()}
    command = "python -m benchmarks.learned ROOT MODELS OUT"
    document = {"command": command, "dataset": folder.digest, "configs": numbers}
    if all(len(of_config["methods"]) == len(METHODS) for of_config in numbers.values()):
        write_text(results_file(LEARNED), json.dumps(document, indent=1, allow_nan=False) + "\n")
    print("\n\n".join(learned_tables(numbers).values()))
    return 0


def _archive(out: Path, method: str, config: str) -> Path:
    return out / f"{method}-{config}.zip"


def is_stale(archive: Path, config: Path) -> bool:
    """Return True if an archive does not exist, or is older than a file in the folder of a config."""
    newest = max(path.stat().st_mtime for path in config.rglob("*"))
    return not archive.is_file() or archive.stat().st_mtime < newest


def config_numbers(config: DatasetConfig, root: Path, out: Path) -> dict[str, Any]:
    """Return the numbers of a config: of its views, the reference errors, and of each method with an archive."""
    truth = {row["view_id"]: _view_truth(row) for row in iterate_rows(config, ("view_id", *TRUTH_COLUMNS))}
    views = [view.disparity_px for view in truth.values() if len(view.disparity_px)]
    disparity_px = np.concatenate(views)
    reference = reference_errors(config)
    archives = {method: _archive(out, method, config.name) for method in METHODS}
    return {
        "views": len(config.view_ids),
        "scenes": len(config.by_scene()),
        "width": config.grid[1],
        "height": config.grid[0],
        "disparity_px": [round(float(np.quantile(disparity_px, share)), 2) for share in (0, 0.5, 1)],
        "reach": {
            str(limit): {
                "pixels": round(float(np.mean(disparity_px <= limit)), 4),
                "views": sum(bool(view.max() <= limit) for view in views),
            }
            for limit in REACHES_PX
        },
        "constant": reference["constant"]["abs_rel"],
        "one_pixel": reference["one_pixel"]["abs_rel"],
        "methods": {
            method: _method_numbers(archive, root, config.name, truth)
            for method, archive in archives.items()
            if archive.is_file()
        },
    }


def _view_truth(row: Mapping[str, Any]) -> ViewTruth:
    pixels = scored_pixels(row["left_mask"], row["left_depth"])
    fx_baseline = float(row["left_K"][0, 0] * row["baseline_m"])
    return ViewTruth(pixels, fx_baseline / row["left_depth"].ravel()[pixels].astype(np.float64), fx_baseline)


def _method_numbers(archive: Path, root: Path, config: str, truth: Mapping[str, ViewTruth]) -> dict[str, Any]:
    """Return the numbers of an archive by its own kind of predictions, and after alignment as ``KIND``."""
    result = score(archive, root)
    is_metric = result.prediction is None
    table = result.tables[config]
    aligned = (score(archive, root, align=KIND) if is_metric else result).tables[config]
    reached = [
        view["rank_error"]
        for view in result.views
        if not math.isnan(view["rank_error"]) and truth[view.view_id].disparity_px.max() <= REACHES_PX[0]
    ]
    return {
        "uses_ground_truth": result.submission.uses_ground_truth,
        "coverage": rounded(table["coverage"]),
        "rank_error": rounded(table["rank_error"]),
        "reached_rank_error": statistics.mean(reached) if reached else None,
        "native": rounded(table["native.abs_rel"]),
        "scaled": rounded(table["scaled.abs_rel"]),
        "scaled_constant": rounded(table["reference.scaled_constant.abs_rel"]),
        "scale": rounded(table["scale_median"]),
        "within_5_mm": rounded(table["within_mm.5"]),
        "bias_px": _bias_px(archive, root, truth) if is_metric else None,
        "aligned_error": aligned["aligned.error"],
        "aligned": aligned["aligned.abs_rel"],
        "aligned_constant_error": aligned["constant.error"],
        "aligned_constant": aligned["constant.abs_rel"],
        "flat_views": int(aligned["flat_views"]),
    }


def _bias_px(archive: Path, root: Path, truth: Mapping[str, ViewTruth]) -> float | None:
    """Return the median of predicted minus true disparity, pixels, over the valid scored pixels of all views."""
    errors = []
    with open_evaluation(archive, root) as evaluation:
        for view_id, view in truth.items():
            depth_m = evaluation.submission.read(view_id).ravel()[view.pixels].astype(np.float64)
            valid = is_valid_prediction(depth_m)
            errors.append(view.fx_baseline / depth_m[valid] - view.disparity_px[valid])
    found = np.concatenate(errors)
    return round(float(np.median(found)), 3) if len(found) else None


if __name__ == "__main__":
    if len(sys.argv) < 4 or not set(sys.argv[4:]) <= {*METHODS, "none"}:
        sys.exit(f"usage: python -m benchmarks.learned ROOT MODELS OUT [{'|'.join(METHODS)}|none ...]")
    chosen = [name for name in sys.argv[4:] if name != "none"] if sys.argv[4:] else list(METHODS)
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), chosen))
