"""``rebar-bench predict`` on images that are no dataset folder: refusals, and notices on the cameras."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("cv2")

from rebar_depth_bench.cli.main import main
from rebar_depth_bench.submission import SubmissionReader
from tests.bench.captures import calibration_files as files
from tests.bench.captures.example_capture import write_capture
from tests.bench.captures.test_cameras_toml import write_images

ERROR = 2


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
    method: str, options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = write_capture(tmp_path / "zed", views=1)
    assert predict(root, tmp_path / "a.zip", *options, method=method) == ERROR
    assert message in " ".join(capsys.readouterr().err.split())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["zed"]


@pytest.mark.parametrize("name", ["absent", "empty", "pictures"])
def test_other_folder_is_refused(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    write_images(tmp_path, "pictures")
    assert predict(tmp_path / name, tmp_path / "a.zip") == ERROR
    assert name in capsys.readouterr().err


def test_folder_of_images_with_a_calibration_of_another_program_is_a_capture(tmp_path: Path) -> None:
    write_images(tmp_path, "pictures")
    camera = files.ros_texts(as_message=False)["left.yaml"]
    (tmp_path / "pictures" / "camera.yaml").write_text(camera)
    assert predict(tmp_path / "pictures", tmp_path / "a.zip", method="constant") == 0


def test_control_without_images_is_on_the_grid_of_the_images(tmp_path: Path) -> None:
    root = write_capture(tmp_path / "zed", views=1)
    assert predict(root, tmp_path / "a.zip", method="constant") == 0
    with SubmissionReader(tmp_path / "a.zip", {"zed/000000": (36, 64)}) as reader:
        assert (reader.read("zed/000000") == 1).all()


@pytest.mark.slow
def test_camera_and_grid_are_stated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_capture(tmp_path / "zed", views=2)
    assert predict(root, tmp_path / "a.zip") == 0
    printed = capsys.readouterr()
    assert printed.out == f"{tmp_path / 'a.zip'}\n"
    assert "zed: 2 views of" in printed.err
    assert "baseline 119.98 mm" in printed.err
    assert "not of rectified ones" in printed.err
    (root / "left" / "000001.png").write_bytes(b"")
    assert predict(root, tmp_path / "b.zip") == ERROR
    assert "left/000001.png" in capsys.readouterr().err
