"""Statistics and pictures of generated cages, without rendering.

python -m benchmarks.cages [--cages N] [--sheet FILE] [--plot FILE]

Prints, by family, how long a cage takes, how many bars it has, and how often designs and deviations were refused.
``--sheet`` writes a contact sheet of 64 cages, ``--plot`` the distributions of covers, diameters and spacings
beside the ranges of the rules.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.inspection.picture import corner_view
from dataset_builder.inspection.summary import inspect_cage
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.assemblies.generated import cage_bars
from dataset_builder.scene.cages.families import FAMILIES
from dataset_builder.scene.cages.generate import GeneratedCage, generate_cage
from dataset_builder.scene.cages.rules import COVER_M, DIAMETERS_M, GROUND_COVER_M
from rebar_depth_bench.reporting.figure.drawing import font

SPLIT, COLUMNS, SHEET_CAGES = "train", 8, 64
_PANEL_PX = (480, 320)
_PLOTTED: Mapping[str, tuple[float, float]] = {
    "bar_m": (min(DIAMETERS_M), max(DIAMETERS_M)),
    "link_m": (min(DIAMETERS_M), max(DIAMETERS_M)),
    "cover_m": (COVER_M[0], GROUND_COVER_M[1]),
    "spacing_m": (0.06, 0.40),
}
"""Parameters that are plotted, with the range of the rules."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks.cages")
    parser.add_argument("--cages", type=int, default=1000, help="number of cages")
    parser.add_argument("--sheet", type=Path, help="picture of the first 64 cages to write")
    parser.add_argument("--plot", type=Path, help="picture of the distributions to write")
    options = parser.parse_args(arguments)
    cages: defaultdict[str, list[GeneratedCage]] = defaultdict(list)
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    first: list[GeneratedCage] = []
    for number in range(options.cages):
        start = time.perf_counter()
        cage = generate_cage(SPLIT, number)
        seconds[cage.family].append(time.perf_counter() - start)
        cages[cage.family].append(cage)
        first += [cage] if len(first) < SHEET_CAGES else []
    print(f"{options.cages} cages of the split {SPLIT}; {machine_description()}\n")
    head = ["family", "cages", "median s", "max s", "bars", "designs refused", "smaller deviations", "left out"]
    print_markdown(
        [*head, "doubled"], [_row(name, cages[name], seconds[name]) for name in FAMILIES if cages[name]]
    )
    if options.sheet:
        contact_sheet(first).save(options.sheet)
    if options.plot:
        distributions(cages).save(options.plot)
    return 0


def _row(family: str, cages: Sequence[GeneratedCage], seconds: Sequence[float]) -> tuple[str | int, ...]:
    bars = [len(cage.bars) for cage in cages]
    refused = sum(sum(cage.record["designs_refused"].values()) for cage in cages)
    reduced = sum(cage.record["deviations_reduced"] + cage.record["deviations_refused"] for cage in cages)
    return (
        family,
        len(cages),
        f"{statistics.median(seconds):.2f}",
        f"{max(seconds):.2f}",
        f"{min(bars)}-{max(bars)}",
        f"{refused / (refused + len(cages)):.0%}",
        f"{reduced / sum(bars):.0%}",
        sum(len(cage.record["left_out"]) for cage in cages),
        sum(cage.record["doubled"] for cage in cages),
    )


def contact_sheet(cages: Sequence[GeneratedCage]) -> Image.Image:
    """Return pictures of the cages side by side, each with its number, family and shape."""
    width, height = _PANEL_PX
    sheet = Image.new("RGB", (COLUMNS * width, -(-len(cages) // COLUMNS) * height), "white")
    for number, cage in enumerate(cages):
        view = corner_view(inspect_cage(Cage(cage_bars(cage)), str(number)))
        view.paste("white", (0, 0, view.width, 48))
        title = f"{number} {cage.family}, {cage.record['parameters']['shape']}"
        ImageDraw.Draw(view).text((40, 4), title, "black", font(36))
        sheet.paste(view.resize(_PANEL_PX), (number % COLUMNS * width, number // COLUMNS * height))
    return sheet


def distributions(cages: Mapping[str, Sequence[GeneratedCage]]) -> Image.Image:
    """Return histograms of the plotted parameters, a row per family and a column per parameter."""
    width, height, bins = 420, 130, 24
    picture = Image.new("RGB", (160 + len(_PLOTTED) * width, 60 + len(FAMILIES) * height), "white")
    draw = ImageDraw.Draw(picture)
    for column, (name, limits) in enumerate(_PLOTTED.items()):
        left = 160 + column * width
        text = f"{name.removesuffix('_m')}: {limits[0] * 1000:g} to {limits[1] * 1000:g} mm (lines)"
        draw.text((left, 16), text, "black", font(20))
        low, high = 0.0, 1.15 * limits[1]
        for row, family in enumerate(FAMILIES):
            bottom = 60 + (row + 1) * height - 24
            values = [float(cage.record["parameters"].get(name, np.nan)) for cage in cages[family]]
            counts, edges = np.histogram([v for v in values if np.isfinite(v)], bins, (low, high))
            scale = (width - 60) / (high - low)
            for count, edge, next_edge in zip(counts, edges, edges[1:], strict=False):
                top = bottom - (height - 50) * count / max(1, counts.max())
                draw.rectangle((left + edge * scale, top, left + next_edge * scale - 2, bottom), (0, 90, 160))
            for limit in limits:
                draw.line(
                    (left + limit * scale, bottom - height + 40, left + limit * scale, bottom), (214, 0, 60), 2
                )
            if column == 0:
                draw.text((16, bottom - height // 2), family, "black", font(20))
    return picture


if __name__ == "__main__":
    raise SystemExit(main())
