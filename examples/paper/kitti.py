"""Check of a method on KITTI's Eigen split (paper, Sec. III.A).

    python examples/paper/kitti.py --kitti KITTI --ground-truth raw --predictions sgbm.zip --method sgbm-filled

Ground truth is one laser scan (``raw``: ``<date>/<drive>/velodyne_points/data/<frame>.bin`` and the calibration of
the day, all 697 images) or accumulated from several (``improved``: 16-bit PNG of metres times 256 in
``<drive>/proj_depth/groundtruth/image_0C/<frame>.png``, 652 images). Predictions are an archive with the views
``kitti/<drive>_<frame>_<side>``, or a folder of such files, at the size of the ground truth: resizing a depth map
creates false depth between a near and a far surface.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from numpy import ndarray
from PIL import Image as Picture

from depth_maps import DepthMaps, open_maps
from outputs import add_outputs, number, run_script, write_outputs
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.base.parallel import map_in_threads
from rebar_depth_bench.base.terminal import ProgressBars
from rebar_depth_bench.captures.calibration import Calibration, Lens, MonoCalibration, StereoCalibration
from rebar_depth_bench.captures.images import read_image_shape
from rebar_depth_bench.captures.views import ImageViews
from rebar_depth_bench.cli.console import InputFile, InputFolder, add_workers
from rebar_depth_bench.methods import find_method
from rebar_depth_bench.methods.run import predict_views
from rebar_depth_bench.scoring.bootstrap import INTERVALS, interval, resample
from rebar_depth_bench.scoring.evaluation import Provenance
from rebar_depth_bench.scoring.metrics import is_valid_prediction, mean, median_scale
from rebar_depth_bench.scoring.protocol import MIN_COMPARABLE_COVERAGE
from rebar_depth_bench.scoring.result import SubmissionIdentity

PROTOCOL = "rebar-kitti-eigen-1"
EIGEN_SPLIT = Path(__file__).with_name("kitti_eigen_test_697.txt")  # As distributed with Monodepth.
PUBLISHED = """\
Paper, 697 images: Metric3D v2 AbsRel 0.0926; UniDepth v2 RMSE 3.96 m, delta1 0.926; Depth Anything 3 Metric AbsRel
0.1196; Depth Pro AbsRel 0.1386; crop and cap are not stated"""
COLUMNS = (0.03594771, 0.96405229)
CROPS = {"garg": ((0.40810811, 0.99189189), COLUMNS), "eigen": ((0.3324324, 0.91351351), COLUMNS)}
"""Rows and columns of Garg et al., ECCV 2016, and Eigen et al., as fractions, truncated to whole pixels."""
IMPROVED = (".", "train", "val", "data_depth_annotated/train", "data_depth_annotated/val")
CAMERAS = {"l": 2, "r": 3}
CAM_TO_CAM, VELO_TO_CAM = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
METRICS = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3")
NO_ERRORS = dict.fromkeys(METRICS)
MIN_DEPTH_M = 1e-3
DepthMap = Float[ndarray, "h w"]


def argument_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's arguments."""
    parser = argparse.ArgumentParser(description="check a method on KITTI's Eigen split")
    parser.add_argument("--predictions", type=InputFolder, required=True, metavar="DIR_OR_ZIP", help="depth maps")
    parser.add_argument("--method", type=InputFile, help="method to run first, which writes --predictions")
    parser.add_argument("--kitti", type=InputFolder, required=True, metavar="ROOT", help="raw data or depth maps")
    parser.add_argument("--ground-truth", required=True, choices=("raw", "improved"), help="one scan, or several")
    images = "lines <date>/<drive> <frame> l|r (default: the Eigen test split)"
    parser.add_argument("--images", type=InputFile, default=EIGEN_SPLIT, metavar="FILE", help=images)
    parser.add_argument("--crop", choices=(*CROPS, "none"), default="garg", help="default: garg")
    cap = number(float, np.nextafter(MIN_DEPTH_M, 1))
    parser.add_argument("--cap", type=cap, default=80.0, metavar="M", help="largest depth, m (default: 80)")
    lidar = "a laser point's depth: z in the camera, or x in the scanner as in Monodepth (default: camera)"
    parser.add_argument("--lidar-depth", choices=("camera", "velodyne"), default="camera", help=lidar)
    add_workers(parser)
    add_outputs(parser)
    return parser


def read_images(path: Path) -> pd.DataFrame:
    """Return the images of a list by name, sorted so that consecutive frames are adjacent."""
    columns = ["date", "drive", "frame", "side"]
    images = pd.read_csv(path, sep="[/ ]", engine="python", names=columns, dtype=str).sort_values(columns)
    return images.set_index(images["drive"] + "_" + images["frame"] + "_" + images["side"])


def truth_file(root: Path, kind: str, image: Any) -> Path | None:
    """Return the file with the ground truth of an image, None if there is none."""
    raw = Path(image.date, image.drive, "velodyne_points/data", f"{image.frame}.bin")
    improved = Path(image.drive, f"proj_depth/groundtruth/image_0{CAMERAS[image.side]}/{image.frame}.png")
    files = [root / raw] if kind == "raw" else [root / part / improved for part in IMPROVED]
    return next((file for file in files if file.exists()), None)


def read_calibration(day: Path, name: str) -> dict[str, Float[ndarray, ...]]:
    """Return the numbers of a calibration file of a day by key; projections are 3 x 4, rotations 3 x 3."""
    pairs = (line.split(":", 1) for line in (day / name).read_text().splitlines() if ":" in line)
    numbers = {key: np.array(text.split(), float) for key, text in pairs if key != "calib_time"}
    return {key: one.reshape(3, -1) if one.size in (9, 12) else one for key, one in numbers.items()}


def read_truth(image: Any, root: Path, lidar_depth: str) -> DepthMap:
    """Return the ground-truth depth of an image in metres, float32; 0 without ground truth.

    The nearest point of a scan counts, at the pixel ``round(u) - 1, round(v) - 1`` as in Monodepth (Godard et al.,
    CVPR 2017) and KITTI's code. Depth is planar z, or as in Monodepth the scanner's x, about 0.27 m more.
    """
    if image.truth.suffix == ".png":
        return (np.asarray(Picture.open(image.truth), np.float64) / 256).astype(np.float32)
    cam, velo = (read_calibration(root / image.date, name) for name in (CAM_TO_CAM, VELO_TO_CAM))
    rectification, cam_from_velo = np.eye(4), np.eye(4)
    rectification[:3, :3], cam_from_velo[:3] = cam["R_rect_00"], np.column_stack([velo["R"], velo["T"]])
    image_from_velo = cam[f"P_rect_0{CAMERAS[image.side]}"] @ rectification @ cam_from_velo
    points = np.fromfile(image.truth, "<f4").reshape(-1, 4).astype(np.float64)
    ahead = points[points[:, 0] >= 0, :3]
    projected = np.concatenate([ahead, np.ones((len(ahead), 1))], axis=1) @ image_from_velo.T
    front = projected[:, 2] > 0
    ahead, projected = ahead[front], projected[front]
    u, v = (np.rint(projected[:, axis] / projected[:, 2]).astype(int) - 1 for axis in (0, 1))
    height, width = truth_shape(image, root)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    depth_m = projected[:, 2] if lidar_depth == "camera" else ahead[:, 0]
    nearest_m = np.full((height, width), np.inf)
    np.minimum.at(nearest_m, (v[inside], u[inside]), depth_m[inside])
    return np.where(np.isinf(nearest_m), 0.0, nearest_m).astype(np.float32)


def truth_shape(image: Any, root: Path) -> tuple[int, int]:
    """Return the (H, W) of the ground truth of an image."""
    if image.truth.suffix == ".png":
        return read_image_shape(image.truth)
    width, height = map(int, read_calibration(root / image.date, CAM_TO_CAM)[f"S_rect_0{CAMERAS[image.side]}"])
    return height, width


def errors(p_m: Float[ndarray, " n"], z_m: Float[ndarray, " n"], cap_m: float) -> dict[str, float]:
    """Return the METRICS of pixels, with the prediction clamped to [1 mm, cap] as in public evaluators."""
    clamped_m = np.clip(p_m, MIN_DEPTH_M, cap_m)
    ratio = np.maximum(clamped_m / z_m, z_m / clamped_m)
    abs_rel, rmse_m = np.mean(np.abs(clamped_m - z_m) / z_m), np.sqrt(np.mean((clamped_m - z_m) ** 2))
    log_rmse = np.sqrt(np.mean(np.log(clamped_m / z_m) ** 2))
    deltas = [np.mean(ratio < 1.25**power) for power in (1, 2, 3)]
    return dict(zip(METRICS, map(float, (abs_rel, rmse_m, log_rmse, *deltas)), strict=True))


def score_image(image: Any, source: DepthMaps, options: argparse.Namespace) -> dict[str, Any]:
    """Return the errors of an image: native, and scaled by s = median(z) / median(p) of the unclamped values.

    Pixels with ground truth from 1 mm to the cap inside the crop are scored; values are None without prediction.
    """
    truth_m = read_truth(image, Path(options.kitti), options.lidar_depth)
    scored = np.zeros(truth_m.shape, bool)
    parts = zip(CROPS.get(options.crop, ((0, 1), (0, 1))), truth_m.shape, strict=True)
    scored[*(slice(int(low * size), int(high * size)) for (low, high), size in parts)] = True
    scored &= (truth_m > MIN_DEPTH_M) & (truth_m < options.cap)
    predicted_m = source.read(f"kitti/{image.Index}")[scored]
    valid = is_valid_prediction(predicted_m)
    p_m, z_m = predicted_m[valid].astype(np.float64), truth_m[scored][valid].astype(np.float64)
    scale = median_scale(p_m, float(np.median(z_m))) if len(p_m) else None
    with np.errstate(over="ignore", under="ignore"):
        aligned = {"native": p_m, "scaled": p_m if scale is None else scale * p_m}
    return {
        "name": image.Index,
        "scored_px": len(predicted_m),
        "coverage": len(p_m) / max(len(predicted_m), 1),
        "scale": scale,
        **{name: errors(one, z_m, options.cap) if len(p_m) else NO_ERRORS for name, one in aligned.items()},
    }


def tabulate(images: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means over images, the median of s, and 95 % block bootstrap intervals over images."""
    values = pd.json_normalize(images).drop(columns=["name", "scored_px"]).astype(float)
    coverage, scored = mean(values.pop("coverage").tolist()), int(values["scale"].count())
    values["scale_median"] = values.pop("scale")
    resampling, known = resample(range(len(values))), values.dropna()
    draws = resampling.means(values.to_numpy())
    draws[:, -1] = resampling.medians(values["scale_median"].to_numpy())
    blocks = resampling.blocks(known.index.to_numpy())
    return {
        "images": len(images),
        "images_scored": scored,
        "coverage": coverage,
        "complete": scored == len(images) and coverage >= MIN_COMPARABLE_COVERAGE,
        **{key: {name: mean(known[f"{key}.{name}"].tolist()) for name in METRICS} for key in ("native", "scaled")},
        "scale_median": values["scale_median"].median(),
        "intervals": {name: interval(draws[:, column], blocks) for column, name in enumerate(values)},
    }


def pictures(root: Path, images: pd.DataFrame, camera: int) -> dict[str, Path]:
    """Return the files of a colour camera that exist, by view id."""
    stems = {f"kitti/{one.Index}": root / one.date / one.drive / one.frame for one in images.itertuples()}
    files = {key: [*stem.parent.glob(f"image_0{camera}/data/{stem.name}.*")] for key, stem in stems.items()}
    return {view_id: found[0] for view_id, found in files.items() if found}


def image_views(root: Path, images: pd.DataFrame) -> list[ImageViews]:
    """Return the rectified colour images by day and side; camera 3 has the right images of those of camera 2."""
    views = []
    for (date, side), of_day in images.groupby(["date", "side"]):
        cam = read_calibration(root / date, CAM_TO_CAM)
        left, right = (pictures(root, of_day, camera) for camera in (CAMERAS[side], CAMERAS["r"]))
        Ps = [cam[f"P_rect_0{camera}"].tolist() for camera in CAMERAS.values()]
        one, other = (Lens(P[0][0], P[1][1], P[0][2], P[1][2], (0.0, 0.0, 0.0, 0.0, 0.0)) for P in Ps)
        width, height = map(int, cam["S_rect_02"])
        cameras: Calibration = MonoCalibration(width, height, one if side == "l" else other)
        if side == "l" and left.keys() == right.keys():
            x_m = Ps[1][0][3] / Ps[1][0][0] - Ps[0][0][3] / Ps[0][0][0]
            cameras = StereoCalibration(width, height, one, other, (0.0, 0.0, 0.0), (x_m, 0.0, 0.0))
        right = right if isinstance(cameras, StereoCalibration) else {}
        views.append(ImageViews(root, f"kitti-{date}-{side}", left, right, cameras))
    return views


def run(options: argparse.Namespace) -> None:
    """Predict with the method, if one is named; score, write the requested files and print the means."""
    root, images, kind = Path(options.kitti), read_images(Path(options.images)), options.ground_truth
    images["truth"] = [truth_file(root, kind, image) for image in images.itertuples()]
    missing, images = images.index[images["truth"].isna()], images[images["truth"].notna()]
    if images.empty:
        raise InputError(f"{options.kitti}: has no {kind} ground truth of the {len(missing)} images of the list")
    shapes = {f"kitti/{image.Index}": truth_shape(image, root) for image in images.itertuples()}
    with ProgressBars() as bars:
        if options.method:
            views = image_views(root, images)
            predict_views(find_method(options.method), views, options.predictions, bars.update)
        with open_maps(options.predictions, shapes, 1 / 256, optional="kitti/" + missing) as source:
            work, each = partial(score_image, source=source, options=options), images.itertuples()
            rows = map_in_threads(
                work, each, len(images), "scoring", workers=options.workers, progress=bars.update
            )
            scored = [row for row in rows if row["scored_px"]]
    if not scored:
        raise InputError(f"{options.kitti}: no image has ground truth inside the crop {options.crop}")
    protocol = {"ground_truth": kind, "crop": options.crop, "cap_m": options.cap}
    content = {
        **Provenance(PROTOCOL, None, [SubmissionIdentity(source.method, source.sha256)]).to_dict(),
        "intervals": INTERVALS,
        "method": source.method,
        "kitti": protocol | {"lidar_depth": options.lidar_depth, "found": len(images), "missing": [*missing]},
        "table": (means := tabulate(scored)),
        "images": scored,
    }
    table = pd.DataFrame({"alignment": key, **means[key]} for key in ("native", "scaled"))
    notes = [PUBLISHED, *(f"{key}: {means[key]}" for key in (*[*means][:4], "scale_median"))]
    errors_of = pd.json_normalize(scored)[["native.abs_rel", "scaled.abs_rel"]]
    draw = partial(errors_of.plot.hist, bins=30, alpha=0.5, xlabel="AbsRel of an image")
    write_outputs(options, content, table, list(table), notes, lambda figure: draw(ax=figure.subplots()))


if __name__ == "__main__":
    sys.exit(run_script(argument_parser(), run))
