"""Inputs and results of the audit's checks: configs and views, and one line of the report per check."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, UInt16
from numpy import ndarray
from rich.console import Console
from rich.table import Table

from dataset_builder.scene.model import ESTIMATED_ROLE
from dataset_builder.scene.variants.registry import PROPS_SLOT, variants_of_slot
from rebar_depth_bench.base.errors import problem_summary
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.rows import EyeTruth, truth_from_row
from rebar_depth_bench.data.schema import COLUMNS, EYES, ViewRecord
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, transform
from rebar_depth_bench.scoring.protocol import scored_pixels

AUDITED_COLUMNS = tuple(column for column in COLUMNS if column != "left_preview")
"""Columns whose cells are checked."""


@dataclass(frozen=True)
class Check:
    """Result of one check: its name, the measured value and its bound as text, and the problems found.

    A check is ``skipped`` if the config has nothing to measure; ``measured`` is then the reason.
    """

    name: str
    measured: str
    bound: str
    problems: tuple[str, ...] = ()
    skipped: bool = False

    @classmethod
    def skip(cls, name: str, reason: str) -> Check:
        """Return the result of a check that is skipped for a reason."""
        return cls(name, reason, "", skipped=True)

    @property
    def passed(self) -> bool:
        """Whether the check was made and has no problems."""
        return not self.problems and not self.skipped

    @property
    def verdict(self) -> str:
        """Verdict in one word: ``ok``, ``skipped`` or ``FAILED``."""
        return "skipped" if self.skipped else "ok" if self.passed else "FAILED"


@dataclass(frozen=True)
class AuditReport:
    """Results of all checks of one dataset folder."""

    root: str
    checks: tuple[Check, ...]

    @property
    def failures(self) -> tuple[Check, ...]:
        """Checks that did not pass; those that are skipped are no failures."""
        return tuple(check for check in self.checks if check.problems)


def print_audit(report: AuditReport) -> None:
    """Print one table row per check, then the problems of each failed check."""
    console = Console()
    table = Table(title=f"Audit of {report.root}")
    for heading in ("check", "found", "bound", ""):
        table.add_column(heading, overflow="fold")
    for check in report.checks:
        table.add_row(check.name, check.measured, check.bound, check.verdict)
    console.print(table)
    for check in report.failures:
        console.print(f"{check.name}: {problem_summary(check.problems)}", markup=False, highlight=False)


@dataclass(frozen=True, eq=False)
class AuditedConfig:
    """Config under audit: its appearance variants, the bars of its scene, and its board (None without one)."""

    variants: tuple[str, ...]
    steel: tuple[Bar, ...]
    board: BoardSpec | None

    @property
    def bars_with_known_axis(self) -> tuple[Bar, ...]:
        """Bars whose axes are known exactly; an axis fitted to the surface is no independent reference."""
        return tuple(bar for bar in with_axis(self.steel) if bar.role != ESTIMATED_ROLE)

    @property
    def has_props(self) -> bool:
        """Whether the scene has props, which may stand on the board or hide it."""
        return bool(variants_of_slot(self.variants, PROPS_SLOT))


@dataclass(frozen=True, eq=False)
class EyeWithRays(EyeTruth):
    """Eye of a rendered or imported view, with pixel rays and the points that these determine.

    ``rays_cam`` are the pixel rays in the camera frame with z = 1, so that planar depth scales them to points.
    """

    rays_cam: Float64[ndarray, "h w 3"]

    @cached_property
    def points_m(self) -> Float64[ndarray, "h w 3"]:
        """World point of every pixel, metres; the camera centre for pixels without depth."""
        points_cam = self.rays_cam * self.depth_m[..., None].astype(np.float64)
        return transform(inverse_rigid(self.camera.cam_from_world), points_cam)


@dataclass(frozen=True, eq=False)
class AuditedEye(EyeWithRays):
    """Eye of a rendered view under audit; ``rgb`` is None in a config without colour."""

    mask: Bool[ndarray, "h w"]
    bars: UInt16[ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class AuditedView:
    """Rendered stereo view under audit: its id and both eyes."""

    view_id: str
    left: AuditedEye
    right: AuditedEye

    @property
    def eyes(self) -> dict[str, AuditedEye]:
        """Both eyes by name (``left``, ``right``)."""
        return {"left": self.left, "right": self.right}


class RayCache:
    """Cache of pixel rays by grid.

    The views of a config share their grids, and the rays of a distorted grid take seconds to compute.
    """

    def __init__(self) -> None:
        self._rays: dict[tuple[bytes, bytes, int, int], Float64[ndarray, "h w 3"]] = {}

    def rays_cam(self, camera: Camera) -> Float64[ndarray, "h w 3"]:
        """Return ``pixel_rays`` of the camera's grid, a shared array that must not be modified."""
        key = (camera.K.tobytes(), camera.distortion.tobytes(), camera.width, camera.height)
        if key not in self._rays:
            # A config has one grid per eye; damaged rows with other cameras must not fill the memory.
            if len(self._rays) >= len(EYES):
                self._rays.clear()
            self._rays[key] = camera.rays()
        return self._rays[key]


def view_from_row(row: Mapping[str, Any], rays: RayCache) -> AuditedView:
    """Return the stereo view of a decoded row, whose arrays must have the shapes of the schema."""
    return AuditedView(row["view_id"], *(AuditedEye(**vars(eye_with_rays(row, eye, rays))) for eye in EYES))


def eye_with_rays(row: Mapping[str, Any], eye: str, rays: RayCache) -> EyeWithRays:
    """Return one eye of a decoded row, which has its depth."""
    truth = truth_from_row(row, eye)
    return EyeWithRays(**vars(truth), rays_cam=rays.rays_cam(truth.camera))


def record_problems(view_id: str, truths: Mapping[str, EyeTruth], record: ViewRecord) -> Iterator[str]:
    """Yield the differences of a row, its view id and its eyes by name, from the record in the manifest."""
    if view_id != record.view_id:
        yield f"the row's view_id is {view_id}, expected {record.view_id}"
    for eye, truth in truths.items():
        if truth.digest() != getattr(record, eye):
            yield f"{eye} ground-truth digest differs from the manifest's"
    left = truths["left"]
    steel_px = None if left.mask is None else int(np.count_nonzero(left.mask))
    if (steel_px, len(scored_pixels(left.mask, left.depth_m))) != (record.steel_px, record.scored_px):
        yield "steel and scored pixel counts differ from the manifest's"
