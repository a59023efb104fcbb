"""Inputs and results of the audit's checks: configs and views, and one line of the report per check."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from rich.console import Console
from rich.table import Table

from dataset_builder.scene.model import ESTIMATED_ROLE
from dataset_builder.scene.variants import PROPS_SLOT, variants_of_slot
from rebar_depth_bench.data.bars import Bar, with_axis
from rebar_depth_bench.data.columns import EYES
from rebar_depth_bench.data.eye_view import EyeView, eye_from_row
from rebar_depth_bench.errors import problem_summary
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, inverse_rigid, transform


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

    @property
    def skipped(self) -> tuple[Check, ...]:
        """Checks that were skipped."""
        return tuple(check for check in self.checks if check.skipped)


def print_audit(report: AuditReport, console: Console | None = None) -> None:
    """Print one table row per check, then the problems of each failed check.

    ``console`` defaults to a new console on standard output.
    """
    console = console or Console()
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

    name: str
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
class AuditedEye(EyeView):
    """Eye of a view under audit: it has pixel rays and the points that these determine.

    ``rays_cam`` are the pixel rays in the camera frame with z = 1, so that planar depth scales them to points.
    ``rgb`` is None in a config without colour.
    """

    rays_cam: Float64[ndarray, "h w 3"]

    @cached_property
    def points_m(self) -> Float64[ndarray, "h w 3"]:
        """World point of every pixel, metres; the camera centre for pixels without depth."""
        points_cam = self.rays_cam * self.depth_m[..., None].astype(np.float64)
        return transform(inverse_rigid(self.camera.cam_from_world), points_cam)


@dataclass(frozen=True, eq=False)
class AuditedView:
    """Stereo view under audit: its id and both eyes."""

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
    return AuditedView(row["view_id"], *(_eye_from_row(row, eye, rays) for eye in EYES))


def _eye_from_row(row: Mapping[str, Any], name: str, rays: RayCache) -> AuditedEye:
    eye = eye_from_row(row, name)
    return AuditedEye(**vars(eye), rays_cam=rays.rays_cam(eye.camera))
