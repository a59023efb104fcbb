"""Hostile and huge archives: readable rejections, no files written elsewhere and bounded memory."""

from __future__ import annotations

import contextlib
import json
import pickle
import stat
import struct
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import httpx2
import numpy as np
import pytest

from leaderboard.settings import read_settings
from rebar_depth_bench import load
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, Problem
from tests.bench.submission.zips import Array, Record, build, deflated, npy, npy_header
from tests.ground_truth import truth_of
from tests.leaderboard.serving import API, END, ENDED, MULTIPART, RunServer, Server, bearer, multipart_part
from tests.processes import children, descendants, memory_bytes, num_open_files
from tests.requirements import Repetitions

CLIENTS = 4
NUM_WARM_UP = 16
"""Number of archives after which one-time allocations of the server are done."""
MAX_GROWTH_BYTES = 24 << 20
"""Bound on memory growth over all archives."""
MAX_MEMORY_BYTES = 300_000_000
REPOSITORY = Path(__file__).parents[2]

Listing = Mapping[str, tuple[int, int]]


META = b'{"method": "hostile"}'


@dataclass(frozen=True)
class ValidArchive:
    """Valid archive to be damaged: true depth in metres by view id, and a folder that must stay empty."""

    depths: Mapping[str, Array]
    forbidden: Path

    @property
    def names(self) -> list[str]:
        return sorted(self.depths)

    def records(self, meta: bytes = META) -> list[Record]:
        """Return the entries of the archive: the metadata and the views."""
        views = [Record(f"{name}.npy".encode(), npy(self.depths[name])) for name in self.names]
        return [Record(b"submission.json", meta), *views]

    @property
    def depth_m(self) -> Array:
        return self.depths[self.names[0]]


class Payload:
    """Pickle payload that creates a file when it is loaded."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (self._marker,)


def hostile_archives(valid: ValidArchive) -> dict[str, bytes]:
    """Return malformed and malicious archives by what they are: the server must reject each.

    The readers of archives have tests and fuzz cases of their own.
    """
    sound, depth_m, marker = build(valid.records()), valid.depth_m, valid.forbidden / "unpickled"
    first, second = (f"{name}.npy".encode() for name in valid.names)
    header = "{{'descr': '{}', 'fortran_order': False, 'shape': {}, }}"
    bomb = deflated(second, bytes(50_000_000), level=1)
    pickled = pickle.dumps(Payload(marker))
    entries = {
        "bomb": bomb,
        "bomb of a true size": replace(bomb, size=len(npy(depth_m))),
        "encrypted": Record(second, npy(depth_m), flags=1),
        "forged size": Record(second, npy(depth_m), size=0x7FFFFFFF),
        "forged offset": Record(second, npy(depth_m), offset=0xFFFFFFFE),
        "forged checksum": Record(second, npy(depth_m), crc=1),
        "nested": Record(second.replace(b"npy", b"npz"), sound),
        "pickle": Record(second, pickled),
        "pickle in npy": Record(second, npy(np.array([Payload(marker)], dtype=object), allow_pickle=True)),
        "pickle under a header": Record(second, npy_header(header.format("|O", depth_m.shape)) + pickled),
        "huge shape": Record(second, npy_header(header.format("<f4", (400_000, 400_000)))),
        "code as a shape": Record(second, npy_header(header.format("<f4", "__import__('os').abort()"))),
        "deep header": Record(second, npy_header("(" * 3000)),
        "integers": Record(second, npy(depth_m.astype("i4"))),
        "other shape": Record(second, npy(depth_m.T)),
        **{
            f"named {name[:20]!r}": Record(name.encode(), npy(depth_m))
            for name in (
                *(f"{valid.forbidden}/absolute.npy", "../" * 20 + f"{valid.forbidden}/climbed.npy", "..\\up.npy"),
                *("a\0b.npy", "\x1b[31m.npy", "\u202egnp.npy", "x" * 60_000, "", "<script>alert(1)</script>"),
            )
        },
        **{
            f"a {kind:#o}": Record(second, str(valid.forbidden).encode(), mode=kind | 0o777)
            for kind in (stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFIFO)
        },
    }
    metadata = {
        "deep metadata": b"[" * 100_000,
        "no metadata": b"",
        "metadata of a surrogate": b'{"method": "\\ud800"}',
        "metadata of a long number": b'{"method": "m", "x": ' + b"9" * 5000 + b"}",
        "metadata of a script": b'{"method": "m", "url": "javascript:alert(1)"}',
        "metadata of 5 MB": json.dumps({"method": "m", "description": "x" * 5_000_000}).encode(),
    }
    return {
        "empty": b"",
        "no zip": b"<html>" * 100,
        "cut off": sound[:-30],
        "cut out": sound[:5000] + sound[6000:],
        "other bytes": sound[:-200] + bytes(100) + sound[-100:],
        "twice": build([*valid.records(), Record(first, npy(depth_m))]),
        "many": build([Record(b"%05d" % number) for number in range(1500)]),
        "many declared": build(valid.records(), count=65_535),
        **{name: build([*valid.records()[:2], entry]) for name, entry in entries.items()},
        **{name: build(valid.records(meta)) for name, meta in metadata.items()},
    }


def unusual_valid_archives(valid: ValidArchive) -> Sequence[bytes]:
    """Return unusual but valid archives: each must be accepted and scored."""
    unusual_m = np.full(valid.depth_m.shape, np.nan)
    unusual_m.flat[:4] = [np.inf, -1.0, 1e308, 5e-324]
    first, *views = valid.records()
    return [
        *(
            build([first, *(replace(one, data=npy(depths_m)) for one in views)])
            for depths_m in (unusual_m, np.asfortranarray(valid.depth_m), valid.depth_m.astype(">f8"))
        ),
        build(valid.records(json.dumps({"method": "x", "description": "x" * 1_000_000}).encode())),
        build(valid.records(), comment=b"PK\5\6" * 100),
    ]


@dataclass(frozen=True)
class Footprint:
    """Memory and open files of the server process and of its children, which check and score."""

    server_bytes: int
    children_bytes: int
    files: int


@dataclass(frozen=True)
class AttackResult:
    """All responses by kind, and memory and file listings before and after."""

    server: Server
    answers: Sequence[tuple[str, httpx2.Response]]
    sound: Sequence[httpx2.Response]
    ended: Mapping[str, dict[str, Any]]
    footprints: tuple[Footprint, Footprint]
    listings: tuple[Listing, Listing]
    forbidden: Path


@pytest.fixture(scope="module")
def attack(
    tiny_root: Path, tmp_path_factory: pytest.TempPathFactory, running_server: RunServer, repetitions: Repetitions
) -> Iterator[AttackResult]:
    folder = tmp_path_factory.mktemp("siege")
    truth_of(tiny_root, "lattice-orbit")  # The attack finds the cache complete.
    state = folder / "state"
    for name in ("cwd", "home", "tmp", "forbidden"):
        (folder / name).mkdir()
    rows = load(tiny_root, "lattice-orbit", columns=["view_id", "left_depth"])
    valid = ValidArchive({row["view_id"]: row["left_depth"] for row in rows}, folder / "forbidden")
    archives = [*hostile_archives(valid).items()] * repetitions(1, 20)
    environment = {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(REPOSITORY)}
    with contextlib.ExitStack() as stack:
        with contextlib.chdir(folder / "cwd"):
            started = running_server(state, environment=environment, workers=2, quota=10**6)
            server = stack.enter_context(started)
        first_listing = listing([folder, tiny_root], state)
        token = server.token("stranger")
        answers = upload_concurrently(server, token, archives[:NUM_WARM_UP])
        settled_footprint = footprint(server)
        answers += upload_concurrently(server, token, archives[NUM_WARM_UP:])
        footprints = settled_footprint, footprint(server)
        unusual = [("sound", data) for data in unusual_valid_archives(valid)]
        sound = [response for _, response in upload_concurrently(server, token, unusual)]
        responses = [*sound, *(response for _, response in answers)]
        accepted = [response.json()["id"] for response in responses if response.status_code == 202]
        ended = {submission_id: server.wait_until_ended(submission_id) for submission_id in accepted}
        listings = first_listing, listing([folder, tiny_root], state)
        yield AttackResult(server, answers, sound, ended, footprints, listings, valid.forbidden)


def upload_concurrently(
    server: Server, token: str, archives: Sequence[tuple[str, bytes]]
) -> list[tuple[str, httpx2.Response]]:
    """Upload archives from several clients concurrently; return the kind and the response of each."""
    with httpx2.Client(headers=bearer(token), timeout=120) as client, ThreadPoolExecutor(CLIENTS) as pool:

        def upload(archive: tuple[str, bytes]) -> tuple[str, httpx2.Response]:
            files = {"archive": ("../../a.zip", archive[1])}
            return archive[0], client.post(server.url + API, files=files)

        return list(pool.map(upload, archives))


def footprint(server: Server) -> Footprint:
    started = children(server.process.pid)
    return Footprint(
        memory_bytes(server.process.pid),
        sum(map(memory_bytes, started)),
        sum(map(num_open_files, [server.process.pid, *started])),
    )


def listing(folders: Sequence[Path], excluded: Path) -> Listing:
    """Return size and modification time of everything in ``folders`` except below ``excluded``."""
    paths = (path for folder in folders for path in folder.rglob("*") if excluded not in (path, *path.parents))
    return {str(path): _size_and_mtime_ns(path) for path in paths}


def _size_and_mtime_ns(path: Path) -> tuple[int, int]:
    return (path.stat().st_size, path.stat().st_mtime_ns) if path.is_file() else (0, 0)


def test_hostile_archives_are_rejected_without_server_error(attack: AttackResult) -> None:
    assert {(kind, response.status_code) for kind, response in attack.answers} == {
        (kind, 422) for kind, _ in attack.answers
    }
    lines = [json.loads(line) for line in attack.server.log if line.startswith("{")]
    assert {line["level"] for line in lines} == {"info"}
    assert not any("Traceback" in line for line in attack.server.log)
    assert attack.server.get("/healthz").json()["status"] == "ok"


def test_rejections_list_readable_problems_without_secrets(attack: AttackResult, tiny_root: Path) -> None:
    folders = (str(attack.server.state), str(tiny_root), str(REPOSITORY), sys.prefix)
    secrets = (*folders, "Traceback", 'File "', ".upload")
    for kind, response in attack.answers:
        if response.status_code == 422:
            content = response.json()
            assert set(content) == {"detail", "problems", "problem_details"}
            assert content["problems"], kind
            assert all(
                isinstance(problem, str) and problem.isprintable() and 10 < len(problem) < 2000
                for problem in content["problems"]
            )
            details = [str(Problem(**detail)) for detail in content["problem_details"]]
            assert details == content["problems"][:MAX_PROBLEMS_SHOWN]
            assert "problem" in content["detail"]
            assert not any(secret in response.text for secret in secrets), response.text


def test_unusual_valid_archives_are_scored(attack: AttackResult) -> None:
    assert [response.status_code for response in attack.sound] == [202] * len(attack.sound)
    for submission_id, submission in attack.ended.items():
        assert submission["status"] in ENDED
        assert (submission["status"] == "failed") == bool(submission["reason"])
        if submission["status"] == "scored":
            result = attack.server.get(f"{API}/{submission_id}/result.json")
            json.loads(result.content, parse_constant=reject_constant)
        page = attack.server.get(f"/submissions/{submission_id}", headers={"Accept": "text/html"})
        assert page.status_code == 200
    assert all(attack.ended[response.json()["id"]]["status"] == "scored" for response in attack.sound)


def reject_constant(constant: str) -> NoReturn:
    raise AssertionError(f"the result holds {constant}, which is no JSON")


def test_only_accepted_archives_are_stored(attack: AttackResult) -> None:
    state = attack.server.state
    assert {path.stem for path in (state / "archives").iterdir()} == set(attack.ended)
    database = {f"leaderboard.sqlite{suffix}" for suffix in ("", "-wal", "-shm")}
    assert {path.name for path in state.iterdir()} <= {"archives", "spool", *database}
    assert attack.server.spool_files() == []


def test_no_file_is_written_elsewhere_and_no_pickle_runs(attack: AttackResult, tmp_path: Path) -> None:
    before, after = attack.listings
    assert after == before
    assert not list(attack.forbidden.iterdir())
    marker = tmp_path / "ran"  # The payload works when unpickled.
    pickle.loads(pickle.dumps(Payload(marker)))
    assert marker.exists()


def test_open_files_do_not_grow(attack: AttackResult) -> None:
    before, after = attack.footprints
    # Connections of the clients, and the pipes and files of the scorers; a leak would have one for each archive.
    assert after.files <= before.files + 4 * CLIENTS, attack.footprints


@pytest.mark.nightly  # With few archives, one-time allocations outweigh what each archive could leave behind.
def test_memory_does_not_grow(attack: AttackResult) -> None:
    before, after = attack.footprints
    assert after.server_bytes - before.server_bytes < MAX_GROWTH_BYTES, attack.footprints
    assert after.children_bytes - before.children_bytes < MAX_GROWTH_BYTES, attack.footprints


@dataclass
class MemoryWatch:
    """Sampler of the peak memory, in bytes, of a process and its descendants until the block ends."""

    pid: int
    peaks: dict[int, int] = field(default_factory=dict)

    def __enter__(self) -> MemoryWatch:
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _sample(self) -> None:
        while not self._ended.wait(0.05):
            for pid in [self.pid, *descendants(self.pid)]:
                try:
                    self.peaks[pid] = max(self.peaks.get(pid, 0), memory_bytes(pid))
                except (OSError, AssertionError):
                    continue  # The process has just ended.


def split_with_gap(archive: bytes, gap: int) -> tuple[bytes, bytes]:
    """Split a valid archive into two parts that stay valid with ``gap`` unused bytes between them."""
    directory_offset = struct.unpack_from("<L", archive, len(archive) - 6)[0]
    last_record = archive.rindex(b"PK\1\2")
    (entry_offset,) = struct.unpack_from("<L", archive, last_record + 42)
    shifted = bytearray(archive)
    struct.pack_into("<L", shifted, last_record + 42, entry_offset + gap)
    struct.pack_into("<L", shifted, len(archive) - 6, directory_offset + gap)
    return archive[:entry_offset], bytes(shifted[entry_offset:])


def test_large_upload_is_scored_with_bounded_memory(
    running_server: RunServer, small_archive: Path, repetitions: Repetitions
) -> None:
    gap_bytes, chunk = repetitions(600_000_000, 2_000_000_000), bytes(1 << 20)
    archive = small_archive.read_bytes()
    first, second = split_with_gap(archive, gap_bytes)

    before, after = (multipart_part(b"|") + END).split(b"|")

    def body() -> Iterator[bytes]:
        yield before + first
        yield from (chunk for _ in range(gap_bytes // len(chunk)))
        yield bytes(gap_bytes % len(chunk)) + second + after

    with running_server() as server, MemoryWatch(server.process.pid) as watch:
        token, archives = server.token("patient"), server.state / "archives"
        response = server.call("POST", API, token, content=body(), headers={"Content-Type": MULTIPART})
        assert response.status_code == 202, response.text
        submission = response.json()["id"]
        assert (archives / f"{submission}.zip").stat().st_size == len(archive) + gap_bytes
        assert server.wait_until_ended(submission)["status"] == "scored"
        assert memory_bytes(server.process.pid, "VmHWM") < MAX_MEMORY_BYTES, watch.peaks
        assert server.call("DELETE", f"{API}/{submission}", token).status_code == 204
        assert list(archives.iterdir()) == server.spool_files() == []
    assert len(watch.peaks) >= 4  # server, checker, scorer and scoring process
    assert max(watch.peaks.values()) < MAX_MEMORY_BYTES, watch.peaks


def test_archive_of_the_full_protocols_fits_the_default_limit() -> None:
    """Float32 depth of six configs of 504 views and one of 100 views, 1280 x 720, stored without compression."""
    full = (6 * 504 + 100) * (1280 * 720 * 4 + 128)
    assert full < read_settings(None, {"data": "ROOT"}).max_upload
