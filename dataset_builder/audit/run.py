"""``audit``: every check of a dataset folder, in one pass over its rows.

The checks that every view of a config goes through, in the order of the report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dataset_builder.audit.cameras import (
    ExpectedView,
    aim_point_of,
    board_spec,
    camera_problems,
    expected_views,
    projection_verdict,
    protocol_problems,
    view_projection_error_px,
)
from dataset_builder.audit.cycles_depth import cycles_difference_m, cycles_verdict
from dataset_builder.audit.files import array_problems, check_digests, check_files, row_problems
from dataset_builder.audit.geometry import axis_verdict, board_verdict, largest_axis_excess, largest_board_error
from dataset_builder.audit.markers import marker_verdict, view_markers
from dataset_builder.audit.photometric import photometric_verdict, view_fit
from dataset_builder.audit.report import AuditReport, Check
from dataset_builder.audit.stereo_consistency import epipolar_verdict, view_epipolar_counts
from dataset_builder.audit.views import AuditedConfig, AuditedEye, AuditedView, RayMemory, audited_view
from dataset_builder.build.bars_table import BARS, read_bars
from dataset_builder.config.trajectories import subset
from rebar_depth_bench.data.dataset import features, iterate
from rebar_depth_bench.data.manifest import DatasetFolder, ViewRecord, open_folder
from rebar_depth_bench.errors import DatasetError, InputError
from rebar_depth_bench.progress import Progress, silent


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


_NOT_AUDITED = {"left_preview"}


def audit(root: str | Path, *, depth_views: int = 4, progress: Progress = silent) -> AuditReport:
    """Check every invariant of a local dataset folder and its ground truth against other sources.

    ``depth_views`` views per config, spread evenly, are rendered again by Cycles' depth pass.
    Raises ``DatasetError`` where the folder cannot be read at all, ``InputError`` for a negative ``depth_views``.
    """
    if depth_views < 0:
        raise InputError(f"--depth-views is {depth_views}, expected 0 or more")
    folder = open_folder(root)
    if folder.local is None:
        raise DatasetError(f"{root}: is not a folder on this machine, expected one to audit")
    files = check_files(folder, folder.local)
    checks = [files, check_digests(folder)]
    if files.passed:  # rows of a damaged folder cannot be judged
        for config in folder.configs:
            checks += _config_checks(folder, folder.local, config, depth_views, progress)
    return AuditReport(str(root), tuple(checks))


def _config_checks(
    folder: DatasetFolder, root: Path, name: str, depth_views: int, progress: Progress
) -> Iterator[Check]:
    entry = folder.config(name)
    steel = read_bars(root / BARS)[entry["scene"]["name"]]
    config = AuditedConfig(name, entry, steel, board_spec(name, entry))
    aim_m, aim_problems = aim_point_of(entry, root / entry["mesh"])
    expected = expected_views(name, entry, aim_m)
    audited = _Pass(config, folder.views(name), expected, depth_views)
    for row in iterate(root, name, [column for column in features() if column not in _NOT_AUDITED]):
        audited.add(row)
        progress(f"audit of {name}", audited.rows, len(entry["views"]))
    yield audited.rows_check()
    yield _cameras_check(name, expected, [*aim_problems, *protocol_problems(entry, expected), *audited.cameras])
    for check, figures in zip(VIEW_CHECKS, audited.figures, strict=True):
        yield check.verdict(config, figures)
    eyes = audited.kept
    off_m = cycles_difference_m(
        root / entry["mesh"], eyes, lambda done, total: progress(f"Cycles depth of {name}", done, total)
    )
    yield cycles_verdict(name, off_m, len(eyes) // 2)


class _Pass:
    """One pass over a config's rows: gathers problems, every check's figures, and the eyes that Cycles repeats."""

    def __init__(
        self,
        config: AuditedConfig,
        records: Sequence[ViewRecord],
        expected: Sequence[ExpectedView],
        depth_views: int,
    ) -> None:
        self._config, self._records, self._expected = config, records, expected
        self._bar_ids = {bar.bar_id for bar in config.steel}
        self._rays = RayMemory()
        self._measured = [set(subset(len(records), check.views)) for check in VIEW_CHECKS]
        self._again = set(subset(len(records), depth_views) if depth_views else ())
        self._problems: list[str] = []
        self.rows = 0
        self.cameras: list[str] = []
        self.figures: list[list[Any]] = [[] for _ in VIEW_CHECKS]
        self.kept: list[AuditedEye] = []

    def add(self, row: Mapping[str, Any]) -> None:
        """Check the next row; one whose arrays are of the wrong kind is not judged further."""
        n = self.rows
        self.rows += 1
        if n >= len(self._records):
            return
        where = self._records[n].view_id
        broken = list(array_problems(row, self._config.entry["rig"]))
        found = broken or row_problems(row, self._records[n], self._bar_ids)
        self._problems += [f"{where}: {problem}" for problem in found]
        if broken:
            return
        if n < len(self._expected):
            self.cameras += [f"{where}: {problem}" for problem in camera_problems(row, self._expected[n])]
        view = audited_view(row, self._rays)
        for check, figures, chosen in zip(VIEW_CHECKS, self.figures, self._measured, strict=True):
            if n in chosen:
                figures.append(check.measure(self._config, view))
        if n in self._again:
            self.kept += [view.left, view.right]

    def rows_check(self) -> Check:
        """Return the verdict on the rows' own invariants."""
        problems = list(self._problems)
        if self.rows != len(self._records):
            problems.append(
                f"{self._config.name} has {self.rows} rows, the manifest names {len(self._records)} views"
            )
        return Check(f"{self._config.name}: rows", f"{self.rows} views", "all invariants", tuple(problems))


def _cameras_check(name: str, expected: Sequence[ExpectedView], problems: Sequence[str]) -> Check:
    return Check(f"{name}: cameras", f"{len(expected)} poses of the protocol", "equal to 1e-12", tuple(problems))
