"""Baselines at crossings: python -m benchmarks.crossings ROOT OUT ARCHIVE...

For each archive of predicted depth, the measures at crossings are computed, and a simple detector is run on its
depth; a further detector returns random points on the steel of the ground truth. Files of
detections and ``crossings.json``, which ``docs/results.md`` shows, are written to OUT. The detector is the same
for all archives:

1. steel stands in front of its surroundings: pixels whose inverse depth is above its morphological opening, and
   whose colour is not as bright as the paper of the board;
2. thinning of these pixels to lines, and points where three or more lines meet;
3. at each group of such points, a near depth is the front of the front bar; its width in the image gives its
   diameter, and the tie point lies one diameter behind that front;
4. the confidence is the share of steel pixels around the point.

The results there are of datasets and archives as of ``python -m benchmarks.reference OUT SET``: of the configs
``lattice`` and ``pile`` of ``subset`` with ``truth``, ``sgbm`` and ``sgbm-filled`` (``crossings.json``), and of 40
views in 10 scenes of ``cages`` with these and ``lidar-mobile`` (``crossings-cages.json``).
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy import ndarray

import rebar_depth_bench as rdb
from benchmarks.timing import print_markdown
from rebar_depth_bench.base.names import config_of
from rebar_depth_bench.data.manifest import DatasetConfig, open_folder
from rebar_depth_bench.detections.crossing_scorer import score_crossings
from rebar_depth_bench.extended.measures import NATIVE
from rebar_depth_bench.scoring.columns import rounded
from rebar_depth_bench.submission import SubmissionReader

OPENING_SHARE = 0.06
"""Size of the opening that removes bars, as a share of the width of the image."""
MIN_STEP = 0.02
"""Least relative step of inverse depth in front of the surroundings."""
MAX_BRIGHTNESS = 215
BRANCHES = 3
RANDOM_POINTS = 60
"""Random points of a view."""
SHARES = ("precision", "recall", "f1", "node_recall")
MEASURES = (
    *("crossings_located", "tie_median_mm", "tie_p95_mm", "crossing_angle_p95_deg"),
    *("tie_within_2mm", "tie_within_5mm"),
)
BIAS = ("right_bias_mm", "down_bias_mm", "along_bias_mm", "spread_mm")
KEPT = (
    *(*SHARES, "crossings", "detections", "matched", "false", "ignored"),
    *("average_precision", "position_mm", "position_p95_mm", *BIAS, "chance"),
)
COLUMNS = ("view_id", "left_rgb", "left_K", "left_depth", "left_mask")

Row = dict[str, Any]


def main(root: str, out: str, *archives: str) -> None:
    target = Path(out)
    target.mkdir(parents=True, exist_ok=True)
    folder = open_folder(root)
    files, depth = [], {}
    for archive in archives:
        with SubmissionReader(archive, folder.expected_views()) as submission:
            method = submission.meta.method if submission.meta else Path(archive).stem
            configs = list(dict.fromkeys(map(config_of, submission.view_ids)))
            rows = [row for config in configs for row in _detected(root, config, submission)]
        files.append((f"classical on {method}", configs, _write(target / f"{Path(archive).stem}.csv", rows)))
        depth[method] = _measures(archive, root)
    configs = files[0][1]
    rows = [row for config in configs for row in _random(root, config)]
    files.append(("random points on steel", configs, _write(target / "random.csv", rows)))
    detectors = {method: _scores(method, of_file, path, root) for method, of_file, path in files}
    document = {
        "command": "python -m benchmarks.crossings ROOT OUT ARCHIVE...",
        "renders": [_renders_text(folder.config(config)) for config in configs],
        "depth": depth,
        "detectors": detectors,
    }
    (target / "crossings.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    head = ["config", "detector", *SHARES, "AP 2", "AP 5", "AP 10", "median mm", "p95 mm", "chance: F1"]
    print_markdown(head, [row for method, tables in detectors.items() for row in _table_rows(method, tables)])


def _renders_text(config: DatasetConfig) -> str:
    height, width = config.grid
    scenes = f" in {len(config.scenes)} scenes," if len(config.scenes) > 1 else ""
    return f"{config.name}: {len(config.views)} views{scenes} of {width} x {height}"


def _measures(archive: str, root: str) -> dict[str, Any]:
    """Return the number of judged crossings and the measures at them of an archive, native, by config."""
    extended = rdb.score(archive, root, extended=True).extended
    assert extended is not None
    return {
        config: {
            "judged": table.numbers[NATIVE]["crossings_located"].samples,
            "measures": {name: rounded(table.numbers[NATIVE][name].value) for name in MEASURES},
        }
        for config, table in extended.tables.items()
    }


def _detected(root: str, config: str, submission: SubmissionReader) -> Iterator[Row]:
    for row in rdb.load(root, config, columns=list(COLUMNS)):
        depth_m = submission.read(row["view_id"]).astype(np.float64)
        for point_m, confidence in detect(row["left_rgb"], depth_m, row["left_K"]):
            yield _row(row["view_id"], point_m, confidence)


def detect(rgb: ndarray, depth_m: ndarray, K: ndarray) -> Iterator[tuple[ndarray, float]]:
    """Yield the tie points that the classical detector finds, camera frame, metres, with confidences."""
    valid = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.where(valid, 1 / np.where(valid, depth_m, 1.0), 0.0).astype(np.float32)
    size = int(OPENING_SHARE * depth_m.shape[1]) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    step = inverse - cv2.morphologyEx(inverse, cv2.MORPH_OPEN, kernel)
    dark = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) < MAX_BRIGHTNESS
    steel = (valid & dark & (step > MIN_STEP * inverse)).astype(np.uint8)
    steel = cv2.morphologyEx(steel, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    lines = cv2.ximgproc.thinning(255 * steel) > 0
    neighbours = cv2.filter2D(
        lines.astype(np.uint8), -1, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT
    )
    branch = (lines & (neighbours - 1 >= BRANCHES)).astype(np.uint8)
    half_width = cv2.distanceTransform(steel, cv2.DIST_L2, 3)
    count, _, _, centres = cv2.connectedComponentsWithStats(cv2.dilate(branch, np.ones((3, 3), np.uint8)))
    for centre in centres[1:count]:
        u, v = np.rint(centre).astype(int)
        yield from _lifted(u, v, depth_m, steel, half_width, K)


def _lifted(
    u: int, v: int, depth_m: ndarray, steel: ndarray, half_width: ndarray, K: ndarray
) -> Iterator[tuple[ndarray, float]]:
    """Yield the tie point behind a pixel where lines meet, if there is depth."""
    reach = max(2, int(half_width[v, u]))
    window = np.s_[max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
    known = depth_m[window][steel[window] > 0]
    if not len(known):
        return
    front_m = float(np.percentile(known, 20))
    diameter_m = 2 * float(half_width[v, u]) * front_m / K[0, 0]
    z_m = front_m + min(diameter_m, 0.04)
    point_m = np.array([(u - K[0, 2]) / K[0, 0] * z_m, (v - K[1, 2]) / K[1, 1] * z_m, z_m])
    yield point_m, float(steel[window].mean())


def _random(root: str, config: str) -> Iterator[Row]:
    """Yield random points of the true surface of the steel, which need the ground truth."""
    rng = np.random.default_rng(0)
    for row in rdb.load(root, config, columns=list(COLUMNS)):
        pixels = np.argwhere(row["left_mask"])
        K = row["left_K"]
        for v, u in pixels[rng.integers(len(pixels), size=RANDOM_POINTS)] if len(pixels) else []:
            z_m = float(row["left_depth"][v, u])
            yield _row(row["view_id"], np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1]) * z_m, 1.0)


def _row(view_id: str, point_m: ndarray, confidence: float) -> Row:
    x, y, z = (f"{value:.5f}" for value in point_m)
    return {"view_id": view_id, "x": x, "y": y, "z": z, "confidence": f"{confidence:.3f}"}


def _write(path: Path, rows: Sequence[Row]) -> Path:
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, ["view_id", "x", "y", "z", "confidence"])
        writer.writeheader()
        writer.writerows(rows)
    return path


def _scores(method: str, configs: Sequence[str], path: Path, root: str) -> dict[str, Any]:
    """Return the tables of a file of detections by config, without curves."""
    result = score_crossings(path, root, configs=configs, declared={"method": method})
    path.with_suffix(".json").write_text(result.to_json())
    tables = json.loads(result.to_json())["tables"]
    return {name: {key: value for key, value in table.items() if key in KEPT} for name, table in tables.items()}


def _table_rows(method: str, tables: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, table in tables.items():
        shares = (*(table[share] for share in SHARES), *table["average_precision"].values())
        errors = (table["position_mm"], table["position_p95_mm"])
        chance = _text(table["chance"]["f1"], 100, 1)
        cells = (*(_text(share, 100, 1) for share in shares), *(_text(error, 1, 2) for error in errors))
        yield name, method, *cells, chance


def _text(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


if __name__ == "__main__":
    if len(sys.argv) < 4:
        sys.exit("usage: python -m benchmarks.crossings ROOT OUT ARCHIVE...")
    main(*sys.argv[1:])
