"""What counts of a KITTI image, and its numbers, as evaluators have them since Eigen et al., NeurIPS 2014.

The KITTI test images of Eigen et al., "Depth Map Prediction from a Single Image", NeurIPS 2014: 697 names.

``kitti_eigen_test_697.txt`` is the list as it goes round with public evaluators (Monodepth and its successors), a
line an image: ``<date>/<drive> <frame> <side>``. It holds names only, no data of KITTI.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib.resources import files

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray

from rebar_depth_bench.errors import RebarDepthError
from rebar_depth_bench.scoring.metrics import is_prediction, median_scale
from rebar_depth_bench.scoring.protocol import DELTA1_RATIO

MIN_DEPTH_M = 1e-3


@dataclass(frozen=True)
class Crop:
    """A part of the picture: from the first to before the second share of its rows, and of its columns."""

    rows: tuple[float, float]
    columns: tuple[float, float]


CROPS: Mapping[str, Crop] = {
    "garg": Crop((0.40810811, 0.99189189), (0.03594771, 0.96405229)),
    "eigen": Crop((0.3324324, 0.91351351), (0.03594771, 0.96405229)),
    "none": Crop((0.0, 1.0), (0.0, 1.0)),
}
"""Garg et al., ECCV 2016; Eigen et al., NeurIPS 2014. Shares times pixels are cut to whole numbers."""


@dataclass(frozen=True)
class KittiMetrics:
    """Errors of one image, or their means: p predicted and z true depth on the scored pixels, metres.

    ``abs_rel`` = mean(|p - z| / z); ``rmse_m`` = sqrt(mean((p - z)^2));
    ``log_rmse`` = sqrt(mean((ln p - ln z)^2)); ``delta1`` to ``delta3`` = share of pixels with max(p/z, z/p) below
    1.25, 1.25^2, 1.25^3.
    """

    abs_rel: float
    rmse_m: float
    log_rmse: float
    delta1: float
    delta2: float
    delta3: float


METRIC_NAMES = tuple(field.name for field in fields(KittiMetrics))


@dataclass(frozen=True)
class ImageScore:
    """One image: scored pixels, the share of them with a prediction, s, and the errors; None without any."""

    name: str
    scored_px: int
    coverage: float
    scale: float | None
    native: KittiMetrics | None
    scaled: KittiMetrics | None


def crop_mask(shape: tuple[int, int], crop: Crop) -> Bool[ndarray, "h w"]:
    """Return which pixels of an (H, W) picture a crop keeps."""
    height, width = shape
    top, bottom = (int(share * height) for share in crop.rows)
    left, right = (int(share * width) for share in crop.columns)
    kept = np.zeros(shape, dtype=bool)
    kept[top:bottom, left:right] = True
    return kept


def scored_mask(depth_m: Float32[ndarray, "h w"], crop: Crop, cap_m: float) -> Bool[ndarray, "h w"]:
    """Return the pixels that count: inside the crop, with ground truth above 1 mm and below the cap."""
    return np.asarray(
        crop_mask((depth_m.shape[0], depth_m.shape[1]), crop) & (depth_m > MIN_DEPTH_M) & (depth_m < cap_m)
    )


def score_image(
    name: str, depth_m: Float32[ndarray, "h w"], prediction_m: Float[ndarray, "h w"], crop: Crop, cap_m: float
) -> ImageScore | None:
    """Score a prediction on an image's pixels that count, None where there are none.

    Scaled: s = median(z)/median(p) of the prediction as it stands. After the alignment predictions are clamped to
    1 mm and the cap, as public evaluators do. What is not finite or <= 0 is no prediction: it is never clamped to
    something that could score, and lowers the coverage.
    """
    mask = scored_mask(depth_m, crop, cap_m)
    scored_px = int(np.count_nonzero(mask))
    if not scored_px:
        return None
    given = prediction_m[mask]
    valid = is_prediction(given)
    p_m, z_m = given[valid].astype(np.float64), depth_m[mask][valid].astype(np.float64)
    coverage = len(p_m) / scored_px
    if not len(p_m):
        return ImageScore(name, scored_px, coverage, None, None, None)
    scale = median_scale(p_m, float(np.median(z_m)))
    with np.errstate(over="ignore", under="ignore"):
        scaled_m = scale * p_m
    return ImageScore(
        name, scored_px, coverage, scale, kitti_metrics(p_m, z_m, cap_m), kitti_metrics(scaled_m, z_m, cap_m)
    )


def kitti_metrics(p_m: Float64[ndarray, " n"], z_m: Float64[ndarray, " n"], cap_m: float) -> KittiMetrics:
    """Return the errors of one or more pixels, the prediction clamped to 1 mm and the cap."""
    clamped_m = np.clip(p_m, MIN_DEPTH_M, cap_m)
    ratio = np.maximum(clamped_m / z_m, z_m / clamped_m)
    error_m = clamped_m - z_m
    deltas = [float(np.mean(ratio < DELTA1_RATIO**power)) for power in (1, 2, 3)]
    return KittiMetrics(
        float(np.mean(np.abs(error_m) / z_m)),
        float(np.sqrt(np.mean(error_m**2))),
        float(np.sqrt(np.mean(np.log(clamped_m / z_m) ** 2))),
        *deltas,
    )


CONFIG = "kitti"
SPLIT_FILE = "kitti_eigen_test_697.txt"
_LINE = re.compile(r"(\d{4}_\d\d_\d\d)/(\1_drive_\d{4}_sync) (\d{10}) ([lr])")
_CAMERAS = {"l": 2, "r": 3}


@dataclass(frozen=True, order=True)
class KittiImage:
    """One image: the day it was recorded, its drive, its frame number of ten digits, its side l or r."""

    date: str
    drive: str
    frame: str
    side: str

    @property
    def name(self) -> str:
        """The name of its prediction: ``<drive>_<frame>_<side>``."""
        return f"{self.drive}_{self.frame}_{self.side}"

    @property
    def view_id(self) -> str:
        """Its id in an archive: ``kitti/<drive>_<frame>_<side>``."""
        return f"{CONFIG}/{self.name}"

    @property
    def camera(self) -> int:
        """The colour camera's number in KITTI: 2 on the left, 3 on the right."""
        return _CAMERAS[self.side]


def eigen_test_images() -> tuple[KittiImage, ...]:
    """Return the 697 images, sorted: neighbours in time stand together."""
    return read_split(files("rebar_depth_bench.studies.kitti").joinpath(SPLIT_FILE).read_text(encoding="ascii"))


def read_split(text: str) -> tuple[KittiImage, ...]:
    """Return the images of a split list, sorted. Raises ``RebarDepthError`` for a line that is none or twice."""
    images: set[KittiImage] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        match = _LINE.fullmatch(line.strip())
        if match is None:
            raise RebarDepthError(f"{SPLIT_FILE}: line {number} is {line!r}, expected <date>/<drive> <frame> l|r")
        image = KittiImage(*match.groups())
        if image in images:
            raise RebarDepthError(f"{SPLIT_FILE}: line {number}: {image.name} stands twice")
        images.add(image)
    return tuple(sorted(images))
