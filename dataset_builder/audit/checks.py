"""The checks that every view of a config goes through, in the order of the report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from dataset_builder.audit.epipolar import epipolar_verdict, view_epipolar_counts
from dataset_builder.audit.geometry import (
    axis_verdict,
    board_verdict,
    largest_axis_excess,
    largest_board_error,
)
from dataset_builder.audit.marker_checks import marker_verdict, view_markers
from dataset_builder.audit.photometric import photometric_verdict, view_fit
from dataset_builder.audit.projection import projection_verdict, view_projection_error_px
from dataset_builder.audit.report import Check
from dataset_builder.audit.views import AuditedConfig, AuditedView


@dataclass(frozen=True)
class ViewCheck:
    """``measure`` takes a view's figures, ``verdict`` holds all of them against a bound.

    ``views`` of a config, spread evenly, are measured; all of them where it is None.
    """

    measure: Callable[[AuditedConfig, AuditedView], Any]
    verdict: Callable[[AuditedConfig, Sequence[Any]], Check]
    views: int | None = None


VIEW_CHECKS: tuple[ViewCheck, ...] = (
    ViewCheck(largest_axis_excess, axis_verdict),
    ViewCheck(largest_board_error, board_verdict),
    ViewCheck(view_epipolar_counts, epipolar_verdict),
    # All views of a config have the same lenses, which another check holds to the last digit.
    ViewCheck(view_projection_error_px, projection_verdict, views=12),
    ViewCheck(view_fit, photometric_verdict),
    ViewCheck(view_markers, marker_verdict),
)
