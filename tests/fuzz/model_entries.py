"""Entry points that predict, with models, kept predictions and captures, and that submit to a leaderboard."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import onnx

from rebar_depth_bench.base.errors import MethodError
from rebar_depth_bench.cli.console import EXIT_DONE, EXIT_INPUT, EXIT_OTHER
from rebar_depth_bench.data.files import file_sha256
from rebar_depth_bench.methods import find_method
from tests.bench.captures.example_capture import write_capture
from tests.bench.methods.onnx_models import write_mixer_model, write_toml
from tests.fuzz.dataset_entries import CONFIG, ROOT, check_predictions, write_dataset, write_result
from tests.fuzz.workspace import CASE, OUT, EntryPoint, Workspace, bench

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
_SUBMISSION = {
    "id": "5f1c2a",
    "url": "http://127.0.0.1/submissions/5f1c2a",
    "method": "noisy-truth",
    "public": True,
    "created_at": "2026-01-31T12:00:00Z",
    "finished_at": None,
    "reason": None,
    "archive_bytes": 1234,
    "archive_kept": True,
    "result": None,
}
_TOKEN = {
    "name": "a",
    "quota": 10,
    "quota_left": 9,
    "quota_bytes": 1 << 40,
    "quota_bytes_left": 1 << 39,
    "max_upload_bytes": 1 << 30,
}


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
    (workspace.case / "answers").mkdir()
    (workspace.case / "my.token").write_text("secret\n")
    write_result(workspace, workspace.case / "answers" / "result.json")
    submission = _SUBMISSION | {"archive_sha256": file_sha256(workspace.case / "a.zip")}
    answers = {
        "token": _TOKEN,
        "accepted": submission | {"status": "queued"},
        "submission": submission | {"status": "scored"},
    }
    for name, answer in answers.items():
        (workspace.case / "answers" / f"{name}.json").write_text(json.dumps(answer))


class _Answers(BaseHTTPRequestHandler):
    """Handler that answers each request of the client with a file of the folder ``answers``."""

    def __init__(self, folder: Path, *arguments: object) -> None:
        self._folder = folder
        super().__init__(*arguments)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        name = self.path.rpartition("/")[2]
        self._send(200, {"token": "token", "result.json": "result"}.get(name, "submission"))

    def do_PUT(self) -> None:
        self.do_POST()

    def do_POST(self) -> None:
        if self.headers["Transfer-Encoding"] == "chunked":
            while size := int(self.rfile.readline(), 16):
                self.rfile.read(size + len("\r\n"))
        else:
            self.rfile.read(int(self.headers["Content-Length"]))
        self._send(202, "accepted")

    def log_message(self, *_: object) -> None:
        """Write no log."""

    def _send(self, status: int, name: str) -> None:
        content = (self._folder / f"{name}.json").read_bytes()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)


@contextmanager
def _answering_server(folder: Path) -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Answers, folder)) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def _submit(workspace: Workspace) -> None:
    token, output = workspace.case / "my.token", workspace.out / "r.json"
    with _answering_server(workspace.case / "answers") as url:
        options = ("--url", url, "--token-file", token, "--wait", "3", "--json", output)
        bench("submit", workspace.case / "a.zip", *options)


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
