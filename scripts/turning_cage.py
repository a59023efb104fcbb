"""Turning picture of the README: the exact steel of a cage, and a prediction of it in the colours of its error.

rebar-build --out ROOT --scene examples/beam.toml --views 16 --width 640 --height 360 --quality preview
rebar-bench predict sgbm --data ROOT --out sgbm.zip
python -m scripts.turning_cage ROOT sgbm.zip docs/pictures/turning.webp
rebar-bench score sgbm.zip --data ROOT --json sgbm.json

Both halves have the steel pixels of all views of the first config, placed in the world by the true cameras. The
colours are those of reports: blue is too near, brown too far. Pixels without a prediction are grey, at their true
places. The last command states the numbers of the README: ``coverage`` and ``within_mm.10``.
"""

from __future__ import annotations

import io
import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

import rebar_depth_bench as rdb
from rebar_depth_bench.geometry.cameras import inverse_rigid, pixel_rays, transform
from rebar_depth_bench.reporting.colormap import ERROR_COLOURS, colour_indices
from rebar_depth_bench.scoring.evaluation import open_evaluation
from rebar_depth_bench.scoring.metrics import is_valid_prediction

LIMIT_MM = 10
"""Error at the ends of the colours."""
FRAMES, FRAME_MS = 72, 125
MIDDLE_DEG, SWING_DEG, ELEVATION_DEG = 34, 32, 24
"""Azimuth of the middle of the swing, its extent to either side, and elevation of the eye."""
PANEL, HEAD, FOOT, FONT_PX = (320, 270), 40, 48, 21
OVERSAMPLING, SPLAT = 2, 4
"""Size of the drawing over that of the panel, and side of the square of a point in the drawing, pixels."""
BACKGROUND, INK, STEEL, MISSING = (27, 30, 34), (232, 234, 237), (176, 180, 186), (92, 96, 102)
MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class Cloud:
    """Points in the world, metres, with their colours."""

    points_m: Float64[ndarray, "n 3"]
    colours: UInt8[ndarray, "n 3"]


def main(root: str, archive: str, out: str) -> None:
    """Write the animation of the views of ``root`` and of the predictions in ``archive`` as a WebP file.

    The quality is the highest for which the file is small enough.
    """
    true_m, predicted_m, colours = [], [], []
    with open_evaluation(archive, root) as evaluation:
        config, method = next(iter(evaluation.folder.config_by_name)), evaluation.meta.method
        for row in rdb.load(root, config):
            steel = row["left_mask"] > 0
            z_m = row["left_depth"][steel].astype(np.float64)
            p_m = evaluation.submission.read(row["view_id"])[steel].astype(np.float64)
            valid = is_valid_prediction(p_m)
            height, width = steel.shape
            rays = pixel_rays(row["left_K"], width, height, row["left_distortion"])[steel]
            world_from_cam = inverse_rigid(row["left_cam_from_world"])
            true_m.append(transform(world_from_cam, rays * z_m[:, None]))
            predicted_m.append(transform(world_from_cam, rays * np.where(valid, p_m, z_m)[:, None]))
            error = ERROR_COLOURS[colour_indices(1000 * (p_m - z_m), -LIMIT_MM, LIMIT_MM)]
            colours.append(np.where(valid[:, None], error, np.array(MISSING, np.uint8)))
    truth_m = np.concatenate(true_m)
    truth = Cloud(truth_m, np.full(truth_m.shape, STEEL, np.uint8))
    predicted = Cloud(np.concatenate(predicted_m), np.concatenate(colours))
    frames = []
    for phase in np.linspace(0, 2 * np.pi, FRAMES, endpoint=False):
        azimuth = np.radians(MIDDLE_DEG + SWING_DEG * np.sin(phase))
        frame = frame_without_clouds(config, method)
        for n, cloud in enumerate((truth, predicted)):
            frame.paste(drawn(cloud, azimuth, truth_m.min(0), truth_m.max(0)), (n * PANEL[0], HEAD))
        frames.append(frame)
    for quality in range(60, 4, -4):
        options = {"duration": FRAME_MS, "loop": 0, "quality": quality, "method": 4}
        encoded = io.BytesIO()
        frames[0].save(encoded, "WEBP", save_all=True, append_images=frames[1:], **options)
        size = encoded.tell()
        if size <= MAX_BYTES:
            break
    else:
        sys.exit(
            f"{out}: not written, {size // 1000} kB in quality {quality}, expected {MAX_BYTES // 1000} at most"
        )
    Path(out).write_bytes(encoded.getvalue())
    print(f"{out}: {frames[0].width} x {frames[0].height}, {FRAMES} frames, quality {quality}, {size // 1000} kB")


def drawn(
    cloud: Cloud, azimuth: float, low_m: Float64[ndarray, " 3"], high_m: Float64[ndarray, " 3"]
) -> Image.Image:
    """Return a panel: a parallel projection of the cloud. The box from ``low_m`` to ``high_m`` fills its width."""
    width, height = (OVERSAMPLING * side for side in PANEL)
    elevation = np.radians(ELEVATION_DEG)
    level = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    ahead = level * np.cos(elevation) - np.array([0, 0, np.sin(elevation)])
    right = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    points_px = (cloud.points_m - (low_m + high_m) / 2) * width / np.hypot(*(high_m - low_m)[:2])
    farthest_first = np.argsort(-(points_px @ ahead), kind="stable")
    points_px, colours = points_px[farthest_first], cloud.colours[farthest_first]
    x = np.rint(width / 2 + points_px @ right).astype(int)
    y = np.rint(height / 2 - points_px @ np.cross(right, ahead)).astype(int)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    point = np.full((height, width), -1)
    point[y[inside], x[inside]] = np.flatnonzero(inside)  # The last, nearest point of a pixel stays.
    depth_px = np.where(point < 0, np.inf, (points_px @ ahead)[point])
    image, nearest_px = np.full((height, width, 3), BACKGROUND, np.uint8), np.full((height, width), np.inf)
    for step in np.ndindex(SPLAT, SPLAT):
        shift = (step[0] - SPLAT // 2, step[1] - SPLAT // 2)
        shifted_px = np.roll(depth_px, shift, (0, 1))
        closer = shifted_px < nearest_px
        nearest_px[closer] = shifted_px[closer]
        image[closer] = colours[np.roll(point, shift, (0, 1))[closer]]
    light = np.where(np.isinf(nearest_px), 1, shade(nearest_px))
    drawing = Image.fromarray((image * light[..., None]).astype(np.uint8))
    return drawing.resize(PANEL, Image.Resampling.BOX)


def shade(depth_px: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
    """Return the light of each pixel, less where pixels nearby are nearer (eye-dome lighting)."""
    hidden = np.zeros(depth_px.shape)
    for axis, step in itertools.product((0, 1), (-4, -2, 2, 4)):
        with np.errstate(invalid="ignore"):
            behind_px = depth_px - np.roll(depth_px, step, axis)
        hidden += np.clip(np.nan_to_num(behind_px, nan=0, posinf=0, neginf=0) / 24, 0, 1)
    light: ndarray = np.exp(-0.22 * hidden)
    return light


def frame_without_clouds(config: str, method: str) -> Image.Image:
    """Return the headings of the panels and the legend."""
    image = Image.new("RGB", (2 * PANEL[0], HEAD + PANEL[1] + FOOT), BACKGROUND)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(FONT_PX)
    for n, text in enumerate((f"{config}: exact depth", f"{method}: predicted depth")):
        draw.text(((n + 0.5) * PANEL[0], HEAD / 2), text, INK, font, anchor="mm")
    middle, left, width = HEAD + PANEL[1] + FOOT // 2, 172, 136
    bar = Image.fromarray(ERROR_COLOURS[None]).resize((width, FONT_PX), Image.Resampling.BILINEAR)
    image.paste(bar, (left, middle - FONT_PX // 2))
    draw.text((left - 10, middle), f"{LIMIT_MM} mm too near", INK, font, anchor="rm")
    draw.text((left + width + 10, middle), f"{LIMIT_MM} mm too far", INK, font, anchor="lm")
    draw.rectangle((500, middle - FONT_PX // 2, 500 + FONT_PX, middle + FONT_PX // 2), MISSING)
    draw.text((500 + FONT_PX + 10, middle), "no depth", INK, font, anchor="lm")
    return image


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python -m scripts.turning_cage ROOT ARCHIVE OUT.webp")
    main(*sys.argv[1:])
