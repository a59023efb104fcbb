"""Ground truth of one view as the extended measures see it: steel pixels, a band around them, camera and bars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8, UInt16, UInt32
from numpy import ndarray

from rebar_depth_bench.bar_crossings.axis_segments import Rows
from rebar_depth_bench.bar_crossings.definition import Crossings, scene_crossings
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.schema import FormPlane
from rebar_depth_bench.extended.axes import CageTruth, SceneCrossings, cage_truth, prepared_crossings
from rebar_depth_bench.scoring.metrics import is_valid_prediction


@dataclass(frozen=True, eq=False)
class SceneBars:
    """Bars of a scene: their segments, nominal diameter by bar id (NaN for ids without a bar), and crossings.

    ``designed`` has the bars with a nominal axis, by id, and ``planes`` are those of formwork.
    """

    cage: CageTruth
    diameter_m: Float64[ndarray, " ids"]
    designed: Mapping[int, Bar]
    crossings: SceneCrossings
    planes: Sequence[FormPlane] = ()

    @classmethod
    def of(
        cls, bars: Sequence[Bar], crossings: Crossings | None = None, planes: Sequence[FormPlane] = ()
    ) -> SceneBars:
        """Return the bars of a scene with its crossings (default: none). Raises ``DatasetError`` for too many."""
        # NaN for bars without a fitted axis, and for ids that images show and the table lacks.
        diameter_m = np.full(np.iinfo(np.uint16).max + 1, np.nan)
        measured = with_axis(bars)
        diameter_m[[bar.bar_id for bar in measured]] = [bar.diameter_m for bar in measured]
        designed = {bar.bar_id: bar for bar in measured if bar.nominal_axis_m}
        cage, crossings = cage_truth(bars), scene_crossings(()) if crossings is None else crossings
        return cls(cage, diameter_m, designed, prepared_crossings(crossings, bars, cage), planes)


@dataclass(frozen=True, eq=False)
class JudgedCrossings:
    """Judged crossings of a view: see ``judged.judged_crossings``.

    ``crossing`` holds indices into the scene's crossings, ascending. ``pixels`` are positions in the arrays of
    ``SteelTruth``: k sampled pixels of bar a, and of bar b.
    """

    crossing: Int64[ndarray, " m"]
    pixels: Int64[ndarray, "m 2 k"]


PLANE_PIXELS = 200
"""Number of plane pixels of a bar whose cover is judged."""


@dataclass(frozen=True, eq=False)
class CoverPixels(Rows):
    """The r bars of a view whose cover is judged, and k plane pixels of each.

    ``segment`` holds indices of segments of ``CageTruth``, ascending, and ``plane`` the plane n x = d as n / d,
    camera frame. ``pixels`` are flat indices into the image, ``rays`` their x/z and y/z, ``depth_m`` the true
    depth.
    """

    segment: Int64[ndarray, " r"]
    plane: Float64[ndarray, "r 3"]
    pixels: Int64[ndarray, "r k"]
    rays: Float64[ndarray, "r k 2"]
    depth_m: Float32[ndarray, "r k"]


@dataclass(frozen=True, eq=False)
class SteelTruth:
    """Ground truth of one view at the pixels on steel or within one pixel (3 x 3) of it that have true depth > 0.

    ``index`` holds flat indices into the height x width grid, ascending; the other arrays are parallel to it.
    ``depth_m`` is planar depth, metres. ``bar_id`` is 0 beside the steel; ``interior`` marks the scored pixels of
    the protocol, and ``single_bar`` the scored pixels whose 3 x 3 neighbourhood belongs to one bar. ``rays`` are
    x/z and y/z of each pixel's ray in the camera frame (lens distortion undone), so that ``x_cam = depth_m *
    (rays[:, 0], rays[:, 1], 1)``. ``run`` is the straight bar segment whose axis is nearest to the true point (an
    index of ``CageTruth``), -1 where the point is on no segment. ``bars`` are the bars of the scene.
    ``distortion`` is the distortion of the grid (``cameras.distort``), zeros on an ideal one. ``covers`` are the
    bars whose cover is judged. ``centre_depth_m`` is the true depth of the pixel at half of the height and width,
    0 for none.

    ``parallax_px_m`` is focal length times baseline of a rectified pair, pixels times metres, 0 if there is none;
    ``seen_by_right`` marks the scored pixels that the right view sees, too (``disparity.match_right``). Two masks
    cover the whole image, row by row, packed into bits: ``has_depth``, and ``near_step`` with the depth
    ``step_depth_m`` of its pixels (``published.depth_steps``).
    """

    view_id: str
    height: int
    width: int
    K: Float64[ndarray, "3 3"]
    cam_from_world: Float64[ndarray, "4 4"]
    index: UInt32[ndarray, " n"]
    depth_m: Float32[ndarray, " n"]
    bar_id: UInt16[ndarray, " n"]
    interior: Bool[ndarray, " n"]
    single_bar: Bool[ndarray, " n"]
    rays: Float64[ndarray, "n 2"]
    run: ndarray  # Int16 n
    judged: JudgedCrossings
    covers: CoverPixels
    bars: SceneBars = field(default_factory=lambda: SceneBars.of(()))
    distortion: Float64[ndarray, " 5"] = field(default_factory=lambda: np.zeros(5))
    centre_depth_m: float = 0.0
    parallax_px_m: float = 0.0
    seen_by_right: Bool[ndarray, " n"] = field(default_factory=lambda: np.empty(0, np.bool_))
    has_depth: UInt8[ndarray, " b"] = field(default_factory=lambda: np.empty(0, np.uint8))
    near_step: UInt8[ndarray, " b"] = field(default_factory=lambda: np.empty(0, np.uint8))
    step_depth_m: Float32[ndarray, " m"] = field(default_factory=lambda: np.empty(0, np.float32))

    def predicted_m(self, prediction_m: Float[ndarray, "h w"]) -> Float64[ndarray, " n"]:
        """Return a predicted image on ``index``, planar depth in metres, NaN where there is no prediction."""
        p_m = prediction_m.ravel().take(self.index.astype(np.intp))
        return np.where(is_valid_prediction(p_m), p_m.astype(np.float64), np.nan)
