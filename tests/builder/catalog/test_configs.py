"""Standard configs, distance sweeps, requests, user scenes and variants: specs, builds, audit and publication."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
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
from dataset_builder.cameras.trajectories import aim_point_m, camera_offsets_m, poses, subset, view_count
from dataset_builder.catalog.cages_config import CagesRequest, cage_scenes
from dataset_builder.catalog.named_configs import CONFIGS, SWEEPS, BuildRequest
from dataset_builder.cli.main import argument_parser
from dataset_builder.pipeline.contact_sheet import STRIP_PANEL_PX, TILE_PX
from dataset_builder.pipeline.plan import config_parameters
from dataset_builder.scene.environments.surroundings import SURROUNDINGS
from dataset_builder.specs.config_specs import ColourSpec, ConfigSpec, DomeSpec, RigSpec, colour_spec
from dataset_builder.user_files.make_assembly import make_assembly
from dataset_builder.user_files.rig_file import RigTable
from rebar_depth_bench import score
from rebar_depth_bench.bar_crossings.crossings_file import read_crossings
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.bars import read_bars
from rebar_depth_bench.data.files import views_digest
from rebar_depth_bench.data.manifest import DatasetConfig
from rebar_depth_bench.data.schema import ViewRecord
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.geometry.cameras import Camera, ideal_K
from rebar_depth_bench.scoring.protocol import scored_pixels
from rebar_depth_bench.scoring.table import PublishedMatch
from rebar_depth_bench.scoring.truth import paper_differences, published_match
from tests.builder.cameras.survey_cages import steel_caster
from tests.building import TINY, RunBuild
from tests.commands import run_in_process
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


def test_config_registry_matches_contract() -> None:
    protocols = {name: make().protocol for name, make in CONFIGS.items()}
    assert {name: view_count(protocol) for name, protocol in protocols.items()} == VIEWS
    domes = {
        name: (min(protocol.radii_m), max(protocol.radii_m), protocol.distance_to)
        for name, protocol in protocols.items()
        if isinstance(protocol, DomeSpec)
    }
    assert (domes.pop("pile"), domes.pop("pier")) == ((0.50, 0.90, "centre"), (8.0, 17.0, "nearest steel"))
    assert domes == dict.fromkeys(sorted(VIEWS.keys() - {"pile", "pier", "lattice-orbit"}), (0.22, 0.43, "centre"))


def test_lattice_zed_12_is_lattice_zed_with_12_markers() -> None:
    zed, markers_12, both = (CONFIGS[name]() for name in ("lattice-zed", "lattice-12", "lattice-zed-12"))
    assert (both.scene, both.protocol, both.rig) == (markers_12.scene, zed.protocol, zed.rig)
    assert both.scene == replace(zed.scene, name="lattice-12", board=BoardSpec(markers=12))


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
        [plain] = datasets.load_dataset(str(full_root), name, split="test")
        assert plain["view_id"] == row["view_id"] == f"{name}/{VIEWS[name] // 2:04d}"
        assert plain["left_rgb"].size == (240, 135)
        assert row["left_mask"].any(), name
        on_grid = np.array_equal(row["left_K"], ideal_K(240, 135))
        assert on_grid == ("zed" not in name)
        assert row["left_distortion"].any() == (name == "lattice-zed-raw")
    raw, rectified = rows["lattice-zed-raw"], rows["lattice-zed"]
    assert raw["baseline_m"] == rectified["baseline_m"] == pytest.approx(0.119978, abs=1e-9)
    assert (rows["pier"]["left_depth"] == 0).any()  # The sky has no depth.
    assert rows["pier"]["left_depth"][rows["pier"]["left_mask"]].min() > 7.4


def test_contact_sheets_have_one_tile_per_view_and_scene(full_root: Path) -> None:
    sizes = {}
    for path in (full_root / "pictures").iterdir():
        with Image.open(path) as picture:
            sizes[path.name] = picture.size
    assert sizes.pop("scenes.webp") == (3 * STRIP_PANEL_PX[0], STRIP_PANEL_PX[1])
    assert sizes == {f"{name}.webp": (TILE_PX[0], 2 * TILE_PX[1]) for name in VIEWS}
    entries = json.loads((full_root / "manifest.json").read_text())["configs"].values()
    card = (full_root / "README.md").read_text()
    assert all(entry["sheet"] in card for entry in entries)


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
    assert all(table["native.abs_rel"] == 0.0 for table in scored)


def test_user_scene_without_colour_and_variants_are_added_to_dataset(
    tiny_root: Path, tmp_path: Path, run_build: RunBuild
) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(tiny_root, root)
    standard_manifest = (root / "manifest.json").read_text()
    for arguments in (
        ("--scene", "examples/beam.toml", *TINY[:4], "--no-colour"),
        ("--config", "lattice", "--variant", "wet", "formwork", *TINY),
        ("--config", "lattice", "--variant", "sensor", "sunset", *TINY),
    ):
        process = run_build("--out", root, *arguments, "--views", "1")
        assert process.returncode == 0, process.stderr
    manifest = json.loads((root / "manifest.json").read_text())
    entries, digests = manifest["configs"], manifest["files"]
    variants = ["lattice-sunset-sensor", "lattice-wet-formwork"]
    assert list(entries) == ["lattice", "lattice-orbit", "beam", *variants]
    assert entries["lattice"] == json.loads(standard_manifest)["configs"]["lattice"]
    assert entries["lattice-wet-formwork"]["scenes"][0]["appearance"]["variants"] == ["wet", "formwork"]
    assert rdb.load(root, "beam")[0]["left_mask"].any()
    colour = [datasets.load_dataset(str(root), name, split="test")[0]["left_rgb"] for name in ("lattice", "beam")]
    assert [cell is None for cell in colour] == [False, True]
    other = rdb.load(root, "lattice-wet-formwork")[0]
    index = other["view_id"].rpartition("/")[2]
    (plain,) = (row for row in rdb.load(root, "lattice") if row["view_id"] == f"lattice/{index}")
    assert np.array_equal(plain["left_cam_from_world"], other["left_cam_from_world"])
    assert not np.array_equal(plain["left_rgb"], other["left_rgb"])
    standard, captured = entries["lattice"], entries["lattice-sunset-sensor"]
    appearance = captured["scenes"][0]["appearance"]
    assert (appearance["image_light"]["image"], appearance["sensor"]["jpeg_quality"]) == ("sunset", 80)
    assert digests[captured["scenes"][0]["mesh"]] == digests[standard["scenes"][0]["mesh"]]
    (record,) = captured["views"]
    (plain_record,) = (item for item in standard["views"] if item["view_id"] == f"lattice/{index}")
    assert record == {**plain_record, "view_id": record["view_id"]}, "ground truth does not depend on colour"
    assert audit(root, depth_views=0).failures == ()
    predicted = ("predict", "sgbm", "--data", root, "--config", "lattice", "--out", tmp_path / "a.zip")
    assert run_in_process(rebar_bench, *predicted).returncode == 0


@pytest.mark.parametrize(
    ("request_", "problems"),
    [
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


def test_size_and_samples_reach_every_rig() -> None:
    for spec in BuildRequest(width=320, height=180, colour=colour_spec(samples=3)).config_specs():
        assert (spec.rig.width, spec.rig.height, spec.colour) == (320, 180, ColourSpec(3, 3))
        assert (spec.rig.calibration is None) == (spec.rig.baseline_m == RigSpec.baseline_m)


def config_of_spec(spec: ConfigSpec, views: int | None = None) -> DatasetConfig:
    """Return the config of a complete build, or of one with fewer ``views``."""
    count = view_count(spec.protocol)
    records = [
        ViewRecord(view_id=f"{spec.name}/{n:04d}", left="0" * 64, right="0" * 64, steel_px=9, scored_px=1)
        for n in range(views or count)
    ]
    parameters = config_parameters(spec)
    scene = {
        **parameters["scene"],
        **{key: parameters[key] for key in ("protocol", "rig")},
        "split": "test",
        "protocol_views": count,
        "key": "k",
        "mesh": "m.ply",
        "shards": ["x.parquet"],
        "bytes": 1,
    }
    entry: dict[str, Any] = {
        **{key: parameters[key] for key in ("name", "rig", "colour")},
        "has_splits": False,
        "scenes": [scene],
        "sheet": "s.webp",
        "ground_truth_digest": views_digest(records),
        "views": [record.model_dump() for record in records],
    }
    return DatasetConfig(**DatasetConfig.fields_of_entry(entry["name"], entry), root="x")


EXACT = {"lattice-zed": "lattice", "pile": "pile", "pier": "pier"}
OTHER_OPTICS = {"lattice": "lattice", "lattice-zed-raw": "lattice"}


@pytest.mark.parametrize("name", CONFIGS)
def test_published_rows_match_complete_standard_configs(name: str) -> None:
    expected = None
    if scene := (EXACT | OTHER_OPTICS).get(name):
        expected = PublishedMatch(scene, same_optics=name in EXACT)
    assert published_match(config_of_spec(CONFIGS[name]())) == expected
    incomplete = config_of_spec(CONFIGS[name](), views=6)
    assert published_match(incomplete) is None
    assert not expected or paper_differences(incomplete) == ["6 of 504 views"]


def test_numbers_of_a_rig_are_other_optics_than_those_of_the_paper() -> None:
    rig = RigTable(width=1280, height=720, baseline=0.12, fx=500.0).rig(Path("scene.toml"), 1.0)
    config = config_of_spec(replace(CONFIGS["pier"](), rig=rig))
    assert published_match(config) == PublishedMatch("pier", same_optics=False)


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (
            lambda spec: replace(spec, rig=replace(spec.rig, width=640, height=360)),
            "640 x 360 pixels, not 1280 x 720",
        ),
        (lambda spec: replace(spec, protocol=replace(spec.protocol, azimuths=11)), "other camera positions"),
        (
            lambda spec: replace(spec, protocol=replace(spec.protocol, distance_to="centre")),
            "other camera positions",
        ),
        (
            lambda spec: replace(spec, scene=replace(spec.scene, environment="laboratory")),
            "environment laboratory, not outdoors",
        ),
        (
            lambda spec: replace(
                spec, scene=replace(spec.scene, assembly=replace(spec.scene.assembly, levels=44))
            ),
            "not a scene of the paper",
        ),
    ],
)
def test_other_conditions_match_no_published_rows(
    change: Callable[[ConfigSpec], ConfigSpec], difference: str
) -> None:
    config = config_of_spec(change(CONFIGS["pier"]()))
    assert (published_match(config), paper_differences(config)) == (None, [difference])


DISTANCE_RANGES_M = {"lattice-distance": (0.22, 1.6), "pile-distance": (0.5, 2.2), "pier-distance": (5.0, 17.0)}


@pytest.fixture(params=list(DISTANCE_RANGES_M))
def config(request: pytest.FixtureRequest) -> ConfigSpec:
    [spec] = BuildRequest(configs=(request.param,)).config_specs()
    return spec


def test_sweeps_are_built_only_when_named() -> None:
    assert set(SWEEPS) == set(DISTANCE_RANGES_M)
    assert not set(SWEEPS) & set(CONFIGS)
    assert [spec.name for spec in BuildRequest().config_specs()] == list(CONFIGS)
    options = argument_parser().parse_args(["build", "--out", "root", "--config", *DISTANCE_RANGES_M])
    assert [spec.name for spec in BuildRequest(configs=tuple(options.config)).config_specs()] == list(
        DISTANCE_RANGES_M
    )


def test_sweep_has_the_scene_of_a_dome_at_12_distances_in_8_directions(config: ConfigSpec) -> None:
    dome = CONFIGS[config.name.removesuffix("-distance")]()
    assert (config.scene, config.rig, config.colour) == (dome.scene, dome.rig, dome.colour)
    assert [index // 8 for index in subset(96, 12)] == list(range(12)), "a subset of 12 has every distance"
    offsets = np.array(camera_offsets_m(config.protocol, np.zeros(3), ())).reshape(12, 8, 3)
    radii_m = np.linalg.norm(offsets, axis=2)
    assert np.ptp(radii_m, axis=1).max() < 1e-9
    assert (radii_m[0, 0], radii_m[-1, 0]) == pytest.approx(DISTANCE_RANGES_M[config.name])
    ratios = radii_m[1:, 0] / radii_m[:-1, 0]
    assert np.ptp(ratios) < 0.01
    directions = offsets / radii_m[..., None]
    assert np.abs(directions - directions[0]).max() < 1e-12, "distance alone changes"
    assert len({tuple(direction) for direction in directions[0].round(6).tolist()}) == 8
    assert np.abs(directions[0][:, :2]).min() > 0.1, "no camera looks along the lattice's rods"


def test_cameras_are_inside_environment(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    check_fits(assembly, config)
    max_radius_m = SURROUNDINGS[config.scene.environment].cameras.radius_m
    aim_m = aim_point_m(assembly)
    centres_m = aim_m + np.array(camera_offsets_m(config.protocol, aim_m, assembly.bars))
    assert np.linalg.norm(centres_m[:, :2], axis=1).max() <= max_radius_m
    assert centres_m[:, 2].min() > 0.1


@pytest.mark.slow
def test_farthest_views_have_1000_scored_pixels(config: ConfigSpec) -> None:
    assembly = make_assembly(config.scene.assembly)
    caster = steel_caster(assembly)
    views = poses(config.protocol, aim_point_m(assembly), config.rig)
    cameras = [Camera(ideal_K(1280, 720), np.zeros(5), views[i], 1280, 720) for i in (0, 95)]
    scored = [scored_pixels(truth.mask, truth.depth_m) for truth in map(caster.cast, cameras)]
    assert len(scored[0]) > len(scored[1]) > 1000


def test_surroundings_of_generated_cages_suit_their_families() -> None:
    scenes = [config.scene for config in cage_scenes(CagesRequest("train", 400), 0, 64, 36, None)]
    found = {(scene.name.rpartition("-")[0], scene.environment) for scene in scenes}
    assert found >= {("slab", "deck"), ("column", "deck"), ("footing", "outdoors"), ("pile-cage", "hall")}
    assert not found & {("footing", "deck"), ("pile-cage", "deck")}, "they are cast in the ground"
    props = {(scene.name.rpartition("-")[0], name) for scene in scenes for name in scene.appearance.variants}
    assert props >= {("wall", "formwork"), ("slab", "formwork"), ("column", "spacers"), ("slab", "clutter")}
    assert not props & {
        ("column", "formwork"),
        ("pile-cage", "formwork"),
        ("joint", "formwork"),
        ("slab", "spacers"),
    }
