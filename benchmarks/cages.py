"""Statistics and pictures of generated cages, without rendering.

python -m benchmarks.cages [--cages N] [--sheet FILE] [--plot FILE]

Prints, by family, the processor time of a cage, how many bars it has, how often designs and deviations were
refused, and how far the ends of bars are from the design. ``--sheet`` writes a contact sheet of 64 cages,
``--plot`` the distributions of diameters, covers, spacings, areas of steel and deviations beside the limits of the
rules.
"""

from __future__ import annotations

import argparse
import io
import statistics
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from PIL import Image, ImageDraw

from benchmarks.timing import machine_description, print_markdown
from dataset_builder.inspection.picture import font, inspection_picture
from dataset_builder.inspection.summary import inspect_cage
from dataset_builder.scene.assemblies.cage import Cage
from dataset_builder.scene.cages.as_built import (
    END_TOLERANCE_M,
    PLACE_TOLERANCE_M,
    PLUS_TOLERANCES_M,
    SPACING_TOLERANCE_M,
)
from dataset_builder.scene.cages.generate import FAMILIES, GeneratedCage, cage_bars, generate_cage
from dataset_builder.scene.cages.rules import (
    BEAM_STEEL,
    COLUMN_STEEL,
    COVER_M,
    DIAMETERS_M,
    GROUND_COVER_M,
    SLAB_STEEL,
    WALL_STEEL,
)

SPLIT, COLUMNS, SHEET_CAGES = "train", 8, 64
_PANEL_PX = (480, 365)


@dataclass(frozen=True)
class Plotted:
    """Quantity of a column of the plot: title, unit and its size, labels of the axis, limits and their source."""

    title: str
    unit: str
    per_unit: float
    labels: Sequence[int]
    limits: tuple[float, float]
    source: str
    other_limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Limits of families that have others."""

    def limits_of(self, family: str) -> tuple[float, float]:
        """Return the limits of a family, metres or shares."""
        return self.other_limits.get(family, self.limits)


_SHARES = {
    "beam": BEAM_STEEL,
    "wall": WALL_STEEL,
    "slab": SLAB_STEEL,
    "footing": SLAB_STEEL,
    "pile-cage": (0.0025, 0.04),
}
_PLOTTED: Mapping[str, Plotted] = {
    "bar_m": Plotted(
        "main bars", "mm", 1e-3, range(0, 50, 10), (min(DIAMETERS_M), max(DIAMETERS_M)), "sizes of EN 10080"
    ),
    "link_m": Plotted(
        "links, ties, chairs", "mm", 1e-3, range(0, 50, 10), (0.006, max(DIAMETERS_M)), "EN 1992-1-1, 9.5.3 (1)"
    ),
    "cover_m": Plotted(
        "cover",
        "mm",
        1e-3,
        range(0, 100, 20),
        COVER_M,
        "EN 1992-1-1, 4.4.1",
        dict.fromkeys(("footing", "pile-cage"), GROUND_COVER_M),
    ),
    "spacing_m": Plotted(
        "spacing",
        "mm",
        1e-3,
        range(0, 600, 100),
        (0.0, 0.400),
        "EN 1992-1-1, 9.2.2, 9.3.1.1, 9.5.3, 9.6.2",
        {"beam": (0.0, 0.486)},
    ),
    "steel_share": Plotted("steel", "%", 1e-2, range(5), COLUMN_STEEL, "EN 1992-1-1, 9.2-9.8", _SHARES),
    "deviation_m": Plotted(
        "deviation of bars",
        "mm",
        1e-3,
        range(0, 50, 10),
        (0.0, SPACING_TOLERANCE_M + PLACE_TOLERANCE_M + END_TOLERANCE_M),
        "displacement, tilt and spacing of as_built.py",
    ),
    "mats_m": Plotted(
        "deviation of mats",
        "mm",
        1e-3,
        range(0, 50, 10),
        (PLUS_TOLERANCES_M[2][0], PLUS_TOLERANCES_M[1][-1]),
        "plus tolerances of EN 13670, 10.6",
    ),
}
"""Parameters of the record that are plotted, and the deviations of ends of bars and of the cover of mats."""


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
        start = time.process_time()
        cage = generate_cage(SPLIT, number)
        seconds[cage.family].append(time.process_time() - start)
        cages[cage.family].append(cage)
        first += [cage] if len(first) < SHEET_CAGES else []
    print(f"{options.cages} cages of the split {SPLIT}; {machine_description()}\n")
    head = ["family", "cages", "median CPU s", "max CPU s", "bars", "designs refused", "smaller deviations"]
    head += ["deviation median / 95 %, mm", "left out", "doubled"]
    print_markdown(head, [_row(name, cages[name], seconds[name]) for name in FAMILIES if cages[name]])
    if options.sheet:
        contact_sheet(first).save(options.sheet)
    if options.plot:
        distributions(cages).save(options.plot)
    return 0


def _row(family: str, cages: Sequence[GeneratedCage], seconds: Sequence[float]) -> tuple[str | int, ...]:
    bars = [len(cage.bars) for cage in cages]
    refused = sum(sum(cage.record["designs_refused"].values()) for cage in cages)
    reduced = sum(cage.record["deviations_reduced"] + cage.record["deviations_refused"] for cage in cages)
    median_mm, high_mm = 1000 * np.quantile(np.concatenate([deviations_m(cage) for cage in cages]), (0.5, 0.95))
    return (
        family,
        len(cages),
        f"{statistics.median(seconds):.2f}",
        f"{max(seconds):.2f}",
        f"{min(bars)}-{max(bars)}",
        f"{refused / (refused + len(cages)):.0%}",
        f"{reduced / sum(bars):.0%}",
        f"{median_mm:.1f} / {high_mm:.1f}",
        sum(len(cage.record["left_out"]) for cage in cages),
        sum(cage.record["doubled"] for cage in cages),
    )


def contact_sheet(cages: Sequence[GeneratedCage]) -> Image.Image:
    """Return pictures of the cages from four sides, each with its number, family and shape."""
    width, height = _PANEL_PX
    sheet = Image.new("RGB", (COLUMNS * width, -(-len(cages) // COLUMNS) * height), "white")
    for number, cage in enumerate(cages):
        title = f"{number} {cage.family}, {cage.record['parameters']['shape']}"
        content = inspection_picture(inspect_cage(Cage(cage_bars(cage)), title))
        with Image.open(io.BytesIO(content)) as picture:
            sheet.paste(picture.resize(_PANEL_PX), (number % COLUMNS * width, number // COLUMNS * height))
    return sheet


def deviations_m(cage: GeneratedCage) -> Float64[ndarray, " n"]:
    """Return how far the farther end of each bar is from its place in the design."""
    return np.array(
        [
            np.linalg.norm(bar.line_m[[0, -1]] - bar.nominal_m[[0, -1]], axis=1).max()
            for bar in cage.bars
            if bar.nominal_m is not None
        ]
    )


def _values(cages: Sequence[GeneratedCage], name: str) -> Float64[ndarray, " n"]:
    if name == "deviation_m":
        return np.concatenate([deviations_m(cage) for cage in cages]) if cages else np.zeros(0)
    if name == "mats_m":
        return np.array([np.abs(mat["deviation_m"]).max() for cage in cages for mat in cage.record["mats"]])
    return np.array([cage.record["parameters"][name] for cage in cages if name in cage.record["parameters"]])


_CELL_PX, _LEFT_PX, _HEAD_PX, _STEPS = (380, 150), 170, 90, 44
_INK, _BAR, _LIMIT = (20, 20, 20), (0, 90, 160), (214, 0, 60)


def distributions(cages: Mapping[str, Sequence[GeneratedCage]]) -> Image.Image:
    """Return histograms of the plotted quantities: a row per family, a column per quantity, red limits."""
    width, height = _CELL_PX
    size = (_LEFT_PX + len(_PLOTTED) * width, _HEAD_PX + len(FAMILIES) * height)
    picture = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(picture)
    for column, (name, plotted) in enumerate(_PLOTTED.items()):
        left = _LEFT_PX + column * width
        draw.text((left, 14), f"{plotted.title}, {plotted.unit}", _INK, font(22))
        draw.text((left, 46), f"red: {plotted.source}", _LIMIT, font(13))
        for row, family in enumerate(FAMILIES):
            place = (left, _HEAD_PX + row * height)
            _histogram(draw, place, _values(cages.get(family, ()), name), plotted, plotted.limits_of(family))
    for row, family in enumerate(FAMILIES):
        top = _HEAD_PX + row * height + 40
        draw.text((16, top), family, _INK, font(22))
        draw.text((16, top + 28), f"{len(cages.get(family, ()))} cages", _INK, font(16))
    return picture


def _histogram(
    draw: ImageDraw.ImageDraw,
    place: tuple[int, int],
    values: Float64[ndarray, " n"],
    plotted: Plotted,
    limits: tuple[float, float],
) -> None:
    """Draw a histogram of ``_STEPS`` bars, relative to the highest one, over a labelled axis."""
    left, bottom, room = place[0], place[1] + _CELL_PX[1] - 40, _CELL_PX[1] - 60
    end = max(plotted.labels) * plotted.per_unit * 1.1
    scale = (_CELL_PX[0] - 50) / end
    counts, edges = np.histogram(values, _STEPS, (-end / _STEPS / 2, end * (1 - 0.5 / _STEPS)))
    for count, edge, next_edge in zip(counts.tolist(), edges.tolist(), edges[1:].tolist(), strict=False):
        if count:
            top = bottom - max(2, room * count / counts.max())
            draw.rectangle((left + max(edge, 0) * scale, top, left + next_edge * scale - 2, bottom), _BAR)
    draw.line((left, bottom, left + end * scale, bottom), _INK, 1)
    for label in plotted.labels:
        x = left + label * plotted.per_unit * scale
        draw.line((x, bottom, x, bottom + 5), _INK, 1)
        draw.text((x, bottom + 7), f"{label}", _INK, font(14), anchor="ma")
    for limit in limits:
        draw.line((left + limit * scale, bottom - room - 10, left + limit * scale, bottom), _LIMIT, 2)


if __name__ == "__main__":
    raise SystemExit(main())
