"""Hostile and huge archives: refused with all problems, without a charge, a trace or much memory."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import re
import stat
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest

from leaderboard.scoring.isolation import ProcessEndedError, TimeLimitError, isolated_call
from rebar_depth_bench import load
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, Problem, SubmissionError
from tests.bench.submission.zips import Array, Record, build, deflated, npy, npy_header
from tests.ground_truth import truth_of
from tests.leaderboard.serving import API, RunServer, Server
from tests.processes import memory_bytes, num_open_files
from tests.requirements import Repetitions

CLIENTS = 4
MAX_MEMORY_BYTES = 300_000_000
REPOSITORY = Path(__file__).parents[2]
META = b'{"method": "hostile"}'


@dataclass(frozen=True)
class Payload:
    """Pickle payload that creates a file when it is loaded."""

    marker: Path

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self.marker,)


@dataclass(frozen=True)
class AttackedServer:
    """Server with a token, the depth of the views in metres by name, and the folder where all else may write."""

    server: Server
    token: str
    depths: dict[str, Array]
    folder: Path

    def records(self, meta: bytes = META) -> list[Record]:
        """Return the entries of a valid archive: the metadata and the two views."""
        views = [Record(f"{name}.npy".encode(), npy(depth_m)) for name, depth_m in self.depths.items()]
        return [Record(b"submission.json", meta), *views]

    def upload(self, archive: bytes) -> httpx2.Response:
        return self.server.call("POST", API, self.token, files={"archive": ("../../a.zip", archive)})

    def traces(self, root: Path) -> set[tuple[str, int]]:
        """Return what an archive may not change: all files but those of the leaderboard, and the dataset."""
        paths = [path for folder in (self.folder, root) for path in folder.rglob("*")]
        return {
            (str(path), path.stat().st_mtime_ns)
            for path in paths
            if path.is_file() and self.server.state not in path.parents
        }


@pytest.fixture(scope="module")
def attacked(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer
) -> Iterator[AttackedServer]:
    folder = tmp_path_factory.mktemp("siege")
    truth_of(tiny_root, "lattice-orbit")  # The cache is complete before.
    for name in ("cwd", "home", "tmp"):
        (folder / name).mkdir()
    rows = load(tiny_root, "lattice-orbit", columns=["view_id", "left_depth"])
    depths = {row["view_id"]: row["left_depth"] for row in rows}
    environment = {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(REPOSITORY)}
    with contextlib.ExitStack() as stack:
        with contextlib.chdir(folder / "cwd"):
            server = stack.enter_context(running_server(folder / "state", environment=environment, workers=2))
        yield AttackedServer(server, server.token("stranger"), depths, folder)


def hostile_archives(attacked: AttackedServer) -> dict[str, bytes]:
    """Return an archive of each kind that could harm a server; their reader has tests of its own."""
    records, marker = attacked.records(), attacked.folder / "unpickled"
    sound, second, depth_m = build(records), records[2].name, next(iter(attacked.depths.values()))
    header = "{{'descr': '<f4', 'fortran_order': False, 'shape': {}, }}"
    entries = {
        "bomb": deflated(second, bytes(50_000_000), level=1),
        "bomb of a true size": replace(deflated(second, bytes(50_000_000), level=1), size=len(npy(depth_m))),
        "forged size": Record(second, npy(depth_m), size=0x7FFFFFFF),
        "forged offset": Record(second, npy(depth_m), offset=0xFFFFFFFE),
        "nested": Record(second.replace(b"npy", b"npz"), sound),
        "pickle": Record(second, npy(np.array([Payload(marker)], dtype=object), allow_pickle=True)),
        "huge shape": Record(second, npy_header(header.format((400_000, 400_000)))),
        "code as a shape": Record(second, npy_header(header.format("__import__('os').abort()"))),
        "deep header": Record(second, npy_header("(" * 3000)),
        "absolute name": Record(f"{attacked.folder}/absolute.npy".encode(), npy(depth_m)),
        "climbing name": Record(("../" * 20 + f"{attacked.folder}/climbed.npy").encode(), npy(depth_m)),
        "name of escapes": Record("\x1b[31m\u202egnp<script>.npy".encode(), npy(depth_m)),
        "link": Record(second, str(attacked.folder).encode(), mode=stat.S_IFLNK | 0o777),
    }
    return {
        "empty": b"",
        "cut off": sound[:-30],
        "other bytes": sound[:-200] + bytes(100) + sound[-100:],
        "many": build([Record(b"%05d" % number) for number in range(1500)]),
        "unknown": build([*records, *(Record(b"%d.npy" % number, b"x") for number in range(23))]),
        "deep metadata": build(attacked.records(b"[" * 100_000)),
        "metadata of 5 MB": build(attacked.records(b'{"method": "%s"}' % (b"x" * 5_000_000))),
        **{name: build([*records[:2], entry]) for name, entry in entries.items()},
    }


def test_hostile_archives_are_refused_and_leave_nothing(
    attacked: AttackedServer, tiny_root: Path, tmp_path: Path
) -> None:
    archives, server = hostile_archives(attacked), attacked.server
    attacked.upload(b"")  # One-time allocations are done.
    quota = server.get("/api/v1/token", attacked.token).json()
    files, traces = num_open_files(server.process.pid), attacked.traces(tiny_root)
    with ThreadPoolExecutor(CLIENTS) as pool:
        responses = dict(zip(archives, pool.map(attacked.upload, archives.values()), strict=True))
    assert {name: response.status_code for name, response in responses.items()} == dict.fromkeys(archives, 422)
    places = (str(server.state), str(tiny_root), f"{REPOSITORY}/", sys.prefix)
    for name, response in responses.items():
        content = response.json()
        details = [str(Problem(**detail)) for detail in content["problem_details"]]
        assert 0 < len(details) <= MAX_PROBLEMS_SHOWN, name
        assert content["problems"][: len(details)] == details
        assert all(problem.isprintable() and len(problem) < 2000 for problem in content["problems"])
        assert not any(secret in response.text for secret in (*places, "Traceback", 'File "', ".upload")), name
    assert responses["unknown"].json()["problems"][MAX_PROBLEMS_SHOWN:] == ["... and 3 more"]
    assert server.get("/api/v1/token", attacked.token).json() == quota
    assert server.spool_files() == []
    assert [path.name for path in (server.state / "archives").iterdir()] == ["leaderboard-id"]
    assert attacked.traces(tiny_root) == traces
    assert num_open_files(server.process.pid) <= files + 2 * CLIENTS
    assert {json.loads(line)["level"] for line in server.log if line.startswith("{")} == {"info"}
    assert not any("Traceback" in line for line in server.log)
    pickle.loads(pickle.dumps(Payload(tmp_path / "ran")))
    assert (tmp_path / "ran").exists(), "the payload does nothing: the test shows too little"


def test_unusual_valid_archives_are_scored(attacked: AttackedServer) -> None:
    meta, *views = attacked.records()
    depth_m = next(iter(attacked.depths.values()))
    unusual_m = np.full(depth_m.shape, np.nan)
    unusual_m.flat[:4] = [np.inf, -1.0, 1e308, 5e-324]
    archives = [
        *(
            build([meta, *(replace(view, data=npy(one_m)) for view in views)])
            for one_m in (unusual_m, np.asfortranarray(depth_m), depth_m.astype(">f8"))
        ),
        build([meta, *views], comment=b"PK\5\6" * 100),
    ]
    for archive in archives:
        response = attacked.upload(archive)
        assert response.status_code == 202, response.text
        submission_id = response.json()["id"]
        assert attacked.server.wait_until_ended(submission_id)["status"] == "scored"
        result = attacked.server.get(f"{API}/{submission_id}/result.json")
        assert not re.search(b"NaN|Infinity", result.content), "the result is no JSON"
        page = attacked.server.get(f"/submissions/{submission_id}", headers={"Accept": "text/html"})
        assert page.status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "argument", "expected", "words"),
    [
        (os._exit, 3, ProcessEndedError, "exited with status 3"),
        (time.sleep, 60, TimeLimitError, None),
        (bytearray, 3 << 30, SubmissionError, "needs more memory than this service allows"),
    ],
)
def test_crash_time_and_memory_of_an_isolated_call_are_limited_to_it(
    function: Callable[[Any], object], argument: int, expected: type[Exception], words: str | None
) -> None:
    def call() -> None:
        with isolated_call(function, argument, memory=0, time_limit_s=8) as isolated:
            isolated.wait(20)
            isolated.value()

    with pytest.raises(expected, match=words):
        call()


def test_isolated_calls_that_end_while_others_start_return_their_values(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interval between the end of a process and the moment when all threads know its status is lengthened."""
    waitpid = os.waitpid

    def slow_waitpid(pid: int, flags: int) -> tuple[int, int]:
        time.sleep(0 if flags else 0.1)
        found = waitpid(pid, flags)
        time.sleep(0.3 if found[0] and flags else 0)
        return found

    def call(number: int) -> object:
        with isolated_call(abs, -number, memory=0, time_limit_s=60) as isolated:
            isolated.wait(60)
            return isolated.value()

    monkeypatch.setattr(os, "waitpid", slow_waitpid)
    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(call, range(8))) == list(range(8))


def test_large_upload_is_scored_and_the_server_needs_little_memory(
    attacked: AttackedServer, tmp_path: Path, repetitions: Repetitions
) -> None:
    """The archive has unused bytes before its entries."""
    path, unused_bytes = tmp_path / "large.zip", repetitions(600_000_000, 2_000_000_000)
    with path.open("wb") as file:
        file.seek(unused_bytes)
        with zipfile.ZipFile(file, "w") as archive:
            for record in attacked.records():
                archive.writestr(record.name.decode(), record.data)
    server = attacked.server
    with path.open("rb") as file:
        response = server.call("PUT", API, attacked.token, content=file)
    assert response.status_code == 202, response.text
    stored = server.state / "archives" / f"{response.json()['id']}.zip"
    assert stored.stat().st_size == path.stat().st_size > unused_bytes
    assert server.wait_until_ended(stored.stem)["status"] == "scored"
    assert memory_bytes(server.process.pid, "VmHWM") < MAX_MEMORY_BYTES
