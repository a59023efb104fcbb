"""Extended measures of the report: inspection, collapsed families, and crossings of bars."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.extended.crossings import MISS_DEG
from rebar_depth_bench.extended.estimates import ExtendedResult, ExtendedTable, MeasureEstimate
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.frames import CrossingSamples
from rebar_depth_bench.extended.ground_truth import load_steel_truth
from rebar_depth_bench.extended.measures import (
    EXTENDED_PROTOCOL,
    NATIVE,
    ONCE,
    SCALED,
    Measure,
    MeasureFamily,
)
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import fold_radius, project, transform
from rebar_depth_bench.reporting.extended_tables import FITS_NOTE, MISSED, is_miss, single_bar_sentence
from rebar_depth_bench.reporting.html.views import backdrop_image
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import DASH, Cell, Column
from rebar_depth_bench.scoring.evaluation import Evaluation

_HEAD_NOTES: Mapping[str, str] = {NATIVE: "no alignment", SCALED: "oracle median scale per view"}
_SHOWN_FAMILIES = ("inspection", "crossings")
"""Families that are shown openly; the others are collapsed, the deviation from the design first."""


@dataclass(frozen=True)
class MeasureTable:
    """Table of the measures of one family: a row per measure with a cell per alignment.

    ``heads`` are (alignment, note) of the columns; ``rows`` have the measure's column, its cells and the numbers
    of samples; ``definitions`` are (title, definition). ``note`` explains a placeholder in the cells; it is empty
    if there is none.
    """

    title: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[tuple[Column, list[Cell], str]]
    definitions: Sequence[tuple[str, str]]
    note: str = ""


@dataclass(frozen=True)
class ExtendedConfig:
    """Formatted extended measures of one config.

    ``single_bar`` is a sentence on the single-bar interior, empty without scored pixels.
    """

    name: str
    views: int
    inspection: MeasureTable
    families: list[MeasureTable]
    single_bar: str = ""


def extended_context(extended: ExtendedResult, pictures: Mapping[str, CrossingPicture]) -> dict[str, object]:
    """Return the context of the templates of extended measures and crossings; ``pictures`` are by config."""
    tables, source = extended.tables, extended.crossings
    crossings = [
        CrossingConfig(printable(name), measure_table(table, MEASURE_FAMILIES["crossings"]), pictures.get(name))
        for name, table in tables.items()
        if source is not None and name in extended.frames
    ]
    return {
        "extended": [extended_config(name, table) for name, table in tables.items()],
        "extended_protocol": EXTENDED_PROTOCOL,
        "crossings": crossings,
        "crossings_source": f"{printable(source.file)}, SHA-256 {printable(source.sha256)}" if source else "",
        "fits_note": FITS_NOTE,
    }


def extended_config(name: str, table: ExtendedTable) -> ExtendedConfig:
    """Return the formatted extended measures of a config."""
    others = [family for key, family in MEASURE_FAMILIES.items() if key not in _SHOWN_FAMILIES]
    others.sort(key=lambda family: family.key != "as_built")
    folded = [measure_table(table, family) for family in others]
    return ExtendedConfig(
        name=printable(name),
        views=table.views,
        inspection=measure_table(table, MEASURE_FAMILIES["inspection"]),
        families=[family for family in folded if family.rows],
        single_bar=single_bar_sentence(table),
    )


def measure_table(table: ExtendedTable, family: MeasureFamily) -> MeasureTable:
    """Return the table of the measures of a family, those without samples left out."""
    rows = []
    for measure in family.measures:
        estimates = [table.numbers[alignment][measure.name] for alignment in family.alignments]
        if any(estimate.samples for estimate in estimates):
            cells = [estimate_cell(estimate, measure) for estimate in estimates]
            samples = " / ".join(dict.fromkeys(str(estimate.samples) for estimate in estimates))
            rows.append((measure.column, cells, samples))
    units = {column.unit for column, cells, _ in rows if any(cell.text == MISSED for cell in cells)}
    values = " or ".join(f"{MISS_MM:g} mm" if unit else f"{MISS_DEG:g} degrees" for unit in sorted(units)[::-1])
    note = f"{MISSED}: not found, counted as {values}." if units else ""
    heads = {**_HEAD_NOTES, ONCE: family.note}
    return MeasureTable(
        family.title,
        [(alignment, heads[alignment]) for alignment in family.alignments],
        rows,
        [(measure.title, measure.definition) for measure in family.measures],
        note,
    )


def estimate_cell(estimate: MeasureEstimate, measure: Measure) -> Cell:
    """Return the cell of an estimate with its interval, formatted in the measure's unit."""
    value, ends = estimate.value, estimate.interval
    if value is None or not math.isfinite(value):
        return Cell(DASH)
    column = measure.column
    if is_miss(estimate, measure):
        informative = ends is not None and ends[0] < ends[1]
        return Cell(MISSED, value, _interval_text(ends, column) if informative else "")
    return Cell(column.text(value).replace("-", "−"), value, _interval_text(ends, column))


def _interval_text(ends: Interval | None, column: Column) -> str:
    separator = " to " if ends is not None and ends[0] < 0 else " – "
    return column.interval_text(ends, separator).replace("-", "−")


# Crossings: a table, and a view with its crossings.

_KINDS: Mapping[str, str] = {
    "within2": "within 2 mm",
    "within5": "within 5 mm",
    "within10": "within 10 mm",
    "beyond": "more than 10 mm",
    "missed": "not located",
    "bent": "judged for detectors only, since a bar bends there",
    "unjudged": "not judged",
}
"""Kinds of marks: class of the style sheet, and meaning."""


@dataclass(frozen=True)
class CrossingConfig:
    """Crossings of one config."""

    name: str
    main: MeasureTable
    picture: CrossingPicture | None


@dataclass(frozen=True)
class CrossingPicture:
    """View with its crossings: its image as WebP, and marks over it, coloured by the error of the tie point.

    ``marks`` have the kind and the place in the image, pixels; ``counts`` have kind, meaning and number.
    """

    view_id: str
    image: bytes
    width: int
    height: int
    marks: list[tuple[str, float, float]]
    counts: list[tuple[str, str, int]]


def crossing_picture(
    evaluation: Evaluation, config: DatasetConfig, crossings: CrossingSamples
) -> CrossingPicture | None:
    """Return the view of a config with most judged crossings, with all of its crossings; None if it has none.

    ``crossings`` are the samples of its views.
    """
    steel = load_steel_truth(evaluation.folder, config)
    if not any(len(bars.crossings) for bars in steel.bars_by_view.values()):
        return None
    position = int(np.argmax(steel.judged_counts))
    truth, shown = steel.view(position), crossings.of(crossings.view == position)
    scene = truth.bars.crossings
    kinds = dict.fromkeys(range(len(scene)), "unjudged")
    kinds |= dict.fromkeys(truth.judged.crossing.tolist(), "bent")
    judged = zip(shown.crossing_id.tolist(), shown.found.tolist(), shown.tie_error_mm.tolist(), strict=True)
    kinds |= {number - 1: error_kind(error) if found else "missed" for number, found, error in judged}
    marks = list(_marks(truth, scene.crossings.tie_point_m, kinds))
    found = [kind for kind, _, _ in marks]
    [row] = iterate_rows(config, ("left_rgb", "left_depth", "left_mask"), [truth.view_id])
    return CrossingPicture(
        view_id=truth.view_id,
        image=backdrop_image(row["left_rgb"], row["left_depth"], row["left_mask"]),
        width=truth.width,
        height=truth.height,
        marks=marks,
        counts=[(kind, text, found.count(kind)) for kind, text in _KINDS.items() if kind in found],
    )


def error_kind(error_mm: float) -> str:
    """Return the kind of mark of a located crossing."""
    limits = (("within2", 2.0), ("within5", 5.0), ("within10", 10.0))
    return next((kind for kind, limit_mm in limits if error_mm <= limit_mm), "beyond")


def _marks(
    truth: SteelTruth, tie_point_m: ndarray, kinds: Mapping[int, str]
) -> Iterator[tuple[str, float, float]]:
    """Yield the marks of all crossings in the image, those that are not judged first."""
    points_m = transform(truth.cam_from_world, tie_point_m)
    order = sorted(kinds, key=lambda crossing: (-list(_KINDS).index(kinds[crossing]), crossing))
    for crossing in order:
        x, y, z = points_m[crossing]
        if z <= 0 or np.hypot(x, y) >= z * fold_radius(truth.distortion):
            continue
        at_px = project(truth.K, points_m[crossing : crossing + 1], truth.distortion)[0]
        if (at_px >= -0.5).all() and (at_px < np.array([truth.width, truth.height]) - 0.5).all():
            yield kinds[crossing], float(at_px[0]), float(at_px[1])
