"""``rebar-bench predict`` on captures: refusals, notices on the cameras, and the depth of a dataset's views."""

from __future__ import annotations

import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from rebar_depth_bench.captures.views import open_capture
from rebar_depth_bench.cli.main import main
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.geometry.aruco_board import BoardSpec
from rebar_depth_bench.methods.run import dataset_views
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.captures import calibration_files as files
from tests.bench.captures.example_capture import write_capture, write_images

ERROR = 2


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "zed", views=2)


def predict(root: Path, archive: Path, *options: str, method: str = "sgbm") -> int:
    return main(["predict", method, "--data", str(root), "--out", str(archive), *options])


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("noisy-truth", (), "needs left_depth"),
        ("truth", (), "needs left_depth"),
        ("sweep-anchored", (), "needs left_depth, left_mask"),
        ("sgbm", ("--config", "lattice"), "--config is given, which is for dataset folders only"),
        ("sgbm", ("--split", "test"), "--split is given"),
        ("sgbm", ("--expect-digest", "sha256:" + "0" * 64), "--expect-digest is given"),
    ],
)
def test_request_that_captures_cannot_serve_is_refused(
    method: str, options: tuple[str, ...], message: str, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert predict(root, root.parent / "a.zip", *options, method=method) == ERROR
    assert message in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in root.parent.iterdir()) == ["zed"]


def test_folder_of_images_is_a_capture_if_it_has_a_calibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    write_images(tmp_path, "pictures")
    for name in ("absent", "empty", "pictures"):
        assert predict(tmp_path / name, tmp_path / "a.zip", method="constant") == ERROR
        assert name in capsys.readouterr().err
    (tmp_path / "pictures" / "camera.yaml").write_text(files.ros_texts(as_message=False)["left.yaml"])
    assert predict(tmp_path / "pictures", tmp_path / "a.zip", method="constant") == 0


def test_control_without_images_is_on_the_grid_of_the_images(root: Path, tmp_path: Path) -> None:
    assert predict(root, tmp_path / "a.zip", method="constant") == 0
    with SubmissionReader(tmp_path / "a.zip", {f"zed/{view:06d}": (36, 64) for view in range(2)}) as reader:
        assert (reader.read("zed/000000") == 1).all()


@pytest.mark.slow
def test_camera_and_grid_are_stated(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert predict(root, tmp_path / "a.zip") == 0
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / 'a.zip'}\n"
    assert "zed: 2 views of" in printed.err
    assert "baseline 119.98 mm" in printed.err
    assert "not of rectified ones" in printed.err
    (root / "left" / "000001.png").write_bytes(b"")
    assert predict(root, tmp_path / "b.zip") == ERROR
    assert "left/000001.png" in capsys.readouterr().err


def archive_depths(path: Path) -> list[bytes]:
    with zipfile.ZipFile(path) as archive:
        return [archive.read(name) for name in sorted(archive.namelist()) if name != "submission.json"]


def camera_lines(row: dict[str, Any], eye: str) -> list[str]:
    """Return a camera of ``cameras.toml``; the repr of a float is read back to the same number."""
    (fx, _, cx), (_, fy, cy), _ = row[f"{eye}_K"].tolist()
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": row[f"{eye}_distortion"].tolist()}
    return [f"[{eye}]", *(f"{key} = {value!r}" for key, value in numbers.items())]


def write_as_capture(rows: list[dict[str, Any]], root: Path) -> Path:
    """Write the parallel pairs of a dataset, their cameras and the board, and return the folder."""
    for row in rows:
        for eye in ("left", "right"):
            (root / eye).mkdir(parents=True, exist_ok=True)
            Image.fromarray(row[f"{eye}_rgb"]).save(root / eye / f"{row['view_id'].partition('/')[2]}.png")
    stereo = ["[stereo]", "rotation = [0, 0, 0]", f"baseline_m = {float(rows[0]['baseline_m'])!r}"]
    values = {**asdict(BoardSpec()), "dictionary": f'"{BoardSpec.dictionary}"'}
    board = ["[board]", *(f"{key} = {value}" for key, value in values.items())]
    lines = [*camera_lines(rows[0], "left"), *camera_lines(rows[0], "right"), *stereo, *board]
    (root / "cameras.toml").write_text("\n".join(lines))
    return root


@pytest.mark.slow
def test_views_of_a_dataset_are_read_and_predicted_as_in_the_dataset(tiny_root: Path, tmp_path: Path) -> None:
    stereo = [f"{eye}_{name}" for name in ("rgb", "K", "distortion") for eye in ("left", "right")]
    columns = [*stereo, "baseline_m"]
    [dataset] = dataset_views(open_folder(tiny_root), ["lattice"], "test")
    rows = [{**row} for row in dataset.rows(*columns)]
    capture = write_as_capture(rows, tmp_path / "lattice")
    views = open_capture(capture)
    assert not views.has_poses
    assert not views.board_is_assumed
    for one, other in zip(views.rows(*columns), rows, strict=True):
        assert one["view_id"] == other["view_id"]
        for name in columns:
            assert np.array_equal(one[name], other[name]), (one["view_id"], name)

    of_dataset, of_capture = tmp_path / "dataset.zip", tmp_path / "capture.zip"
    assert predict(tiny_root, of_dataset, "--config", "lattice") == 0
    assert predict(capture, of_capture) == 0
    assert archive_depths(of_dataset) == archive_depths(of_capture)
    assert len(set(archive_depths(of_dataset))) == len(rows) == 9
    assert main(["score", str(of_capture), "--data", str(tiny_root)]) == 0
