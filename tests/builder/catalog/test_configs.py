"""Standard configs, user scenes and appearance variants: build, audit and publication."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
from PIL import Image

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.cameras.camera_fit import check_fits
from dataset_builder.cameras.trajectories import view_count
from dataset_builder.catalog.cages_config import CagesRequest
from dataset_builder.catalog.named_configs import CONFIGS, BuildRequest
from dataset_builder.pipeline.contact_sheet import STRIP_PANEL_PX, TILE_PX
from dataset_builder.specs.config_specs import ColourSpec, DomeSpec, RigSpec, RingSpec, colour_spec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.bar_crossings.table import read_crossings
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import ideal_K
from rebar_depth_bench.scoring.evaluation import score
from tests.building import TINY, RunBuild
from tests.requirements import Repetitions

VIEWS = {"lattice": 504, "lattice-orbit": 100, "lattice-zed": 504, "lattice-zed-raw": 504, "lattice-12": 504}
VIEWS |= {"lattice-zed-12": 504, "pile": 504, "pier": 504}
GRID = ("--width", "240", "--height", "135", "--samples", "1")


@pytest.fixture(scope="module")
def full_root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    """Return the root of a dataset of all configs, one view each, built by a single command."""
    root = tmp_path_factory.mktemp("full") / "dataset"
    process = run_build("--out", root, "--views", "1", *GRID)
    assert process.returncode == 0, process.stderr
    assert f"built: {', '.join(VIEWS)}" in process.stdout
    return root


@pytest.fixture(scope="module")
def manifest(full_root: Path) -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads((full_root / "manifest.json").read_text())
    return loaded


def test_config_registry_matches_contract() -> None:
    specs = {name: make() for name, make in CONFIGS.items()}
    assert {name: view_count(spec.protocol) for name, spec in specs.items()} == VIEWS
    assert {
        name: (min(spec.protocol.radii_m), max(spec.protocol.radii_m), spec.protocol.distance_to)
        for name, spec in specs.items()
        if isinstance(spec.protocol, DomeSpec)
    } == {
        **dict.fromkeys(
            (name for name in VIEWS if name.startswith("lattice") and name != "lattice-orbit"),
            (0.22, 0.43, "centre"),
        ),
        "pile": (0.50, 0.90, "centre"),
        "pier": (8.0, 17.0, "nearest steel"),
    }


def test_lattice_zed_12_is_lattice_zed_with_12_markers() -> None:
    zed, markers_12, both = (CONFIGS[name]() for name in ("lattice-zed", "lattice-12", "lattice-zed-12"))
    assert (both.scene, both.protocol, both.rig) == (markers_12.scene, zed.protocol, zed.rig)
    assert both.scene == replace(zed.scene, name="lattice-12", board=BoardSpec(markers=12))


def test_datasets_library_loads_every_config(full_root: Path) -> None:
    for name in VIEWS:
        [row] = datasets.load_dataset(str(full_root), name, split="test")
        assert row["view_id"] == f"{name}/{VIEWS[name] // 2:04d}"
        assert row["left_rgb"].size == (240, 135)


def test_every_config_has_its_scene_and_optics(full_root: Path) -> None:
    bars = read_bars(full_root / "bars.parquet")
    assert {scene: len(scene_bars) for scene, scene_bars in bars.items()} == {
        "lattice": 75,
        "lattice-12": 75,
        "pile": 6,
        "pier": 231,
    }
    crossings = read_crossings(full_root / "crossings.parquet")
    assert {scene: (len(found), found.nodes) for scene, found in crossings.items()} == {
        "lattice": (375, 375),
        "lattice-12": (375, 375),
        "pile": (15, 15),
        "pier": (4860, 4365),
    }
    rows = {name: rdb.load(full_root, name)[0] for name in VIEWS}
    for name, row in rows.items():
        assert row["left_mask"].any(), name
        on_grid = np.array_equal(row["left_K"], ideal_K(240, 135))
        assert on_grid == ("zed" not in name)
        assert row["left_distortion"].any() == (name == "lattice-zed-raw")
    raw, rectified = rows["lattice-zed-raw"], rows["lattice-zed"]
    assert raw["baseline_m"] == rectified["baseline_m"] == pytest.approx(0.119978, abs=1e-9)
    assert (rows["pier"]["left_depth"] == 0).any()  # The sky has no depth.
    assert rows["pier"]["left_depth"][rows["pier"]["left_mask"]].min() > 7.4


def test_audit_passes_on_all_configs(full_root: Path, repetitions: Repetitions) -> None:
    # The comparison with Cycles runs on the sample data in test_audit.py, and on all configs in the nightly tier.
    report = audit(full_root, depth_views=repetitions(0, 1))
    assert [f"{check.name}: {check.problems}" for check in report.failures] == []
    assert sum("depth compared with Cycles" in check.name for check in report.checks) == len(VIEWS)


def test_ground_truth_scores_zero_error_on_every_config(full_root: Path, tmp_path: Path) -> None:
    archive = tmp_path / "truth.zip"
    with rdb.SubmissionWriter(archive, method="truth") as writer:
        for name in VIEWS:
            for row in rdb.load(full_root, name, columns=["view_id", "left_depth"]):
                writer.add(row["view_id"], row["left_depth"])
    tables = score(archive, full_root).tables
    assert set(tables) == set(VIEWS)
    scored = [table for table in tables.values() if table.views_scored]
    assert len(scored) >= len(VIEWS) - 1  # At this size the pier may have no scored pixel.
    assert all(table.native is not None and table.native.abs_rel == 0.0 for table in scored)


def image_size(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        return image.size


def test_contact_sheets_have_one_tile_per_view_and_scene(full_root: Path, manifest: dict[str, Any]) -> None:
    sizes = {path.name: image_size(path) for path in (full_root / "pictures").iterdir()}
    assert sizes.pop("scenes.webp") == (3 * STRIP_PANEL_PX[0], STRIP_PANEL_PX[1])
    assert sizes == {f"{name}.webp": (TILE_PX[0], 2 * TILE_PX[1]) for name in VIEWS}
    card = (full_root / "README.md").read_text()
    assert all(entry["sheet"] in card for entry in manifest["configs"].values())


def test_user_scene_and_variant_are_added_to_dataset(tiny_root: Path, tmp_path: Path, run_build: RunBuild) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(tiny_root, root)
    standard_manifest = (root / "manifest.json").read_text()
    for arguments in (
        ("--scene", "examples/beam.toml"),
        ("--config", "lattice", "--variant", "wet", "formwork"),
        ("--config", "lattice", "--variant", "sensor", "sunset"),
    ):
        process = run_build("--out", root, *arguments, "--views", "1", *TINY)
        assert process.returncode == 0, process.stderr
    manifest = json.loads((root / "manifest.json").read_text())
    entries, digests = manifest["configs"], manifest["files"]
    variants = ["lattice-sunset-sensor", "lattice-wet-formwork"]
    assert list(entries) == ["lattice", "lattice-orbit", "beam", *variants]
    assert entries["lattice"] == json.loads(standard_manifest)["configs"]["lattice"]
    assert entries["lattice-wet-formwork"]["scenes"][0]["appearance"]["variants"] == ["wet", "formwork"]
    assert rdb.load(root, "beam")[0]["left_mask"].any()
    other = rdb.load(root, "lattice-wet-formwork")[0]
    index = other["view_id"].rpartition("/")[2]
    (plain,) = (row for row in rdb.load(root, "lattice") if row["view_id"] == f"lattice/{index}")
    assert np.array_equal(plain["left_cam_from_world"], other["left_cam_from_world"])
    assert not np.array_equal(plain["left_rgb"], other["left_rgb"])
    standard, captured = entries["lattice"], entries["lattice-sunset-sensor"]
    appearance = captured["scenes"][0]["appearance"]
    assert (appearance["image_light"]["image"], appearance["sensor"]["jpeg_quality"]) == ("sunset", 80)
    assert digests[captured["scenes"][0]["mesh"]] == digests[standard["scenes"][0]["mesh"]]
    card = (root / "README.md").read_text()
    assert "The light of `lattice-sunset-sensor` is the panorama sunset" in card
    assert card.count("panorama") == 1
    (record,) = captured["views"]
    (plain_record,) = (item for item in standard["views"] if item["view_id"] == f"lattice/{index}")
    assert record == {**plain_record, "view_id": record["view_id"]}, "ground truth does not depend on colour"
    assert audit(root, depth_views=0).failures == ()


@pytest.mark.parametrize(
    ("request_", "problems"),
    [
        (BuildRequest(variants=("rust",)), [("unknown", "'rust'")]),
        (BuildRequest(variants=("wet", "rusted")), [("conflict", "")]),
        (BuildRequest(configs=("pier", "latice", "pil")), [("unknown", "--config")] * 2),
        (BuildRequest(views=0, width=2), [("invalid", "--views"), ("invalid", "--width")]),
        (
            BuildRequest(("cages", "pil"), views=1, width=2, cages=CagesRequest("val", 0)),
            [
                ("invalid", "--width"),
                ("invalid", "--scenes"),
                ("unknown", "--config"),
                ("unknown", "--split"),
                ("conflict", "--views"),
            ],
        ),
    ],
)
def test_invalid_build_request_is_rejected(request_: BuildRequest, problems: list[tuple[str, str]]) -> None:
    with pytest.raises(InputError) as raised:
        request_.config_specs()
    assert [(problem.code, problem.where) for problem in raised.value.problems] == problems


def test_duplicate_config_names_are_rejected() -> None:
    request = BuildRequest(configs=(), scenes=(CONFIGS["pile"](), CONFIGS["pile"]()))
    with pytest.raises(InputError, match="more than one config is named pile"):
        request.config_specs()


def test_mesh_option_is_rejected_for_other_scenes(tmp_path: Path, run_build: RunBuild) -> None:
    (tmp_path / "a.stl").write_bytes(b"")
    process = run_build("--out", tmp_path / "dataset", "--config", "pile", "--mesh", tmp_path / "a.stl")
    assert process.returncode == 2
    assert "--mesh replaces the rods of a lattice, but config pile is not a lattice" in process.stderr


def test_variant_order_does_not_matter() -> None:
    first, second = (
        BuildRequest(variants=names).config_specs() for names in (("wet", "formwork"), ("formwork", "wet"))
    )
    assert first == second
    assert first[0].name == "lattice-wet-formwork"


def test_shadow_screen_among_cameras_is_rejected() -> None:
    [spec] = BuildRequest(configs=("lattice",), variants=("shadows",)).config_specs()
    check_fits(make_assembly(spec.scene.assembly), spec)
    far = replace(spec, protocol=RingSpec(radius_m=0.6, elevation_deg=30.0, azimuths=4))
    with pytest.raises(InputError, match=r"would be among the cameras: 0\.5"):
        check_fits(make_assembly(far.scene.assembly), far)


def test_size_and_samples_reach_every_rig() -> None:
    for spec in BuildRequest(width=320, height=180, colour=colour_spec(samples=3)).config_specs():
        assert (spec.rig.width, spec.rig.height, spec.colour) == (320, 180, ColourSpec(3, 3))
        assert (spec.rig.calibration is None) == (spec.rig.baseline_m == RigSpec.baseline_m)
