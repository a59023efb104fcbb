"""Pictures of the documentation, from the output of the demo.

``make demo``, then ``python -m scripts.documentation_pictures demo-output docs`` writes ``lattice.webp`` (colour,
depth and bar ids of a view) and screenshots of a report and of a leaderboard to ``docs/pictures``. It needs the
environment for developing and the system's Chromium.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import Locator, sync_playwright

import rebar_depth_bench as rdb
from rebar_depth_bench.reporting.colormap import DEPTH_COLOURS, colour_indices
from tests.leaderboard.serving import make_token, running_server
from tests.requirements import chromium_path

PANEL = (640, 360)
WINDOW = {"width": 1100, "height": 900}
METHODS = ("sgbm", "sgbm-filled", "constant")


def main(demo: str, docs: str) -> None:
    """Write the pictures of the demo's output in the folder ``demo`` to the folder ``docs``."""
    view_strip(Path(demo, "dataset")).save(Path(docs, "lattice.webp"), "WEBP", quality=82)
    pictures = Path(docs, "pictures")
    pictures.mkdir(exist_ok=True)
    screenshots(Path(demo).resolve(), pictures)


def view_strip(root: Path) -> Image.Image:
    """Return colour, depth and bar ids of the first lattice view, side by side."""
    row = rdb.load(str(root), "lattice", columns=["left_rgb", "left_depth", "left_bars"])[0]
    steel = row["left_bars"] > 0
    near_m, far_m = row["left_depth"][steel].min(), row["left_depth"][steel].max()
    depth = DEPTH_COLOURS[colour_indices(-row["left_depth"], -far_m, -near_m)]
    hues = np.random.default_rng(1).integers(70, 240, (np.iinfo(np.uint16).max + 1, 3)).astype(np.uint8)
    bars = np.where(steel[..., None], hues[row["left_bars"]], np.uint8(24))
    panels = [
        Image.fromarray(panel).resize(PANEL, Image.Resampling.LANCZOS) for panel in (row["left_rgb"], depth, bars)
    ]
    strip = Image.new("RGB", (PANEL[0] * len(panels), PANEL[1]))
    for n, panel in enumerate(panels):
        strip.paste(panel, (n * PANEL[0], 0))
    return strip


def screenshots(demo: Path, pictures: Path) -> None:
    """Write screenshots of the report of SGBM, and of a leaderboard with the archives of the demo."""
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium_path(), args=["--no-sandbox"])
        page = browser.new_page(viewport=WINDOW, color_scheme="light")  # type: ignore[arg-type]
        page.goto((demo / "sgbm.html").as_uri())
        _save(page.locator("section[aria-labelledby=results]"), pictures / "report.webp")
        _save(page.locator("article:visible").first, pictures / "report-view.webp")
        state = Path(scratch) / "state"
        token = make_token(state, "Example Institute")
        with running_server(demo / "dataset", state, error_maps=2) as server:
            ids = [server.submit_accepted(demo / f"{method}.zip", token) for method in METHODS]
            for submission_id in ids:
                server.wait_until_ended(submission_id)
            page.goto(f"{server.url}/?config=lattice")
            _save(page.locator("body"), pictures / "leaderboard.webp")
            page.goto(f"{server.url}/submissions/{ids[0]}")
            _save(page.locator("body"), pictures / "submission.webp", 1400)
        browser.close()


def _save(part: Locator, file: Path, max_height: int = 1000) -> None:
    """Save a screenshot of a part of a page, cut below ``max_height`` pixels."""
    part.scroll_into_view_if_needed()
    image = Image.open(io.BytesIO(part.screenshot()))
    image.crop((0, 0, image.width, min(image.height, max_height))).save(file, "WEBP", quality=80)


if __name__ == "__main__":
    main(*sys.argv[1:])
