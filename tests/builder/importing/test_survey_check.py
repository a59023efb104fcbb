"""Comparison of imports with surveyed bars: the summary, and mistakes of the layout that are named.

The depth of the sample dataset was cast against the bars' meshes, without any code of imports.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dataset_builder.cli.main import main
from rebar_depth_bench.geometry.cameras import inverse_rigid
from tests.builder.importing import source_data as data
from tests.builder.importing.source_data import NAMES, Row

pytestmark = pytest.mark.slow
COLUMNS = ("left_depth", "left_rgb", "left_bars")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
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


def moved(factor: float) -> Change:
    """Return poses whose translations are in other units."""
    return lambda row: row["left_cam_from_world"] * np.array([[1, 1, 1, factor]] * 3 + [[1] * 4])


def inverted(row: Row) -> np.ndarray:
    return inverse_rigid(row["left_cam_from_world"])


def turned(row: Row) -> np.ndarray:
    return np.asarray(OPENGL @ row["left_cam_from_world"])


def outliers(share: float, depth_m: float) -> Change:
    """Return depth of which a share is that of the background, as where a segmentation is wrong."""
    random = np.random.default_rng(57)

    def change(row: Row) -> np.ndarray:
        depth: np.ndarray = row["left_depth"].copy()
        depth[(random.random(depth.shape) < share) & (depth > 0)] = depth_m
        return depth

    return change


BARS, POSES = data.BARS, data.POSES
MISTAKES: dict[str, tuple[str, Change | None, Change | None, str]] = {
    "metres as millimetres": (POSES + BARS + "[depth]\nunit = 'mm'\n", None, None, 'depth.unit = "m"'),
    "scale": (POSES + BARS + "[depth]\nscale = 0.01\n", None, None, 'depth.unit = "m" in place of depth.scale'),
    "centimetres": (POSES + BARS, times(100), None, 'depth.unit = "cm"'),
    "inches": (POSES + BARS, times(1 / 0.0254), None, 'depth.unit = "in"'),
    "feet": (POSES + BARS, times(1 / 0.3048), None, 'depth.unit = "ft"'),
    "range": (POSES + BARS, data.range_m, None, 'depth.kind = "range"'),
    "no range": (POSES + BARS + "[depth]\nkind = 'range'\n", None, None, 'depth.kind = "z"'),
    "inverted": (POSES + BARS, None, inverted, 'poses.kind = "world_from_cam"'),
    "not inverted": (POSES + "kind = 'world_from_cam'\n" + BARS, None, None, 'poses.kind = "cam_from_world"'),
    "OpenGL": (POSES + BARS, None, turned, 'poses.axes = "opengl"'),
    "no OpenGL": (POSES + "axes = 'opengl'\n" + BARS, None, None, 'poses.axes = "opencv"'),
    "Blender": (
        POSES + BARS,
        None,
        data.opengl_world_from_cam,
        'poses.kind = "world_from_cam" and poses.axes = "opengl"',
    ),
    "Blender as OpenCV": (
        POSES + "kind = 'world_from_cam'\n" + BARS,
        None,
        data.opengl_world_from_cam,
        'poses.axes = "opengl"',
    ),
    "Blender as cam_from_world": (
        POSES + "axes = 'opengl'\n" + BARS,
        None,
        data.opengl_world_from_cam,
        'poses.kind = "world_from_cam"',
    ),
    "outliers": (POSES + BARS, outliers(0.04, 30.0), inverted, 'poses.kind = "world_from_cam"'),
    "poses in millimetres": (POSES + BARS, None, moved(1000), 'poses.unit = "mm"'),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistake_is_named_and_nothing_is_published(
    name: str, source: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables, depth, pose, line = MISTAKES[name]
    layout = write(source, rows, tmp_path / "data", tables, depth, pose)
    assert run(layout) == 2
    assert f"expected {line} in the layout\n" in capsys.readouterr().err
    assert not list((layout.parent / "out").rglob("*"))


@pytest.mark.parametrize(
    ("unit_m", "is_inverted", "words"),
    [
        (0.001, False, "a unit of depth that is 1000 times as large in transforms.json"),
        (1.0, True, "poses inverted in transforms.json"),
    ],
)
def test_mistake_of_the_file_of_all_cameras_is_named(
    unit_m: float,
    is_inverted: bool,
    words: str,
    source: Path,
    rows: list[Row],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    layout = write(source, rows, tmp_path / "data", BARS)
    frames = []
    for name, row in zip(NAMES, rows, strict=True):
        pose = inverted(row) if is_inverted else row["left_cam_from_world"]
        frames.append({"file_path": name, "transform_matrix": (inverse_rigid(pose) @ OPENGL).tolist()})
    K = rows[0]["left_K"].tolist()
    lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2] + 0.5, "cy": K[1][2] + 0.5}
    document = {**lens, "depth_unit_scale_factor": unit_m, "frames": frames}
    (layout.parent / "transforms.json").write_text(json.dumps(document))
    cameras = '[cameras]\nviews = "transforms.json"\n'
    layout.write_text(re.sub(r"(?s)\[cameras.*?(?=\n\[bars\])", cameras, layout.read_text()))
    assert run(layout) == 2
    assert f"expected {words}\n" in capsys.readouterr().err


def noisy(row: Row) -> np.ndarray:
    depth: np.ndarray = row["left_depth"]
    noise = np.random.default_rng(57).normal(0, 0.003, depth.shape)
    return np.where(depth > 0, depth + noise, 0).astype(np.float32)


RIGHT: dict[str, Change | None] = {
    "exact": None,
    "noise": noisy,
    "few outliers": outliers(0.04, 30.0),
    "many outliers": outliers(0.3, 30.0),
    "many far outliers": outliers(0.3, 900.0),
    "many near outliers": outliers(0.3, 0.05),
}


@pytest.mark.parametrize("name", RIGHT)
def test_right_import_is_not_refused(
    name: str, source: Path, rows: list[Row], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = write(source, rows, tmp_path / "data", POSES + BARS, RIGHT[name])
    layout.write_text(layout.read_text().replace("truth_sigma_m = 0.001", "truth_sigma_m = 1e-9"))
    assert run(layout) == 0
    assert "75 of 75 surveyed bars are seen" in capsys.readouterr().out


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
