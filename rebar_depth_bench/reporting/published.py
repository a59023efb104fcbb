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
