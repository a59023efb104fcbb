"""Forms of scene files and planes of formwork: rendered depth, the manifest, the audit and the inspection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_erosion

import rebar_depth_bench as rdb
from dataset_builder.audit import audit
from dataset_builder.cli.main import main
from dataset_builder.scene.variants.props import form_planes, make_props
from dataset_builder.specs.config_specs import AppearanceSpec, GeneratedCageSpec, SceneSpec, SurveySpec
from dataset_builder.user_files.make_assembly import make_assembly
from rebar_depth_bench.base.errors import DatasetError, InputError
from rebar_depth_bench.cli.main import main as rebar_bench
from rebar_depth_bench.data.files import planes_digest
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.cameras import inverse_rigid
from tests.builder.catalog.scene_files import MM, scene_config, write_scene
from tests.building import RunBuild
from tests.commands import run_in_process
from tests.damage import change_manifest, copy_dataset

BARS = """
[[bar]]
diameter = 10
points = [[-150, 0, 56], [150, 0, 56]]
count = 3
step = [0, 50, 0]
"""
RING = '[cameras]\nkind = "ring"\nradius = 420\nelevation_deg = 40\nazimuths = 8\n'
BASE = '[[form]]\npoint = [0, 25, 26]\nnormal = [0, 0, 9]\nsize = [360, 300]\nname = "base"\n'
SIDE = "[[form]]\npoint = [-190, 0, 90]\nnormal = [2, 0, 1]\nsize = [200, 100]\n"
SCENE = MM + BARS + RING + BASE + SIDE
SIDE_NORMAL = np.array([2, 0, 1]) / np.sqrt(5)
FACES = {
    "base": (np.array([0, 0.025, 0.026]), np.eye(3), (0.36, 0.3)),
    "form-2": (
        np.array([-0.19, 0, 0.09]),
        np.array([[0, 1, 0], np.cross(SIDE_NORMAL, [0, 1, 0]), SIDE_NORMAL]),
        (0.2, 0.1),
    ),
}
"""Middle, axes (rows: along, across, normal) and sides of the faces of ``SCENE``, world, metres."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, run_build: RunBuild) -> Path:
    folder = tmp_path_factory.mktemp("forms")
    scene = write_scene(folder, SCENE, "mat.toml")
    size = ("--width", "240", "--height", "135", "--no-colour")
    process = run_build("--out", folder / "root", "--scene", scene, "--views", "4", *size)
    assert process.returncode == 0, process.stderr
    return folder / "root"


def plane_and_face(row: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the depth of a plane at each pixel, and whether its face is there if nothing is in front of it."""
    middle_m, axes, size_m = FACES[name]
    height, width = row["left_depth"].shape
    world_from_cam, K = inverse_rigid(row["left_cam_from_world"]), row["left_K"]
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    slopes = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1)
    directions, centre_m = slopes @ world_from_cam[:3, :3].T, world_from_cam[:3, 3]
    depth_m = ((middle_m - centre_m) @ axes[2]) / (directions @ axes[2])
    in_face_m = np.abs((centre_m + depth_m[..., None] * directions - middle_m) @ axes[:2].T)
    is_front = (centre_m - middle_m) @ axes[2] > 0
    return depth_m, (in_face_m < np.divide(size_m, 2)).all(axis=-1) & (depth_m > 0) & is_front


@pytest.mark.slow
def test_depth_of_forms_is_that_of_their_planes(root: Path) -> None:
    planes = {plane.name: plane for plane in open_folder(root).config("mat").scene.planes}
    assert planes.keys() == FACES.keys()
    seen = dict.fromkeys(FACES, 0)
    for name, (middle_m, axes, _) in FACES.items():
        np.testing.assert_allclose(planes[name].point_m, middle_m, atol=1e-12)
        np.testing.assert_allclose(planes[name].normal, axes[2], atol=1e-12)
    for row in rdb.load(root, "mat"):
        depth_m, is_steel = row["left_depth"], row["left_mask"]
        surfaces = [plane_and_face(row, name) for name in FACES]
        for name, (plane_m, is_face) in zip(FACES, surfaces, strict=True):
            inside = binary_erosion(is_face)
            assert (depth_m[inside] <= plane_m[inside] + 1e-4).all()
            shows = inside & (np.abs(depth_m - plane_m) <= 1e-4)
            seen[name] += int(shows.sum())
            assert not is_steel[shows].any()
            hidden = inside & ~shows & ~is_steel  # Only the other sheet, or its sides, is in front.
            assert hidden.sum() < 0.2 * inside.sum()
    assert min(seen.values()) > 300, seen
    report = audit(root, depth_views=1)
    assert report.failures == ()
    assert "mat: planes of formwork" in [check.name for check in report.checks if check.passed]


@pytest.mark.slow
def test_changed_planes_are_refused_or_fail_the_audit(root: Path, tmp_path: Path) -> None:
    def move(_: Any, entry: Any) -> None:
        entry["scenes"][0]["planes"][0]["point_m"][2] += 0.001

    copy = copy_dataset(root, tmp_path / "copy")
    change_manifest(copy, move, "mat")
    with pytest.raises(DatasetError, match=r"planes_digest: got .*, expected the digest of the planes"):
        open_folder(copy)
    assert run_in_process(rebar_bench, "verify", copy).returncode == 2
    change_manifest(copy, lambda _, entry: entry.update(planes_digest=planes_digest(entry["scenes"])), "mat")
    (failure,) = audit(copy, depth_views=0).failures
    assert failure.problems == ("no face of the mesh lies in plane base",)
    change_manifest(copy, lambda _, entry: entry["scenes"][0]["planes"][1].update(name="base"), "mat")
    with pytest.raises(DatasetError, match="planes: base occurs more than once"):
        open_folder(copy)
    change_manifest(copy, lambda _, entry: entry["scenes"][0]["planes"][1].update(name="form-2"), "mat")
    change_manifest(copy, lambda _, entry: entry.pop("planes_digest"), "mat")
    with pytest.raises(DatasetError, match="planes_digest: got None"):
        open_folder(copy)
    change_manifest(copy, lambda _, entry: entry["scenes"][0].pop("planes"), "mat")  # As folders without planes.
    assert open_folder(copy).config("mat").scene.planes == ()


@pytest.mark.slow
def test_finished_scene_keeps_its_forms(root: Path, tmp_path: Path) -> None:
    options = ("--out", root, "--views", "4", "--width", "240", "--height", "135", "--no-colour", "--dry-run")
    same, without = (
        run_in_process(main, *options, "--scene", write_scene(tmp_path, content, "mat.toml"))
        for content in (SCENE, MM + "board = false\n" + BARS + RING)
    )
    assert (same.returncode, without.returncode) == (0, 2), same.stderr
    assert "4 finished views would be lost: forms is" in without.stderr


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[0, 25, 26]", "[0, 25, 20]", r"form 'base', 0.021 m thick, extends down to z = -0.001.* higher"),
        ("[-190, 0, 90]", "[-250, 0, 290]", r"the sheet of form 'form-2' is 0.0\d* m from a camera of view \d"),
        ("[360, 300]", "[360, 3000]", r"form 'base' extends 1.5\d* m from the world's origin"),
        ("[360, 300]", "[3600, 300]\nalong = [0, 1, 0]", r"form 'base' extends 1.8\d* m"),
    ],
)
def test_misplaced_forms_are_refused(old: str, new: str, words: str, tmp_path: Path) -> None:
    content = f'environment = "laboratory"\n{SCENE.replace(old, new)}'
    with pytest.raises(InputError, match=words):
        scene_config(write_scene(tmp_path, content))


def test_scene_with_forms_has_no_board_and_no_panels(tmp_path: Path) -> None:
    path = write_scene(tmp_path, SCENE)
    assert scene_config(path).scene.board is None
    build = run_in_process(main, "--out", tmp_path / "root", "--scene", path, "--variant", "formwork", "--dry-run")
    assert build.returncode == 2
    assert "'formwork' adds panels" in build.stderr
    wall = "[[form]]\npoint = [0, 800, 400]\nnormal = [0, -1, 0]\nsize = [6000, 700]\n"
    survey = '[cameras]\nkind = "survey"\ndistances = [900]\nviews_per_distance = 6\n'
    cameras = scene_config(write_scene(tmp_path, MM + BARS + survey + wall)).protocol
    assert isinstance(cameras, SurveySpec)
    assert max(centre_m[1] for centre_m, _ in cameras.stations) < 0.8  # None is behind the wall.


@pytest.mark.slow
@pytest.mark.parametrize("family", ["wall", "beam", "slab", "joint"])
@pytest.mark.parametrize("environment", ["hall", "deck"])
def test_planes_of_panels_are_their_faces_towards_the_steel(family: str, environment: str) -> None:
    variants = ("formwork",) if family != "joint" else ()
    scene = SceneSpec("s", GeneratedCageSpec("train", 0, 7, family), None, environment, AppearanceSpec(variants))
    assembly = make_assembly(scene.assembly)
    props = make_props(assembly, scene)
    planes = {plane.name: plane for plane in form_planes(scene, props)}
    assert ("deck" in planes) == (environment == "deck")
    assert len(planes) >= 2 or family == "joint"
    for part in props:
        assert (part.plane is not None) == (part.material == "plywood")
        if part.plane is None:
            continue
        assert part.plane == planes[part.plane.name]
        body = trimesh.Trimesh(part.mesh.vertices_m, part.mesh.faces, process=False)
        in_plane = np.abs((body.triangles - part.plane.point_m) @ part.plane.normal).max(axis=1) < 1e-9
        assert (body.face_normals[in_plane] @ part.plane.normal > 1 - 1e-9).all()
        thickness_m = body.volume / body.area_faces[in_plane].sum()
        assert in_plane.sum() == 2
        assert thickness_m == pytest.approx(0.004 if part.name == "formwork-base" else 0.021)
        if part.name.startswith("formwork"):
            assert ((assembly.vertices_m - part.plane.point_m) @ part.plane.normal).min() > 0.01


def test_inspection_states_distances_and_bars_through_forms(tmp_path: Path) -> None:
    behind = "[[bar]]\ndiameter = 8\npoints = [[-200, 25, 4], [200, 25, 4]]\n"
    content = SCENE.replace("26]", "36]") + behind
    shown = run_in_process(main, "inspect", write_scene(tmp_path, content)).stdout
    assert "form base: steel 15.0 mm from it" in shown
    # The nearest end of the middle bar over the tilted face: of its axis, less what its end reaches.
    expected_m = (np.array([-0.15, 0, 0.056]) - [-0.19, 0, 0.09]) @ SIDE_NORMAL - 0.005 * SIDE_NORMAL[2]
    assert f"form form-2: steel {1000 * expected_m:.1f} mm from it" in shown
    upright = "[[bar]]\ndiameter = 8\npoints = [[0, 60, 20], [0, 60, 200]]\n"
    shown = run_in_process(main, "inspect", write_scene(tmp_path, content + upright)).stdout
    assert "form base: warning: a bar goes through it" in shown
