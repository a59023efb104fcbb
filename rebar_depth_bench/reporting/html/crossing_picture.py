"""Picture of a view with its crossings: marks over the image, coloured by the error of the tie point."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy import ndarray

from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.extended.crossings import fitted_ties, view_crossings
from rebar_depth_bench.extended.ground_truth import has_bar_ids, steel_truth
from rebar_depth_bench.extended.measures import NATIVE, aligned_predictions
from rebar_depth_bench.extended.steel import SteelTruth
from rebar_depth_bench.geometry.cameras import fold_radius, project, transform
from rebar_depth_bench.reporting.html.assets import data_uri
from rebar_depth_bench.reporting.html.crossings import CrossingPicture, Mark
from rebar_depth_bench.reporting.html.views import backdrop_image
from rebar_depth_bench.scoring.evaluation import Evaluation, View

KINDS: Mapping[str, str] = {
    "within2": "within 2 mm",
    "within5": "within 5 mm",
    "within10": "within 10 mm",
    "beyond": "more than 10 mm",
    "missed": "not located",
    "bent": "judged for detectors only, since a bar bends there",
    "unjudged": "not judged",
}
"""Kinds of marks: class of the style sheet, and meaning."""


@dataclass(frozen=True, eq=False)
class CrossingView:
    """View of a config that is pictured with its crossings: the one with most judged crossings."""

    position: int
    truth: SteelTruth

    def picture(self, view: View) -> CrossingPicture:
        """Return the picture of the view, which has colour, depth and mask of the left camera."""
        truth, scene, crossings = self.truth, self.truth.bars.crossings, view_crossings(self.truth)
        is_located, ties = fitted_ties(aligned_predictions(view.prediction_m, truth, None)[NATIVE], crossings)
        with np.errstate(invalid="ignore", over="ignore"):
            error_mm = 1000 * np.linalg.norm(ties.tie_point_m - crossings.ties.tie_point_m, axis=1)
        kinds = dict.fromkeys(range(len(scene)), "unjudged")
        kinds |= dict.fromkeys(truth.judged.crossing.tolist(), "bent")
        located = zip(crossings.crossing.tolist(), is_located.tolist(), error_mm.tolist(), strict=True)
        kinds |= {crossing: error_kind(error) if found else "missed" for crossing, found, error in located}
        image = backdrop_image(*(view.cell(f"left_{kind}") for kind in ("rgb", "depth", "mask")))
        marks = list(_marks(truth, scene.crossings.tie_point_m, kinds))
        size = (truth.width, truth.height)
        return CrossingPicture(truth.view_id, data_uri(image, "webp"), *size, marks, _counts(marks))


def crossing_view(evaluation: Evaluation, config: DatasetConfig) -> CrossingView | None:
    """Return the view of a config that is pictured, None if it has no crossings."""
    if not has_bar_ids(config):
        return None
    steel = steel_truth(evaluation, config)
    if not any(len(bars.crossings) for bars in steel.bars_by_view.values()) or not len(steel):
        return None
    counts = [len(steel.judged(position).crossing) for position in range(len(steel))]
    truth = steel.view(int(np.argmax(counts)))
    return CrossingView(config.view_ids.index(truth.view_id), truth)


def error_kind(error_mm: float) -> str:
    """Return the kind of mark of a located crossing."""
    limits = (("within2", 2.0), ("within5", 5.0), ("within10", 10.0))
    return next((kind for kind, limit_mm in limits if error_mm <= limit_mm), "beyond")


def _marks(truth: SteelTruth, tie_point_m: ndarray, kinds: Mapping[int, str]) -> Iterator[Mark]:
    """Yield the marks of all crossings in the image, those that are not judged first."""
    points_m = transform(truth.cam_from_world, tie_point_m)
    order = sorted(kinds, key=lambda crossing: (-list(KINDS).index(kinds[crossing]), crossing))
    for crossing in order:
        x, y, z = points_m[crossing]
        if z <= 0 or np.hypot(x, y) >= z * fold_radius(truth.distortion):
            continue
        at_px = project(truth.K, points_m[crossing : crossing + 1], truth.distortion)[0]
        if (at_px >= -0.5).all() and (at_px < np.array([truth.width, truth.height]) - 0.5).all():
            yield Mark(float(at_px[0]), float(at_px[1]), kinds[crossing])


def _counts(marks: Iterable[Mark]) -> list[tuple[str, str, int]]:
    found = [mark.kind for mark in marks]
    return [(kind, text, found.count(kind)) for kind, text in KINDS.items() if kind in found]
