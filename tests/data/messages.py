"""Messages about rejected inputs of every kind, kept in ``messages.txt`` so that a change of wording is reviewed.

python -m tests.data.messages > tests/data/messages.txt
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from dataset_builder.catalog.named_configs import BuildRequest
from dataset_builder.user_files.cage_file import cage_file_spec, load_cage
from dataset_builder.user_files.scene_schema import read_scene_toml
from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.captures.calibration_files import read_calibration
from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.cli.demo import SAMPLE
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.geometry.calibrations import CONF
from tests.bench.submission.zips import DEPTH, EXPECTED, META, Record, build, npy, npz

SCENE = """
name = "lattice"
unit = "inch"
colour = "red"
mesh = "cage.stl"
board = 7
[cameras]
kind = "dome"
radii = [300, -1]
elevations_deg = []
azimuths = 5000
[[bar]]
diameter = "10"
points = [[0, 0, 0], [0, 1]]
id = 3
[[bar]]
diameter = 10
points = [[0, 0, 0], [0, 0, 9]]
bend_diameter = 5
id = 3
"""
BARS = """
unit = "mm"
[[bar]]
diameter = 10
points = [[-150, 0, 5], [150, 0, 5]]
[[bar]]
diameter = 10
points = [[150, 0, 5], [-150, 0, 5]]
[[bar]]
diameter = 900
points = [[0, 0, 5], [0, 9000000, 5]]
"""
CALIBRATION = """
width = 12
[left]
fx = "wide"
fy = 700
cx = 4000
cy = 360
distortion = [0, 0]
[right]
K = [[700, 0], [0, 700]]
[stereo]
rotation = [0, 0, 9]
translation_m = [0.12, 0, 0]
baseline_m = 0.12
"""
SUBMISSION = [
    Record(b"submission.json", b'{"method": 7, "url": "ftp://x", "uses_ground_truth": 1, "depth_scale": -1}'),
    Record(b"lattice/0000.npy", npy(DEPTH.astype(np.int32))),
    Record(b"lattice/0001.npy", npy(DEPTH)[:-4]),
    Record(b"lattice/0001.npz", npz(a=DEPTH, b=DEPTH)),
    Record(b"pile/0000.png", b"\x89PNG"),
    Record(b"pile/0009.npy", npy(DEPTH)),
    Record(b"../notes.txt", b"text"),
    Record(b"__MACOSX/._a", b"text"),
    Record(b"link.npy", b"/etc/passwd", mode=0o120777),
]


def rejected_inputs(folder: Path) -> Mapping[str, Callable[[], object]]:
    """Write invalid files below ``folder`` and return, by title, the calls that read and reject them."""
    files = {
        "cage.toml": BARS.encode(),
        "rig.toml": CALIBRATION.encode(),
        "rig.conf": CONF.replace("fx=700.5", "fx=none").replace("[STEREO]", "[OTHER]").encode(),
        "prediction.zip": build(SUBMISSION),
        "truncated.zip": build([META])[:-9],
        "nothing.zip": build([]),
        "capture/left/a.png": b"",
        "capture/right/b.png": b"",
    }
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    manifest = json.loads((SAMPLE / "manifest.json").read_bytes())
    entry = next(iter(manifest["configs"].values()))
    entry["views"][0]["steel_px"] = "many"
    entry["views"][1]["view_id"] = "../../evil"
    entry["scenes"][0]["board"]["markers"] = 7
    entry["scenes"][0]["mesh"] = "../mesh.ply"
    del entry["rig"]["width"]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    (folder / "later").mkdir()
    (folder / "later" / "manifest.json").write_text(json.dumps({"format": "rebar-depth-dataset-9"}))

    def submission(name: str) -> None:
        with SubmissionReader(folder / name, EXPECTED) as reader:
            raise InputError.from_problems(folder / name, list(reader.problems()))

    return {
        "scene file": lambda: read_scene_toml(SCENE.encode(), "beam.toml", ("lattice", "pile")),
        "scene file that is not TOML": lambda: read_scene_toml(b"unit = ", "beam.toml"),
        "bars of a scene file": lambda: load_cage(cage_file_spec(folder / "cage.toml")),
        "build options": lambda: BuildRequest(configs=("lattice",), views=0, width=9).config_specs(),
        "configs": lambda: BuildRequest(configs=("latice", "pier")).config_specs(),
        "TOML calibration": lambda: read_calibration(folder / "rig.toml", 1280, 720),
        "INI calibration": lambda: read_calibration(folder / "rig.conf", 1280, 720),
        "submission": lambda: submission("prediction.zip"),
        "truncated submission": lambda: submission("truncated.zip"),
        "empty submission": lambda: submission("nothing.zip"),
        "manifest": lambda: open_folder(folder),
        "manifest of another format": lambda: open_folder(folder / "later"),
        "capture": lambda: open_capture(folder / "capture"),
    }


def messages() -> Iterator[str]:
    """Yield, for each rejected input, its title, the error message, and the code and place of each problem."""
    with tempfile.TemporaryDirectory() as folder:
        for title, read in rejected_inputs(Path(folder)).items():
            try:
                read()
            except InputError as error:
                yield f"# {title}"
                yield from str(error).replace(folder + os.sep, "").replace(folder, "FOLDER").splitlines()
                yield from (f"{problem.code:10} {problem.where}" for problem in error.problems)
                yield ""
            else:
                raise AssertionError(f"{title}: was not rejected")


if __name__ == "__main__":
    print("\n".join(messages()), end="")
