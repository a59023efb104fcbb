"""Extended measures of the report: inspection, tolerances, collapsed families, and crossings of bars."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from rebar_depth_bench.base.errors import printable
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.rows import iterate_rows
from rebar_depth_bench.extended.crossings import (
    BINNED_MEASURES,
    MAIN_MEASURES,
    MISS_DEG,
    fitted_ties,
    view_crossings,
)
from rebar_depth_bench.extended.estimates import ExtendedResult, ExtendedTable, MeasureEstimate
from rebar_depth_bench.extended.families import MEASURE_FAMILIES
from rebar_depth_bench.extended.fits import MISS_MM
from rebar_depth_bench.extended.ground_truth import has_bar_ids, load_steel_truth
from rebar_depth_bench.extended.inspection import (
    INSPECTION_MEASURES,
    PROFILES,
    TOLERANCES,
    Tolerance,
    ToleranceProfile,
)
from rebar_depth_bench.extended.measures import (
    EXTENDED_PROTOCOL,
    NATIVE,
    ONCE,
    SCALED,
    Measure,
    MeasureFamily,
)
from rebar_depth_bench.extended.point_cloud import TOLERANCES_MM
from rebar_depth_bench.extended.reach import ReachBin
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import fold_radius, project, transform
from rebar_depth_bench.reporting.extended_tables import (
    FITS_NOTE,
    MISSED,
    REACH_NOTE,
    UNDEFINED,
    is_miss,
    reach_sentence,
    single_bar_sentence,
)
from rebar_depth_bench.reporting.html.views import backdrop_image
from rebar_depth_bench.scoring.bootstrap import Interval
from rebar_depth_bench.scoring.columns import DASH, Cell, Column
from rebar_depth_bench.scoring.evaluation import Evaluation

_TITLE_NUMBER = re.compile(r"\d[\d.]*(?:-[\d.]+)?(?= (?:mm|%|m|px|degrees)(?!\w))")
"""Tolerance, threshold or bin in a measure's title: a number followed by a unit."""
_HEAD_NOTES: Mapping[str, str] = {NATIVE: "no alignment", SCALED: "oracle median scale per view"}
_SHOWN_FAMILIES = ("inspection", "crossings")
"""Families that have tables of their own; the others are collapsed, inspection first."""

MAIN_INSPECTION_MEASURES = (
    "bars_found",
    "axis_offset_median_mm",
    "axis_offset_p95_mm",
    *(f"{kind}_{size}_mm" for kind in ("spacing", "layer", "diameter", "cover") for size in ("bias", "p95")),
)
"""Inspection measures that are shown openly; the others are collapsed."""

_CLOUD_KINDS = ("accuracy", "completeness", "f")
_SHARE = Column("share", "judged crossings within a limit", "%", "higher", 1, 100.0)


@dataclass(frozen=True)
class MeasureTable:
    """Table of the measures of one family: a row per measure with a cell per alignment.

    ``heads`` are (alignment, note) of the columns; ``rows`` have the measure's column, its cells and the numbers
    of samples; ``definitions`` are (title, definition). ``note`` explains a placeholder in the cells; it is empty
    if there is none. A table of point clouds has ``grid`` instead of rows: per tolerance in mm, three cells for
    each alignment.
    """

    title: str
    heads: Sequence[tuple[str, str]]
    rows: Sequence[tuple[Column, list[Cell], str]]
    definitions: Sequence[tuple[str, str]]
    note: str = ""
    grid: Sequence[tuple[int, list[Cell]]] = ()


@dataclass(frozen=True)
class ExtendedConfig:
    """Formatted extended measures of one config.

    The cells of ``tolerances`` are pass rates and capabilities. ``single_bar`` is a sentence on the single-bar
    interior, empty without scored pixels.
    """

    name: str
    views: int
    main_inspection: MeasureTable
    other_inspection: MeasureTable
    tolerances: list[tuple[ToleranceProfile, Tolerance, list[Cell]]]
    families: list[MeasureTable]
    single_bar: str = ""

    def has_undefined_capability(self) -> bool:
        """Return whether any capability is undefined, because too many bars were not found."""
        return any(cell.text == UNDEFINED for _, _, cells in self.tolerances for cell in cells)


def extended_context(extended: ExtendedResult, pictures: Mapping[str, CrossingPicture]) -> dict[str, object]:
    """Return the context of the templates of extended measures and crossings; ``pictures`` are by config."""
    tables, source = extended.tables, extended.crossings
    crossings = [
        _crossing_config(name, table, pictures.get(name))
        for name, table in tables.items()
        if source is not None and table.numbers[NATIVE]["crossings_judged"].samples
    ]
    return {
        "extended": [extended_config(name, table) for name, table in tables.items()],
        "extended_protocol": EXTENDED_PROTOCOL,
        "profiles": PROFILES,
        "crossings": crossings,
        "crossings_source": f"{printable(source.file)}, SHA-256 {printable(source.sha256)}" if source else "",
        "fits_note": FITS_NOTE,
        "reach_note": REACH_NOTE,
    }


def extended_config(name: str, table: ExtendedTable) -> ExtendedConfig:
    """Return the formatted extended measures of a config."""
    inspection = MEASURE_FAMILIES["inspection"]
    shown = {*MAIN_INSPECTION_MEASURES, *(tolerance.pass_name for _, tolerance in TOLERANCES)}
    other = [measure for measure in INSPECTION_MEASURES if measure.name not in shown]
    others = [family for key, family in MEASURE_FAMILIES.items() if key not in _SHOWN_FAMILIES]
    others.sort(key=lambda family: family.key != "as_built")
    folded = [_folded_table(table, family) for family in others]
    return ExtendedConfig(
        name=printable(name),
        views=table.views,
        main_inspection=measure_table(
            table, inspection.title, inspection, [inspection.by_name[name] for name in MAIN_INSPECTION_MEASURES]
        ),
        other_inspection=measure_table(table, "Inspection: spread, median, found bars only", inspection, other),
        tolerances=[(profile, one, _tolerance_cells(table, one)) for profile, one in TOLERANCES],
        families=[family for family in folded if family.rows or family.grid],
        single_bar=single_bar_sentence(table),
    )


def _folded_table(table: ExtendedTable, family: MeasureFamily) -> MeasureTable:
    if family.key != "clouds":
        return measure_table(table, family.title, family, family.measures)
    grid = []
    for tolerance_mm in TOLERANCES_MM:
        measures = [family.by_name[f"cloud_{kind}_{tolerance_mm}mm"] for kind in _CLOUD_KINDS]
        pairs = [(table.numbers[alignment][one.name], one) for alignment in family.alignments for one in measures]
        if any(estimate.samples for estimate, _ in pairs):
            grid.append((tolerance_mm, [estimate_cell(*pair) for pair in pairs]))
    return MeasureTable(family.title, _heads(family), [], measure_definitions(family.measures), grid=grid)


def measure_table(
    table: ExtendedTable, title: str, family: MeasureFamily, measures: Sequence[Measure]
) -> MeasureTable:
    """Return the table of some measures of a family, those without samples left out."""
    rows = []
    for measure in measures:
        estimates = [table.numbers[alignment][measure.name] for alignment in family.alignments]
        if any(estimate.samples for estimate in estimates):
            cells = [estimate_cell(estimate, measure) for estimate in estimates]
            samples = " / ".join(dict.fromkeys(str(estimate.samples) for estimate in estimates))
            rows.append((measure.column, cells, samples))
    units = {column.unit for column, cells, _ in rows if any(cell.text == MISSED for cell in cells)}
    values = " or ".join(f"{MISS_MM:g} mm" if unit else f"{MISS_DEG:g} degrees" for unit in sorted(units)[::-1])
    note = f"{MISSED}: not found, counted as {values}." if units else ""
    return MeasureTable(title, _heads(family), rows, measure_definitions(measures), note)


def _heads(family: MeasureFamily) -> list[tuple[str, str]]:
    notes = {**_HEAD_NOTES, ONCE: family.note}
    return [(alignment, notes[alignment]) for alignment in family.alignments]


def estimate_cell(estimate: MeasureEstimate, measure: Measure) -> Cell:
    """Return the cell of an estimate with its interval, formatted in the measure's unit."""
    value, ends = estimate.value, estimate.interval
    if value is None:
        return Cell(UNDEFINED if estimate.samples else DASH)
    if not math.isfinite(value):
        return Cell("∞" if measure.convert is not None else DASH)
    column = measure.column
    if is_miss(estimate, measure):
        informative = ends is not None and ends[0] < ends[1]
        return Cell(MISSED, value, _interval_text(ends, column) if informative else "")
    return Cell(column.text(value).replace("-", "−"), value, _interval_text(ends, column))


def _interval_text(ends: Interval | None, column: Column) -> str:
    separator = " to " if ends is not None and ends[0] < 0 else " – "
    return column.interval_text(ends, separator).replace("-", "−")


def measure_definitions(measures: Iterable[Measure]) -> list[tuple[str, str]]:
    """Return the titles and definitions of the measures.

    Measures whose titles differ only in a tolerance or bin share one definition, in which N stands for that
    number.
    """
    by_title: dict[str, list[Measure]] = {}
    for measure in measures:
        by_title.setdefault(_TITLE_NUMBER.sub("N", measure.title, count=1), []).append(measure)
    return [_definition(title, group) for title, group in by_title.items()]


def _definition(title: str, measures: Sequence[Measure]) -> tuple[str, str]:
    first = measures[0]
    if len(measures) == 1:
        return first.title, first.definition
    steps = [step[0] for measure in measures if (step := _TITLE_NUMBER.search(measure.title))]
    definition = _TITLE_NUMBER.sub(lambda step: "N" if step[0] == steps[0] else step[0], first.definition)
    return title, f"{definition}; N: {', '.join(steps)}"


def _tolerance_cells(table: ExtendedTable, tolerance: Tolerance) -> list[Cell]:
    """Return pass rates, then capabilities, each native and scaled."""
    measures = MEASURE_FAMILIES["inspection"].by_name
    return [
        estimate_cell(table.numbers[alignment][name], measures[name])
        for name in (tolerance.pass_name, tolerance.capability_name)
        for alignment in (NATIVE, SCALED)
    ]


# Crossings: the reach of a method, tables by distance, and a view with its crossings.

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
    """Crossings of one config: ``heads`` are (alignment, limit) of the shares in ``rows``, nearest bin first."""

    name: str
    sentences: list[str]
    heads: list[tuple[str, int]]
    rows: list[tuple[ReachBin, list[Cell]]]
    main: MeasureTable
    binned: MeasureTable
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


def _crossing_config(name: str, table: ExtendedTable, picture: CrossingPicture | None) -> CrossingConfig:
    family = MEASURE_FAMILIES["crossings"]
    by_property = [measure for measure in BINNED_MEASURES if not measure.name.rpartition("_")[2].endswith("m")]
    by_property += [measure for measure in BINNED_MEASURES if measure.name.endswith("mm")]
    reaches = [(alignment, reach) for alignment in (NATIVE, SCALED) for reach in table.reaches.get(alignment, ())]
    bins = zip(*(reach.bins for _, reach in reaches), strict=True)
    return CrossingConfig(
        name=printable(name),
        sentences=[reach_sentence(alignment, reach) for alignment, reach in reaches],
        heads=[(alignment, reach.limit_mm) for alignment, reach in reaches],
        rows=[
            (of_limits[0], [_SHARE.value_cell(one.share, one.interval) for one in of_limits]) for of_limits in bins
        ],
        main=measure_table(table, family.title, family, MAIN_MEASURES),
        binned=measure_table(table, "Crossings by angle, gap and bar width", family, by_property),
        picture=picture,
    )


def crossing_picture(evaluation: Evaluation, config: DatasetConfig) -> CrossingPicture | None:
    """Return the view of a config with most judged crossings, with all of its crossings; None if it has none."""
    if not has_bar_ids(config):
        return None
    steel = load_steel_truth(evaluation.folder, config)
    if not any(len(bars.crossings) for bars in steel.bars_by_view.values()) or not len(steel):
        return None
    truth = steel.view(int(np.argmax(steel.judged_counts)))
    scene, crossings = truth.bars.crossings, view_crossings(truth)
    prediction_m = evaluation.submission.read(truth.view_id)
    is_located, ties = fitted_ties(truth.predicted_m(prediction_m), crossings)
    with np.errstate(invalid="ignore", over="ignore"):
        error_mm = 1000 * np.linalg.norm(ties.tie_point_m - crossings.ties.tie_point_m, axis=1)
    kinds = dict.fromkeys(range(len(scene)), "unjudged")
    kinds |= dict.fromkeys(truth.judged.crossing.tolist(), "bent")
    located = zip(crossings.crossing.tolist(), is_located.tolist(), error_mm.tolist(), strict=True)
    kinds |= {crossing: error_kind(error) if found else "missed" for crossing, found, error in located}
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
