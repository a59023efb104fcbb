"""Comparison of imports with surveyed bars: the summary, and a note on mistakes of the layout.

The depth of the sample dataset was cast against the bars' meshes, without any code of imports.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.cli.main import main
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import NAMES, Row

pytestmark = pytest.mark.slow
COLUMNS = ("left_depth", "left_rgb", "left_bars")
Change = Callable[[Row], np.ndarray]


def write(
    source: Path,
    rows: list[Row],
    folder: Path,
    tables: str,
    depth: Change | None = None,
    pose: Change | None = None,
) -> Path:
    """Write the source with changed depth or poses, and a layout with these tables; return the layout."""
    shutil.copytree(source, folder)
    for name, row in zip(NAMES, rows, strict=True):
        if depth is not None:
            data.write(folder / f"depth/{name}_left.npy", data.npy(depth(row)))
        if pose is not None:
            (folder / f"poses/{name}.txt").write_text(
                "\n".join(" ".join(map(repr, line)) for line in pose(row).tolist())
            )
    return data.write_layout(folder, COLUMNS, tables=tables)


def run(layout: Path) -> int:
    return main(["import", str(layout), "--out", str(layout.parent / "out"), "--config", "mock-up"])


def times(factor: float) -> Change:
    return lambda row: row["left_depth"] * factor


def outliers(share: float, depth_m: float) -> Change:
    """Return depth of which a share is that of the background, as where a segmentation is wrong."""
    random = np.random.default_rng(57)

    def change(row: Row) -> np.ndarray:
        depth: np.ndarray = row["left_depth"].copy()
        depth[(random.random(depth.shape) < share) & (depth > 0)] = depth_m
        return depth

    return change


def noisy(row: Row) -> np.ndarray:
    depth: np.ndarray = row["left_depth"]
    noise = np.random.default_rng(57).normal(0, 0.003, depth.shape)
    return np.where(depth > 0, depth + noise, 0).astype(np.float32)


BARS, POSES = data.BARS, data.POSES
CASES: dict[str, tuple[str, Change | None, bool]] = {
    "metres as millimetres": (POSES + BARS + "[depth]\nunit = 'mm'\n", None, True),
    "range": (POSES + BARS, data.range_m, True),
    "inverted": (POSES + "kind = 'world_from_cam'\n" + BARS, None, True),
    "OpenGL": (POSES + "axes = 'opengl'\n" + BARS, None, True),
    "poses in millimetres": (POSES + "unit = 'mm'\n" + BARS, None, True),
    "inverted, and outliers": (POSES + "kind = 'world_from_cam'\n" + BARS, outliers(0.04, 30.0), True),
    "exact": (POSES + BARS, None, False),
    "noise": (POSES + BARS, noisy, True),
    "few outliers": (POSES + BARS, outliers(0.04, 30.0), False),
    "many outliers": (POSES + BARS, outliers(0.3, 30.0), True),
}
"""Tables of the layout, change of the depth, and whether the import is noted."""
NOTE = (
    r"the points of surveyed bars are ([\d.e+-]+) m off their surfaces .* expected truth_sigma_m, 0.001 m, or less"
)


@pytest.mark.parametrize("name", CASES)
def test_import_is_noted_only_past_its_uncertainty(
    name: str, source: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables, change, is_noted = CASES[name]
    assert run(write(source, rows, tmp_path / "data", tables, change)) == 0
    errors_m = [float(text) for text in re.findall(NOTE, capsys.readouterr().err)]
    assert len(errors_m) == is_noted
    assert all(error_m > 0.001 for error_m in errors_m)


NUMBER = r"(-?[\d.e+-]+)"
LINE = re.compile(
    rf"  bar (\d+): (\d+) points, offset \({NUMBER}, {NUMBER}, {NUMBER}\) mm, scale {NUMBER}, RMS {NUMBER} mm"
)


def summary(layout: Path, capsys: pytest.CaptureFixture[str]) -> np.ndarray:
    """Return bar, points, offset, scale and RMS of the lines of the summary, a row for each."""
    assert run(layout) == 0
    printed = capsys.readouterr().out
    assert "  and 55 more\n" in printed
    found = LINE.findall(printed)
    assert len(found) == 20
    return np.array(found, dtype=float)


def test_summary_has_the_offset_of_poses(
    source: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mat's bars are horizontal: all of them see a shift of the points along z, and no other one."""
    shift = np.eye(4)
    shift[2, 3] = -0.001
    layout = write(
        source, rows, tmp_path / "data", POSES + BARS, pose=lambda row: row["left_cam_from_world"] @ shift
    )
    numbers = summary(layout, capsys)
    assert np.abs(numbers[:, 4] - 1).max() < 0.35
    assert np.abs(numbers[:, 2:4]).max() < 0.35


def test_summary_has_the_scale_of_depth(
    source: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exact = summary(write(source, rows, tmp_path / "exact", POSES + BARS), capsys)
    scaled = summary(write(source, rows, tmp_path / "scaled", POSES + BARS, times(1.003)), capsys)
    assert np.abs(exact[:, 5] - 1).max() < 0.0005
    assert np.abs(scaled[:, 5] - 1.003).max() < 0.0015
    assert np.median(exact[:, 6]) < 0.2 < 0.4 < np.median(scaled[:, 6])


@pytest.mark.parametrize(
    ("columns", "tables", "reason"),
    [
        (("left_depth", "left_rgb"), POSES + BARS, "it needs [bars] and left_bars"),
        (COLUMNS, POSES, "it needs [bars] and left_bars"),
        (COLUMNS, POSES + BARS, "left_bars show none with depth"),
    ],
)
def test_summary_says_why_nothing_was_compared(
    columns: tuple[str, ...],
    tables: str,
    reason: str,
    source: Path,
    rows: list[Row],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    layout = write(
        source, rows, tmp_path / "data", tables, depth=lambda row: np.where(row["left_bars"] > 0, 0, np.float32(1))
    )
    data.write_layout(layout.parent, columns, tables=tables)
    assert run(layout) == 0
    assert f"compared with no surveyed bar ({reason})" in capsys.readouterr().out
