"""Entry points that predict, with models, kept predictions and captures, and that submit to a leaderboard."""

from __future__ import annotations

import json

import onnx

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.console import EXIT_DONE, EXIT_INPUT, EXIT_OTHER
from rebar_depth_bench.methods import find_method
from tests.bench.captures.example_capture import write_capture
from tests.bench.methods.onnx_models import write_mixer_model, write_toml
from tests.fuzz.dataset_entries import CONFIG, ROOT, check_predictions, write_dataset, write_result
from tests.fuzz.workspace import CASE, OUT, EntryPoint, Workspace, bench
from tests.leaderboard.scripted_server import TOKEN_INFO, answer, scripted_server, submission

_STOPPING_METHOD = """
from pathlib import Path
import numpy as np
from rebar_depth_bench.methods import Method, MethodInfo

def predict(row):
    if row["view_id"].endswith("0000") or not Path(__file__).with_name("stop").exists():
        return np.full(row["left_rgb"].shape[:2], 0.5, np.float32)
    raise RuntimeError("stopped")

METHOD = Method(MethodInfo("stopping", "stops", ("view_id", "left_rgb"), False, "here", "MIT"), lambda: predict)
"""


def _predict(workspace: Workspace, method: str) -> None:
    data = ("--data", workspace.root / ROOT, "--config", CONFIG)
    bench("predict", method, *data, "--out", workspace.out / "p.zip")


def _predict_capture(workspace: Workspace) -> None:
    bench("predict", "sgbm", "--data", workspace.case / "zed", "--out", workspace.out / "a.zip")


def _write_model(workspace: Workspace) -> None:
    write_dataset(workspace)
    folder = workspace.case / "model"
    folder.mkdir()
    path = write_mixer_model(folder, offset=1.0)
    onnx.save(onnx.load(path), path, save_as_external_data=True, location="weights.bin", size_threshold=0)
    write_toml(folder)


def _write_kept_predictions(workspace: Workspace) -> None:
    write_dataset(workspace)
    (workspace.case / "method.py").write_text(_STOPPING_METHOD)
    (workspace.case / "stop").touch()
    try:
        _resume(workspace)
    except MethodError:
        (workspace.case / "stop").unlink()


def _resume(workspace: Workspace) -> None:
    _predict(workspace, f"{workspace.case / 'method.py'}:METHOD")


def _write_checkpoint(workspace: Workspace) -> None:
    folder = workspace.case / "checkpoint"
    folder.mkdir()
    config = {"model_type": "depth_anything", "depth_estimation_type": "metric", "max_depth": 20, "fusion": [1, 2]}
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "preprocessor_config.json").write_text(json.dumps({"size": {"height": 14, "width": 14}}))
    (folder / "model.safetensors").write_bytes(bytes(64))


def _write_answers(workspace: Workspace) -> None:
    """Write the content of the answer of each endpoint of the leaderboard."""
    folder, archive = workspace.case / "answers", workspace.case / "a.zip"
    folder.mkdir()
    (workspace.case / "my.token").write_text("secret\n")
    write_result(workspace, folder / "result.json")
    answers = {"token": TOKEN_INFO, "submit": submission(archive), "status": submission(archive, status="scored")}
    for endpoint, content in answers.items():
        (folder / f"{endpoint}.json").write_text(json.dumps(content))


def _submit(workspace: Workspace) -> None:
    with scripted_server() as server:
        folder = workspace.case / "answers"
        server.answers = {path.stem: [answer(path.read_bytes())] for path in folder.iterdir()}
        options = ("--token-file", workspace.case / "my.token", "--wait", "3", "--json", workspace.out / "r.json")
        bench("submit", workspace.case / "a.zip", "--url", server.url, *options)


MODEL_ENTRIES = (
    EntryPoint(
        "predict: capture",
        8,
        lambda workspace: write_capture(workspace.case / "zed", 2),
        _predict_capture,
        (f"{CASE}/zed/**/*",),
        kept_outputs=(".a.zip.views*",),
    ),
    EntryPoint(
        "predict: ONNX",
        8,
        _write_model,
        lambda workspace: _predict(workspace, str(workspace.case / "model" / "tiny.toml")),
        (f"{CASE}/model/*",),
        check=check_predictions,
        kept_outputs=(".p.zip.views*",),
    ),
    EntryPoint(
        "predict: kept predictions",
        8,
        _write_kept_predictions,
        _resume,
        (f"{OUT}/.p.zip.views/**/*",),
        check=check_predictions,
        kept_outputs=(".p.zip.views*",),
    ),
    EntryPoint(
        "predict: checkpoint",
        5,
        _write_checkpoint,
        lambda workspace: find_method(f"hf:{workspace.case / 'checkpoint'}"),
        (f"{CASE}/checkpoint/*",),
    ),
    EntryPoint(
        "submit: answers",
        10,
        _write_answers,
        _submit,
        (f"{CASE}/answers/*.json",),
        special_files=False,
        statuses=(EXIT_DONE, EXIT_OTHER, EXIT_INPUT),
        names=("http://127.0.0.1",),
    ),
    EntryPoint(  # A token may come from the user's own pipe, which is waited for.
        "submit: token file", 2, _write_answers, _submit, (f"{CASE}/my.token",), special_files=False
    ),
)
