"""Crossings in the report: the reach of a method, tables by distance, and a view with its crossings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rebar_depth_bench.errors import printable
from rebar_depth_bench.extended.crossings.measures import BINNED_MEASURES, MAIN_MEASURES
from rebar_depth_bench.extended.evaluate import MEASURE_FAMILIES
from rebar_depth_bench.extended.predictions import NATIVE, SCALED
from rebar_depth_bench.extended.result import ExtendedResult, ExtendedTable
from rebar_depth_bench.reporting.crossing_texts import FITS_NOTE, REACH_NOTE, reach_sentence
from rebar_depth_bench.reporting.html.extended import ExtendedMeasureTable, measure_table
from rebar_depth_bench.scoring.columns import Cell, Column

_SHARE = Column("share", "judged crossings within a limit", "%", "higher", 1, 100.0)


@dataclass(frozen=True)
class DistanceRow:
    """Judged crossings of one bin of distance: range, numbers, and a share per alignment and limit."""

    distance: str
    tested: bool
    crossings: Cell
    views: Cell
    shares: list[Cell]


@dataclass(frozen=True)
class Mark:
    """Mark of one crossing: place in the image, pixels, and kind (a class of the style sheet)."""

    x_px: float
    y_px: float
    kind: str


@dataclass(frozen=True)
class CrossingPicture:
    """View with its crossings: its image as a data URI, marks over it, and their kinds, meanings and numbers."""

    view_id: str
    image: str
    width: int
    height: int
    marks: list[Mark]
    counts: list[tuple[str, str, int]]

    @property
    def unit_px(self) -> float:
        """Size that marks are multiples of, so that they look alike for all image sizes."""
        return self.width / 960


@dataclass(frozen=True)
class CrossingConfig:
    """Formatted crossings of one config; ``heads`` are (alignment, limit) of the shares by distance."""

    name: str
    sentences: list[str]
    heads: list[tuple[str, int]]
    rows: list[DistanceRow]
    main: ExtendedMeasureTable
    binned: ExtendedMeasureTable
    picture: CrossingPicture | None


@dataclass(frozen=True)
class CrossingSection:
    """Context of ``part_crossings.html.j2``."""

    source: str
    fits_note: str
    reach_note: str
    configs: list[CrossingConfig]


def crossing_section(extended: ExtendedResult, pictures: Mapping[str, CrossingPicture]) -> CrossingSection | None:
    """Return the context of the section; None if no config has crossings. ``pictures`` are by config."""
    configs = [
        _config(name, table, pictures.get(name))
        for name, table in extended.tables.items()
        if table.numbers[NATIVE]["crossings_judged"].samples
    ]
    if not configs or extended.crossings is None:
        return None
    source = f"{printable(extended.crossings.file)}, SHA-256 {printable(extended.crossings.sha256)}"
    return CrossingSection(source, FITS_NOTE, REACH_NOTE, configs)


def _config(name: str, table: ExtendedTable, picture: CrossingPicture | None) -> CrossingConfig:
    family = MEASURE_FAMILIES["crossings"]
    by_property = [measure for measure in BINNED_MEASURES if not measure.name.rpartition("_")[2].endswith("m")]
    by_property += [measure for measure in BINNED_MEASURES if measure.name.endswith("mm")]
    reaches = [(alignment, reach) for alignment in (NATIVE, SCALED) for reach in table.reaches.get(alignment, ())]
    return CrossingConfig(
        name=printable(name),
        sentences=[reach_sentence(alignment, reach) for alignment, reach in reaches],
        heads=[(alignment, reach.limit_mm) for alignment, reach in reaches],
        rows=list(_distance_rows(table)),
        main=measure_table(table, family.title, family, MAIN_MEASURES),
        binned=measure_table(table, "Crossings by angle, gap and bar width", family, by_property),
        picture=picture,
    )


def _distance_rows(table: ExtendedTable) -> Iterable[DistanceRow]:
    """Yield one row for each bin with judged crossings, nearest first."""
    reaches = [reach for alignment in (NATIVE, SCALED) for reach in table.reaches.get(alignment, ())]
    for bins in zip(*(reach.bins for reach in reaches), strict=True):
        first = bins[0]
        yield DistanceRow(
            distance=f"{first.low_m:g} to {first.high_m:g}",
            tested=first.tested,
            crossings=Cell(str(first.crossings), first.crossings),
            views=Cell(str(first.views), first.views),
            shares=[
                Cell(_SHARE.number_text(one.share), one.share, _SHARE.interval_text(one.interval)) for one in bins
            ],
        )
