"""Published numbers of the paper, shown beside results and never ranked with them.

Source: "Benchmarking Metric Depth for Construction Perception: Industrial Rebar Scenes with Exact Synthetic Ground
Truth", Table I. The authors measured on their own renders; ``PublishedPart.mark`` states this and accompanies the
numbers wherever they are shown. Numbers are kept as strings, so that they are printed as published.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

from pydantic import TypeAdapter

from rebar_depth_bench.scoring.columns import PAPER_COLUMNS, Cell
from rebar_depth_bench.scoring.formatting import config_title
from rebar_depth_bench.scoring.result import Result


@dataclass(frozen=True)
class PublishedRow:
    """Row of a method in Table I: RMSE (cm) and AbsRel native, AbsRel_s oracle-scaled, median s.

    ``median_anchored`` means that the scale was taken from ground truth (the dagger of Table I).
    """

    method: str
    rmse_cm: str
    abs_rel: str
    abs_rel_scaled: str
    scale: str
    median_anchored: bool = False

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """RMSE, AbsRel, AbsRel_s and s, in the order of the paper's tables."""
        return self.rmse_cm, self.abs_rel, self.abs_rel_scaled, self.scale


@dataclass(frozen=True)
class PublishedScene:
    """One scene of Table I: its title, working distance and rows, in the table's order."""

    title: str
    distance: str
    rows: tuple[PublishedRow, ...]


@dataclass(frozen=True)
class PublishedPart:
    """Source of one part of the numbers: place in the paper, protocol, and the mark shown with the numbers."""

    place: str
    protocol: str
    mark: str


@dataclass(frozen=True)
class PublishedNumbers:
    """Published numbers that are shown beside results: the scenes of Table I, whose part is ``synthetic``."""

    title: str
    parts: Mapping[str, PublishedPart]
    scenes: Mapping[str, PublishedScene]


OTHER_OPTICS_MARK = "§"
OTHER_OPTICS_NOTE = (
    f"{OTHER_OPTICS_MARK}: the paper measured this scene with the same cameras' positions but other optics."
)


@lru_cache(maxsize=1)
def load_published() -> PublishedNumbers:
    """Return the published numbers from the package's ``published.json``, which is read once."""
    content = json.loads(files("rebar_depth_bench.reporting").joinpath("published.json").read_text("utf-8"))
    values = {"title": content.pop("title"), "parts": content, "scenes": content["synthetic"]["scenes"]}
    return TypeAdapter(PublishedNumbers).validate_python(values)


def published_rows(scene: str) -> tuple[PublishedRow, ...]:
    """Return the rows of Table I of ``lattice``, ``pile`` or ``pier`` in order; empty for other scenes."""
    scenes = load_published().scenes
    return scenes[scene].rows if scene in scenes else ()


# Paper section of the report: a result beside the published rows of the same scene, not ranked with them.


@dataclass(frozen=True)
class PaperRow:
    """Row of a scene's table, with cells of ``PAPER_COLUMNS``."""

    name: str
    published: bool
    dagger: bool
    cells: list[Cell]


@dataclass(frozen=True)
class PaperScene:
    """Scene of Table I: rows of the submission's configs, then the published rows, measured at ``distance``."""

    heading: str
    distance: str
    rows: list[PaperRow]
    other_optics: bool


def paper_scenes(result: Result) -> list[PaperScene]:
    """Return the scenes of Table I for which the result has configs, in the paper's order."""
    scenes = []
    for name, scene in load_published().scenes.items():
        own = [
            (config, table, table.published)
            for config, table in result.tables.items()
            if table.published is not None and table.published.scene == name
        ]
        if own:
            rows = [
                PaperRow(
                    name=config_title(config, table.split)
                    + ("" if match.same_optics else f" {OTHER_OPTICS_MARK}"),
                    published=False,
                    dagger=False,
                    cells=[column.cell(table) for column in PAPER_COLUMNS],
                )
                for config, table, match in own
            ]
            rows += [
                PaperRow(row.method, True, row.median_anchored, [Cell(text, float(text)) for text in row.cells])
                for row in scene.rows
            ]
            heading = scene.title if scene.title.lower() == name else f"{scene.title} ({name})"
            other_optics = any(not match.same_optics for _, _, match in own)
            scenes.append(PaperScene(heading, scene.distance, rows, other_optics))
    return scenes
