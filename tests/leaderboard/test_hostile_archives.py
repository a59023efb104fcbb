"""Hundreds of hostile archives: readable rejections, no files written elsewhere and no memory growth."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import httpx2
import numpy as np
import pytest

from rebar_depth_bench import load
from rebar_depth_bench.base.errors import MAX_PROBLEMS_SHOWN, Problem
from tests.ground_truth import truth_of
from tests.leaderboard.hostile_zips import (
    KINDS,
    ValidArchive,
    malformed_archives,
    pickle_payload_npy,
    unusual_valid_archives,
)
from tests.leaderboard.serving import ENDED, RunServer, Server
from tests.processes import children, memory_bytes, num_open_files
from tests.requirements import Repetitions

CLIENTS = 4
NUM_WARM_UP = 60
"""Number of archives after which one-time allocations of the server are done."""
MAX_GROWTH_BYTES = 24 << 20
"""Bound on memory growth: a fifth of the bodies of the 1,000 archives."""
SEED = 20261122
REPOSITORY = Path(__file__).parents[2]

Listing = Mapping[str, tuple[int, int]]


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
    tiny_root: Path,
    tmp_path_factory: pytest.TempPathFactory,
    running_server: RunServer,
    repetitions: Repetitions,
) -> Iterator[AttackResult]:
    folder = tmp_path_factory.mktemp("siege")
    truth_of(tiny_root, "lattice-orbit")  # The attack finds the cache complete.
    state = folder / "state"
    for name in ("cwd", "home", "tmp", "forbidden"):
        (folder / name).mkdir()
    rows = load(tiny_root, "lattice-orbit", columns=["view_id", "left_depth"])
    valid = ValidArchive({row["view_id"]: row["left_depth"] for row in rows}, folder / "forbidden")
    archives = malformed_archives(np.random.default_rng(SEED), valid, repetitions(200, 1000))
    settings: dict[str, Any] = {
        "quota": 10**6,
        "read_rate_limit": "1000000/minute",
        "write_rate_limit": "1000000/minute",
    }
    environment = {"HOME": str(folder / "home"), "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(REPOSITORY)}
    with contextlib.ExitStack() as stack:
        with contextlib.chdir(folder / "cwd"):
            server = stack.enter_context(
                running_server(tiny_root, state, environment=environment, workers=2, **settings)
            )
        first_listing = listing([folder, tiny_root], state)
        token = server.token("stranger")
        first_answers = upload_concurrently(server, token, archives[:NUM_WARM_UP])
        settled_footprint = footprint(server)
        answers = first_answers + upload_concurrently(server, token, archives[NUM_WARM_UP:])
        final_footprint = footprint(server)
        valid_answers = [
            answer
            for _, answer in upload_concurrently(
                server, token, [("sound", data) for data in unusual_valid_archives(valid)]
            )
        ]
        accepted = [
            response.json()["id"]
            for response in [*valid_answers, *(response for _, response in answers)]
            if response.status_code == 202
        ]
        ended = {submission_id: server.wait_until_ended(submission_id) for submission_id in accepted}
        listings = first_listing, listing([folder, tiny_root], state)
        yield AttackResult(
            server, answers, valid_answers, ended, (settled_footprint, final_footprint), listings, valid.forbidden
        )


def upload_concurrently(
    server: Server, token: str, archives: Sequence[tuple[str, bytes]]
) -> list[tuple[str, httpx2.Response]]:
    """Upload archives from several clients concurrently; return the kind and the response of each."""
    headers = {"Authorization": f"Bearer {token}"}
    with httpx2.Client(headers=headers, timeout=120) as client, ThreadPoolExecutor(CLIENTS) as pool:

        def upload(archive: tuple[str, bytes]) -> tuple[str, httpx2.Response]:
            files = {"archive": ("../../a.zip", archive[1])}
            return archive[0], client.post(f"{server.url}/api/v1/submissions", files=files)

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


def test_no_archive_causes_server_error(attack: AttackResult, repetitions: Repetitions) -> None:
    assert len(attack.answers) == repetitions(200, 1000)
    assert {response.status_code for _, response in attack.answers} <= {202, 422}
    assert {kind for kind, response in attack.answers if response.status_code == 422} == set(KINDS)
    lines = [json.loads(line) for line in attack.server.log if line.startswith("{")]
    assert {line["level"] for line in lines} == {"info"}
    assert not any("Traceback" in line for line in attack.server.log)


def test_rejections_list_readable_problems_without_secrets(attack: AttackResult, tiny_root: Path) -> None:
    secrets = (
        str(attack.server.state),
        str(tiny_root),
        str(REPOSITORY),
        sys.prefix,
        "Traceback",
        'File "',
        ".upload",
    )
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
            result = httpx2.get(f"{attack.server.url}/api/v1/submissions/{submission_id}/result.json")
            json.loads(result.content, parse_constant=reject_constant)
        page = httpx2.get(f"{attack.server.url}/submissions/{submission_id}", headers={"Accept": "text/html"})
        assert page.status_code == 200
    assert all(attack.ended[response.json()["id"]]["status"] == "scored" for response in attack.sound)


def reject_constant(constant: str) -> NoReturn:
    raise AssertionError(f"the result holds {constant}, which is no JSON")


def test_server_still_responds(attack: AttackResult) -> None:
    assert httpx2.get(f"{attack.server.url}/healthz").json()["status"] == "ok"
    for path in ("/", "/api/v1/leaderboard?config=lattice-orbit", "/api/v1/leaderboard.csv?config=lattice-orbit"):
        assert httpx2.get(attack.server.url + path, timeout=60).status_code == 200


def test_only_accepted_archives_are_stored(attack: AttackResult) -> None:
    state = attack.server.state
    assert {path.stem for path in (state / "archives").iterdir()} == set(attack.ended)
    assert {path.name for path in state.iterdir()} <= {
        "archives", "spool", "leaderboard.sqlite", "leaderboard.sqlite-wal", "leaderboard.sqlite-shm"
    }  # fmt: skip
    assert not list((state / "spool").iterdir())


def test_no_file_is_written_elsewhere_and_no_pickle_runs(attack: AttackResult, tmp_path: Path) -> None:
    before, after = attack.listings
    assert after == before
    assert not list(attack.forbidden.iterdir())
    marker = tmp_path / "ran"  # The payload works when unpickled.
    np.load(io.BytesIO(pickle_payload_npy(marker)), allow_pickle=True)
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
