"""A build of a mesh with a bent bar and a part to which no bar fits: from the note to export and measures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import trimesh

from dataset_builder.audit import audit
from dataset_builder.export import export
from dataset_builder.scene.assemblies.cage import packed_cage, unpacked_cage
from dataset_builder.user_files.cage_file import (
    cage_assembly,
    cage_file_spec,
    mesh_file_spec,
    read_cage,
)
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.bars import read_bars
from tests.builder.user_files.tube_shapes import CENTRELINES_M, length_m, line_distance_m, swept
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


@pytest.mark.slow
def test_build_with_bent_bar_and_plate(tmp_path: Path, run_build: RunBuild) -> None:
    (tmp_path / "cage.obj").write_text(cage_obj())
    (tmp_path / "bent.toml").write_text(SCENE)
    root = tmp_path / "root"
    request = ("--out", root, "--scene", tmp_path / "bent.toml", "--views", "2", *TINY)
    process = run_build(*request)
    assert process.returncode == 0, process.stderr
    (note,) = (line for line in process.stderr.splitlines() if line.startswith("note:"))
    assert "cage.obj" in note
    assert "1 of 2 bars" in note
    assert note.endswith("bar 2, plate")
    (entry,) = json.loads((root / "manifest.json").read_text())["configs"].values()
    world_from_source = np.array(entry["scenes"][0]["world_from_source"])
    line_m = LINE_M @ world_from_source[:3, :3].T + world_from_source[:3, 3]

    (bars,) = read_bars(root / "bars.parquet").values()
    assert bars[0].diameter_m == pytest.approx(0.012, rel=0.01)
    assert bars[0].length_m == pytest.approx(length_m(LINE_M), rel=0.005)
    assert line_distance_m(np.array(bars[0].axis_m), line_m) < 1e-4
    assert not bars[1].has_axis
    assert pq.read_table(root / "bars.parquet")["axis"].null_count == 1

    assert audit(root, depth_views=0).failures == ()
    export(root, tmp_path / "export")
    assert len((tmp_path / "export/bent/sparse/0/points3D.txt").read_text().splitlines()) > 100
    archive, result = tmp_path / "a.zip", tmp_path / "a.json"
    for arguments in (
        ("predict", "truth", "--data", root, "--out", archive),
        ("score", archive, "--data", root, "--extended", "--json", result, "--html", tmp_path / "a.html"),
    ):
        run = run_in_process(rebar_bench, *arguments)
        assert run.returncode == 0, run.stderr
    assert json.loads(result.read_text())["tables"]["bent"]["rank_error"] < 1e-6
