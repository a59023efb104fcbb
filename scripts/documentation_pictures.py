"""Pictures of the documentation, made from a dataset folder: views, reports and pages of a leaderboard.

rebar-build --out ROOT --config lattice pile pier --views 12 --width 640 --height 360 --quality preview
rebar-build --out ROOT --config cages --split test --scenes 40 --views-per-scene 4 --width 640 --height 360 \
    --quality preview
rebar-build --out MAT --scene examples/mat.toml --views 12 --width 480 --height 270 --quality preview
python -m scripts.documentation_pictures ROOT MAT docs/pictures

The dataset needs the configs in colour. Methods that take less than a second a view are run
and scored; the pages are those that users see, in the system's Chromium.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page, sync_playwright

import rebar_depth_bench as rdb
from rebar_depth_bench.methods.sgbm import SGBM
from rebar_depth_bench.remote.leaderboard_client import LeaderboardClient
from rebar_depth_bench.reporting.html.views import depth_image, error_image

METHODS = ("sgbm-filled", "sgbm", "board-plane", "constant", "truth")
REPORT_METHOD, BOARD_METHOD = "sgbm-filled", "sgbm"
"""Methods whose report, and whose page of the leaderboard, are shown."""
SHOWN = ("lattice", "pile")
"""Configs whose results are shown; the pier has no board, which ``board-plane`` needs."""
PANEL = (640, 360)
CAGES = ("slab-test0014", "beam-test0022", "column-test0032", "pile-cage-test0017")
"""Scenes of cages that are shown, of which the first view is taken."""
CAGE_PANEL = (384, 216)
CAGE_HEAD, CAGE_GAP = 48, 8
BACKGROUND = (24, 24, 24)
ERROR_LIMIT_CM = 2.0
MAX_BYTES = 200_000
START_S = 60.0
PROJECT = Path(__file__).parents[1]


def main(root: str, mat: str, target: str) -> None:
    """Write the pictures of the dataset folders ``root`` and ``mat`` to the folder ``target`` as WebP files."""
    data, out = Path(root).resolve(), Path(target).resolve()
    save(view_strip(data), out / "lattice.webp")
    save(cage_grid(data), out / "cages.webp")
    for name, target_name in (("scenes", "scenes"), ("lattice", "contact-sheet")):
        shutil.copyfile(data / "pictures" / f"{name}.webp", out / f"{target_name}.webp")
    save(opened((Path(mat) / "pictures" / "mat.webp").read_bytes()), out / "mat.webp")
    with tempfile.TemporaryDirectory() as name, chromium() as page:
        work = Path(name)
        save(cage_picture(work), out / "inspect.webp")
        archives = [predicted(method, data, work) for method in METHODS]
        report = work / "report.html"
        run(
            "rebar_depth_bench",
            "score",
            str(work / f"{REPORT_METHOD}.zip"),
            "--data",
            str(data),
            "--html",
            str(report),
        )
        report_pictures(page, report, out)
        with leaderboard(data, work / "board", archives) as (url, pages):
            board_pictures(page, url, pages[METHODS.index(BOARD_METHOD)], out)


def view_strip(data: Path, view: int = 0) -> Image.Image:
    """Return colour, depth and bar ids of one view of the lattice, side by side."""
    row = rdb.load(data, "lattice", columns=["left_rgb", "left_depth", "left_bars"])[view]
    return side_by_side(truth_images(row), PANEL)


def cage_grid(data: Path) -> Image.Image:
    """Return a row per cage: colour, depth, bar ids and the signed error of SGBM, below their headings."""
    sgbm = SGBM.load()
    rows = rdb.load(data, "cages")
    first = [rows["scene"].index(cage) for cage in CAGES]
    strips = []
    for row in map(rows.__getitem__, first):
        error_m = sgbm(row).astype(np.float64) - row["left_depth"]
        error_m[~(error_m > -row["left_depth"])] = np.nan  # No prediction.
        error = error_image(error_m, row["left_bars"] > 0, row["left_rgb"], ERROR_LIMIT_CM)
        strips.append(side_by_side([*truth_images(row), error], CAGE_PANEL))
    step = CAGE_PANEL[1] + CAGE_GAP
    grid = Image.new("RGB", (strips[0].width, CAGE_HEAD + len(strips) * step - CAGE_GAP), BACKGROUND)
    draw = ImageDraw.Draw(grid)
    font = ImageFont.load_default(CAGE_HEAD * 0.75)
    for n, head in enumerate(("colour", "exact depth", "bar ids", f"SGBM error, ± {10 * ERROR_LIMIT_CM:g} mm")):
        draw.text(((n + 0.5) * CAGE_PANEL[0], CAGE_HEAD / 2), head, "white", font, anchor="mm")
    for n, strip in enumerate(strips):
        grid.paste(strip, (0, CAGE_HEAD + n * step))
    return grid


def truth_images(row: Mapping[str, np.ndarray]) -> list[np.ndarray]:
    """Return colour, depth in the range of the steel, and bar ids of a view as images."""
    steel = row["left_bars"] > 0
    depth = depth_image(row["left_depth"], row["left_depth"][steel].min(), row["left_depth"][steel].max())
    hues = np.random.default_rng(1).integers(70, 240, (np.iinfo(np.uint16).max + 1, 3)).astype(np.uint8)
    return [
        row["left_rgb"],
        depth,
        np.where(steel[..., None], hues[row["left_bars"]], np.array(BACKGROUND, np.uint8)),
    ]


def side_by_side(images: Sequence[np.ndarray], panel: tuple[int, int]) -> Image.Image:
    """Return images of the size ``panel`` in one row."""
    strip = Image.new("RGB", (panel[0] * len(images), panel[1]))
    for n, image in enumerate(images):
        strip.paste(Image.fromarray(image).resize(panel, Image.Resampling.LANCZOS), (n * panel[0], 0))
    return strip


def cage_picture(work: Path) -> Image.Image:
    """Return the picture that ``rebar-build inspect`` draws of the example cage."""
    picture = work / "beam.png"
    scene = PROJECT / "examples" / "beam.toml"
    run("dataset_builder", "inspect", str(scene), "--picture", str(picture))
    with Image.open(picture) as image:
        return image.convert("RGB")


def report_pictures(page: Page, report: Path, out: Path) -> None:
    """Photograph the head of a report and its browser of views."""
    page.goto(report.as_uri())
    results_top, _ = extent(page, "section[aria-labelledby=results]")
    save(photograph(page, 0, results_top + 520), out / "report.webp")
    top, _ = extent(page, "section.browser .controls")
    _, bottom = extent(page, "section.browser article:visible")
    save(photograph(page, top - 2, bottom + 12), out / "report-view.webp")


def board_pictures(page: Page, url: str, submission: str, out: Path) -> None:
    """Photograph the ranking of a config, and the page of a submission."""
    page.goto(f"{url}/?config=lattice")
    _, bottom = extent(page, "table tbody")
    save(photograph(page, 0, bottom), out / "leaderboard.webp")
    page.goto(submission)
    save(photograph(page, 0, 900), out / "submission.webp")


def predicted(method: str, data: Path, work: Path) -> Path:
    """Return the archive of a method's predictions."""
    archive = work / f"{method}.zip"
    run("rebar_depth_bench", "predict", method, "--data", str(data), "--out", str(archive), "--config", *SHOWN)
    return archive


@contextmanager
def leaderboard(data: Path, state: Path, archives: Sequence[Path]) -> Iterator[tuple[str, list[str]]]:
    """Run a leaderboard with scored submissions; yield its URL and those of the pages of the submissions."""
    token = run("leaderboard", "token", "documentation", "--state-dir", str(state)).strip()
    command = [sys.executable, "-m", "leaderboard", "serve", "--data", str(data), "--state-dir", str(state)]
    server = subprocess.Popen([*command, "--port", "0"], stderr=subprocess.PIPE, text=True)
    try:
        url = _announced_url(server)
        client = LeaderboardClient(url, token)
        # The first of the archives is submitted last, and is the newest.
        accepted = [client.submit(archive) for archive in reversed(archives)]
        for submission in accepted:
            client.wait(submission)
        yield url, [submission.url for submission in reversed(accepted)]
    finally:
        server.terminate()
        server.wait()


def _announced_url(server: subprocess.Popen[str]) -> str:
    """Return the URL that a server prints when it has started, and leave the rest of its log unread."""
    assert server.stderr is not None
    end = time.monotonic() + START_S
    while time.monotonic() < end:
        for word in server.stderr.readline().split():
            if word.startswith("http://"):
                return word.rstrip("/")
    raise TimeoutError(f"the leaderboard has not started within {START_S:g} s")


@contextmanager
def chromium(width: int = 1280) -> Iterator[Page]:
    """Open a page of the system's Chromium, in light colours."""
    with sync_playwright() as playwright:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser.new_page(viewport={"width": width, "height": 900}, color_scheme="light")
        browser.close()


def extent(page: Page, selector: str) -> tuple[float, float]:
    """Return the top and the bottom of the first such element of a page that is not scrolled, in pixels."""
    box = page.locator(selector).first.bounding_box()
    assert box is not None
    return box["y"], box["y"] + box["height"]


def photograph(page: Page, top: float, bottom: float) -> Image.Image:
    """Return the part of a page between two heights, in pixels."""
    width = (page.viewport_size or {"width": 1280})["width"]
    clip = {"x": 0, "y": top, "width": width, "height": bottom - top}
    return opened(page.screenshot(full_page=True, clip=clip))  # type: ignore[arg-type]


def opened(content: bytes) -> Image.Image:
    """Return the image of a PNG or WebP file."""
    return Image.open(io.BytesIO(content)).convert("RGB")


def save(image: Image.Image, path: Path) -> None:
    """Write a WebP file of at most ``MAX_BYTES``, with the highest quality for which it is small enough."""
    for quality in (90, 82, 74, 66, 58, 50):
        stream = io.BytesIO()
        image.save(stream, "WEBP", quality=quality, method=6)
        if stream.tell() <= MAX_BYTES:
            break
    path.write_bytes(stream.getvalue())
    print(f"{path.name}: {image.width} x {image.height}, {stream.tell() // 1000} kB")


def run(module: str, *arguments: str) -> str:
    """Run a command of the project; return its standard output."""
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    main(*sys.argv[1:])
