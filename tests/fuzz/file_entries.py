"""Entry points that read one file: scenes, meshes, calibrations, depth maps, metadata, results and settings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from dataset_builder.scene.mesh_ply import write_mesh_ply
from dataset_builder.scene.model import WorldMesh
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage, mesh_file_spec
from leaderboard.settings import read_settings
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.captures.camera_files import read_cameras
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.scoring.reading import read_result
from rebar_depth_bench.submission.declaration import parse_metadata
from rebar_depth_bench.submission.entries import FORMATS
from tests.bench.captures import calibration_files as pair
from tests.bench.captures.example_capture import write_capture
from tests.bench.geometry.calibrations import CONF, CONF_OF_SIZES, TOML
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view
from tests.bench.submission.zips import exr, npy, npz, png
from tests.builder.catalog.scene_files import scene_config
from tests.builder.user_files.ifc_step_text import MILLIMETRES, Step
from tests.building import TWO_BARS
from tests.fuzz.workspace import CASE, EntryPoint, Workspace

EXAMPLES = Path(__file__).parents[2] / "examples"
DEPTH_M = np.linspace(0.5, 2.0, 12).reshape(3, 4).astype(np.float32)
_RODS = tuple(
    trimesh.creation.cylinder(diameter_m / 2, segment=[[0.0, y_m, 0.1], [0.5, y_m, 0.1]], sections=12)
    for diameter_m, y_m in ((0.016, 0.0), (0.010, 0.1), (0.020, 0.2))
)
_BOARD_AND_POSES = """
[board]
markers = 12
marker_side_m = 0.03
dictionary = "DICT_4X4_50"
[[pose]]
image = "0001"
cam_from_world = [[1, 0, 0, 0.1], [0, 0, -1, 0.2], [0, 1, 0, 0.5], [0, 0, 0, 1]]
[[pose]]
image = "0002"
cam_from_world = [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
"""
_METADATA = '{"method": "m", "runtime": {"s": [1, 2.5]}, "description": "d"}'
_SETTINGS = """
data = "dataset"
state_dir = "state"
db = "sqlite:///board.sqlite"
port = 8000
quota = 5
max_upload = "2GiB"
lease_seconds = 5
score_time = 60.5
score_memory = "4GiB"
rescore = true
"""


def _rods() -> trimesh.Trimesh:
    return trimesh.util.concatenate(_RODS)


def _ifc_of_solids() -> str:
    """Return a bar of two legs and a bend, each a solid, one along an endless line, and a curve that is cut."""
    step = Step(MILLIMETRES, "IFC4")
    vector = step.add(f"IFCVECTOR({step.direction((1, 0, 0))},2.)")
    endless = step.add(f"IFCLINE({step.point((0, 0, 0))},{vector})")
    bend = step.arc((500, 50, 0), 50.0, 1.5 * np.pi, 2 * np.pi)
    legs = [
        step.disc(endless, 6.0, 0.0, 250.0),
        step.disc(step.polyline((550, 300, 0), (550, 50, 0)), 6.0, "$", "$"),
    ]
    step.bar([*legs, step.disc(bend, 6.0, "$", "$")], 0.012, 0.82854)
    curve = step.composite(
        step.polyline((0, 0, 90), (100, 0, 90), (200, 0, 90)), step.polyline((200, 0, 90), (400, 0, 90))
    )
    step.bar([step.disc(curve, 6.0, 0.0, 2.0)], 0.012, 0.4)
    return step.text()


def _dataset_ply(path: Path) -> None:
    bar_id = np.repeat(range(1, len(_RODS) + 1), [len(rod.faces) for rod in _RODS])
    write_mesh_ply(path, WorldMesh(np.asarray(_rods().vertices), np.asarray(_rods().faces), bar_id))


def _read_mesh(path: Path) -> object:
    return [(bar.bar_id, bar.diameter_m, bar.axis_m) for bar in load_cage(mesh_file_spec(path, "m")).bars]


def _read_cage(path: Path) -> object:
    return [(bar.bar_id, bar.diameter_m, bar.axis_m) for bar in load_cage(cage_file_spec(path)).bars]


def is_finite(value: object) -> bool:
    """Return whether all numbers in nested tuples are finite."""
    if isinstance(value, tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float) or bool(np.isfinite(value))


def _read_calibration(path: Path) -> object:
    calibration = read_calibration(path, 1280, 720)
    assert is_finite(astuple(calibration))
    return calibration


def _read_cameras(path: Path) -> object:
    cameras = read_cameras(path.parent, ["0001", "0002"], pair.WIDTH, pair.HEIGHT, is_stereo=True)
    assert is_finite(astuple(cameras.calibration))
    assert all(np.isfinite(pose).all() for pose in cameras.cam_from_world.values())
    return cameras


def _write_opencv(path: Path) -> None:
    pair.write_opencv(path.parent, path.suffix[1:])
    (path.parent / f"stereo{path.suffix}").rename(path)


def _write_ros(path: Path) -> None:
    """Write ``camera_info`` of a pair as it is printed; that of the left camera is ``path``."""
    for name, text in pair.ros_texts(as_message=True).items():
        path.with_name(name).write_text(text)


def _write_capture_image(path: Path, exif: bytes = b"") -> None:
    """Write a capture of one pair, whose right image is ``path``."""
    root = write_capture(path.parents[1], 1)
    (root / "right" / "000000.png").unlink()
    Image.new("L", (64, 36)).save(path, exif=exif)


def _open_capture(path: Path) -> object:
    views = open_capture(path.parents[1]).expected_views()
    assert views == {"capture/000000": (36, 64)}
    return views


def _decode_depth(path: Path) -> object:
    depth = FORMATS[path.suffix].decode(path.name, memoryview(path.read_bytes()), (3, 4), 0.001)
    assert depth.shape == (3, 4)
    return depth.tolist()


def _parse_metadata(path: Path) -> object:
    metadata, problems = parse_metadata(path.read_bytes())
    assert (metadata is None) == bool(problems)
    if problems:
        raise InputError.from_problems(path, problems)
    return metadata


def _read_result(path: Path) -> object:
    again = read_result(path.read_bytes(), path.name).to_json()
    assert read_result(again, path.name).to_json() == again
    return again


def _write_result(path: Path) -> None:
    views = scored_view("lattice/0000"), unpredicted_view("lattice/0001"), overflowed_view("pile/0000")
    path.write_bytes(result(*views).to_json())


def _copy(source: Path, path: Path) -> None:
    path.write_bytes(source.read_bytes())


def _text(content: str, path: Path) -> None:
    path.write_text(content)


def file_entry(
    title: str,
    file: str,
    write: Callable[[Path], object],
    read: Callable[[Path], object],
    *,
    share: int = 2,
    is_quick: bool = True,
    cpu_s: float = 1.0,
    shows_truncation: bool = False,
    special_files: bool = True,
    names: Sequence[str] = (),
) -> EntryPoint:
    """Return the entry point of a reader of one file; its result is what the reader returns."""

    def run(workspace: Workspace) -> None:
        (workspace.out / "result").write_text(repr(read(workspace.case / file)))

    return EntryPoint(
        title,
        share,
        prepare=lambda workspace: write(workspace.case / file),
        run=run,
        targets=(f"{CASE}/{file}",),
        result=lambda workspace: (workspace.out / "result").read_bytes(),
        is_quick=is_quick,
        cpu_s=cpu_s,
        shows_truncation=shows_truncation,
        special_files=special_files,
        names=names,
    )


_mesh = partial(file_entry, read=_read_mesh, share=4, shows_truncation=True)
_calibration = partial(file_entry, read=_read_calibration, share=8)
_cameras = partial(file_entry, read=_read_cameras)
_picture = partial(file_entry, write=_write_capture_image, read=_open_capture)
_UPRIGHT = partial(_write_capture_image, exif=b"II*\0\x08\0\0\0\1\0\x12\1\3\0\1\0\0\0\1\0\0\0\0\0\0\0")
_slow = partial(file_entry, is_quick=False, cpu_s=10.0)
_ifc = partial(_slow, read=_read_cage, shows_truncation=True)
_content = partial(file_entry, special_files=False)
_depth = partial(_content, read=_decode_depth)
FILE_ENTRIES = (
    file_entry("scene TOML", "scene.toml", partial(_copy, TWO_BARS), scene_config, share=8),
    _slow("scene TOML: beam", "beam.toml", partial(_copy, EXAMPLES / "beam.toml"), scene_config),
    _ifc("IFC", "c.ifc", partial(_copy, EXAMPLES / "column.ifc"), share=5),
    _ifc("IFC: solids of a bar", "c.ifc", lambda path: path.write_text(_ifc_of_solids())),
    _mesh("mesh: dataset PLY", "a.ply", _dataset_ply),
    _mesh("mesh: binary PLY", "a.ply", lambda path: _rods().export(path)),
    _mesh("mesh: ASCII PLY", "a.ply", lambda path: _rods().export(path, encoding="ascii"), share=6),
    _mesh("mesh: binary STL", "a.stl", lambda path: _rods().export(path)),
    _mesh("mesh: ASCII STL", "a.stl", lambda path: _rods().export(path, file_type="stl_ascii")),
    # A truncated OBJ file is a shorter OBJ file.
    _mesh("mesh: OBJ", "a.obj", lambda path: _rods().export(path), shows_truncation=False),
    _calibration("calibration: TOML", "rig.toml", partial(_text, TOML)),
    _calibration("calibration: conf", "SN1.conf", partial(_text, CONF)),
    _calibration("calibration: conf of sizes", "SN2.conf", partial(_text, CONF_OF_SIZES)),
    _cameras("cameras: TOML", "cameras.toml", partial(_text, pair.TOML + _BOARD_AND_POSES)),
    _cameras("cameras: OpenCV YAML", "a.yml", _write_opencv),
    _cameras("cameras: OpenCV XML", "a.xml", _write_opencv),
    _cameras("cameras: OpenCV JSON", "a.json", _write_opencv),
    _cameras("cameras: YAML with aliases", "a.yaml", partial(_text, pair.aliased_text())),
    _cameras("cameras: ROS", "left.yaml", _write_ros),
    _picture("capture: PNG", "capture/right/000000.png"),
    _picture("capture: JPEG", "capture/right/000000.jpg"),
    _picture("capture: PNG with EXIF", "capture/right/000000.png", write=_UPRIGHT),
    _picture("capture: JPEG with EXIF", "capture/right/000000.jpg", write=_UPRIGHT),
    _depth("depth: npy", "a.npy", lambda path: path.write_bytes(npy(DEPTH_M))),
    _depth("depth: npz", "a.npz", lambda path: path.write_bytes(npz(depth=DEPTH_M))),
    _depth("depth: EXR", "a.exr", lambda path: exr(path, {"Z": DEPTH_M})),
    _depth("depth: PNG", "a.png", lambda path: path.write_bytes(png(DEPTH_M * 1000.0))),
    _content("archive metadata", "submission.json", partial(_text, _METADATA), _parse_metadata),
    _content("result JSON", "r.json", _write_result, _read_result, share=6),
    file_entry(
        "leaderboard settings",
        "s.toml",
        partial(_text, _SETTINGS),
        lambda path: read_settings(path, {}),
        share=4,
        names=("settings: ",),
    ),
)
