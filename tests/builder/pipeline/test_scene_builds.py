"""Builds of scene files up to export and scores: survey cameras, a bent bar and a part without a bar."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.cli.main import main
from dataset_builder.export import export
from dataset_builder.scene.assemblies.cage import packed_cage, unpacked_cage
from dataset_builder.user_files.cage_file import cage_assembly, cage_file_spec, mesh_file_spec, read_cage
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.data.schema import Survey
from rebar_depth_bench.geometry.cameras import camera_centre
from tests.builder.cameras.survey_cages import column, scene
from tests.builder.catalog.scene_files import write_scene
from tests.builder.scene.cages import line_length_m
from tests.builder.user_files.tube_shapes import CENTRELINES_M, line_distance_m, swept
from tests.building import TINY, TWO_BARS, RunBuild
from tests.commands import run_in_process

SCENE = 'unit = "m"\nmesh = "cage.obj"\nenvironment = "laboratory"\n'
LINE_M = CENTRELINES_M["U-bar"] + [-0.1, -0.2, 0.05]


def cage_obj() -> str:
    """Return a U-bar and, below it, a plate, as two objects."""
    u_bar = swept(LINE_M, 12)
    plate = trimesh.creation.box(
        (0.1, 0.1, 0.01), transform=trimesh.transformations.translation_matrix((0, 0, 0.03))
    )
    lines, first = [], 1
    for name, vertices_m, faces in (
        ("bent", u_bar.vertices_m, u_bar.faces),
        ("plate", plate.vertices, plate.faces),
    ):
        lines += [f"o {name}", *(f"v {x!r} {y!r} {z!r}" for x, y, z in np.asarray(vertices_m).tolist())]
        lines += [f"f {a} {b} {c}" for a, b, c in (np.asarray(faces) + first).tolist()]
        first += len(vertices_m)
    return "\n".join(lines) + "\n"


def test_staged_cage_has_the_same_meshes(tmp_path: Path) -> None:
    (tmp_path / "cage.obj").write_text(cage_obj())
    for cage in (read_cage(mesh_file_spec(tmp_path / "cage.obj", "m")), read_cage(cage_file_spec(TWO_BARS))):
        content = packed_cage(cage)
        assert packed_cage(cage) == content
        expected, staged = cage_assembly(cage, "cage"), cage_assembly(unpacked_cage(content), "staged")
        assert repr(staged.bars) == repr(expected.bars)  # A diameter that is NaN equals no other.
        for part, expected_part in zip(staged.parts, expected.parts, strict=True):
            assert part.name == expected_part.name
            assert part.mesh.vertices_m.tobytes() == expected_part.mesh.vertices_m.tobytes()
            assert part.mesh.faces.tobytes() == expected_part.mesh.faces.tobytes()


def rank_error_of_exact_depth(root: Path, config: str, folder: Path) -> float:
    """Predict the ground truth, score it with all measures, and return the rank error of a config."""
    archive, result = folder / "a.zip", folder / "a.json"
    for arguments in (
        ("predict", "truth", "--data", root, "--out", archive),
        ("score", archive, "--data", root, "--extended", "--json", result, "--html", folder / "a.html"),
    ):
        run = run_in_process(rebar_bench, *arguments)
        assert run.returncode == 0, run.stderr
    return float(json.loads(result.read_text())["tables"][config]["rank_error"])


@pytest.mark.slow
def test_build_with_bent_bar_and_plate(tmp_path: Path, run_build: RunBuild) -> None:
    (tmp_path / "cage.obj").write_text(cage_obj())
    (tmp_path / "bent.toml").write_text(SCENE)
    root = tmp_path / "root"
    request = ("--out", root, "--scene", tmp_path / "bent.toml", "--views", "2", *TINY)
    process = run_build(*request)
    assert process.returncode == 0, process.stderr
    moved, note = (line for line in process.stderr.splitlines() if line.startswith("note:"))
    assert "cage.obj" in moved
    assert "cage.obj" in note
    assert "1 of 2 bars" in note
    assert note.endswith("bar 2, plate")
    (entry,) = json.loads((root / "manifest.json").read_text())["configs"].values()
    world_from_source = np.array(entry["scenes"][0]["world_from_source"])
    line_m = LINE_M @ world_from_source[:3, :3].T + world_from_source[:3, 3]

    (bars,) = read_bars(root / "bars.parquet").values()
    assert bars[0].diameter_m == pytest.approx(0.012, rel=0.01)
    assert bars[0].length_m == pytest.approx(line_length_m(LINE_M), rel=0.005)
    assert line_distance_m(np.array(bars[0].axis_m), line_m) < 1e-4
    assert not bars[1].has_axis
    assert pq.read_table(root / "bars.parquet")["axis"].null_count == 1

    assert audit(root, depth_views=0).failures == ()
    export(root, tmp_path / "export")
    assert len((tmp_path / "export/bent/sparse/0/points3D.txt").read_text().splitlines()) > 100
    assert rank_error_of_exact_depth(root, "bent", tmp_path) < 1e-6


CAMERAS = "distances = [500, 2000]\nviews_per_distance = 4"
SIZE = ("--width", "192", "--height", "108", "--no-colour")


@pytest.mark.slow
def test_build_of_life_size_column(tmp_path: Path, run_build: RunBuild) -> None:
    content = f'{scene(column(), CAMERAS)}\n[rig]\ncamera = "Luxonis OAK-D"\n'
    path = write_scene(tmp_path, content, "column.toml")
    root = tmp_path / "root"
    estimate = run_in_process(main, "--out", root, "--scene", path, "--views", "4", *SIZE, "--dry-run")
    assert estimate.returncode == 0, estimate.stderr
    process = run_build("--out", root, "--scene", path, "--views", "4", *SIZE)
    assert process.returncode == 0, process.stderr

    config = open_folder(root).config("column")
    assert isinstance(config.scene.trajectory, Survey)
    assert [view.view_id for view in config.views] == [f"column/{n:04d}" for n in (1, 3, 5, 7)]
    assert all((view.steel_px or 0) > 10 for view in config.views)
    assert all(view.scored_px > 20 for view in config.views[:2])  # Bars at 2 m are a pixel thick.
    for row, n in zip(rdb.load(root, "column"), (1, 3, 5, 7), strict=True):
        centre_m, aimed_m = config.scene.entry["protocol"]["stations"][n]
        np.testing.assert_allclose(camera_centre(row["left_cam_from_world"]), centre_m, atol=1e-9)
        assert (row["baseline_m"], row["left_K"][0, 0]) == (0.075, pytest.approx(882.5 * 192 / 1280, rel=1e-6))
        steel_m = row["left_depth"][row["left_mask"]]
        distance_m = float(np.linalg.norm(np.subtract(centre_m, aimed_m)))
        assert 0.5 * distance_m < np.median(steel_m) < 1.5 * distance_m
    assert audit(root, depth_views=1).failures == ()
    again = run_in_process(main, "--out", root, "--scene", path, "--views", "4", *SIZE)
    assert "up to date: column" in again.stdout
    card = (root / "README.md").read_text()
    assert "0.5-2 m, steel aimed at" in card
    assert "ideal pinholes with baseline and field of view, not noise or depth engine, of Luxonis OAK-D." in card

    export(root, tmp_path / "export")
    assert (tmp_path / "export/column/cameras.json").is_file()
    assert rank_error_of_exact_depth(root, "column", tmp_path) < 1e-6

    manifest = json.loads((root / "manifest.json").read_text())
    manifest["configs"]["column"]["scenes"][0]["protocol"]["stations"][3][0][2] += 1e-6
    (root / "manifest.json").write_text(json.dumps(manifest))
    assert [check.name for check in audit(root, depth_views=0).failures] == ["column: cameras"]
