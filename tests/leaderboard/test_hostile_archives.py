"""Hostile archives by the thousand: refused in words, nothing kept or written elsewhere, no memory lost."""

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
from tests.leaderboard.hostile_zips import KINDS, Sound, mutated, odd_and_sound, payload
from tests.leaderboard.processes import children, memory_bytes, open_files
from tests.leaderboard.serving import ENDED, Server, running_server

MUTATED = 1000
CLIENTS = 4
SETTLED = 100
"""Archives after which everything that is made once has been made."""
MOST_GROWTH_BYTES = 24 << 20
"""The bodies together are five times as much."""
SEED = 20261122
REPOSITORY = Path(__file__).parents[2]

Listing = Mapping[str, tuple[int, int]]


@dataclass(frozen=True)
class Footprint:
    """What the server's process and those of its children that check and score hold: bytes and open files."""

    server_bytes: int
    children_bytes: int
    files: int


@dataclass(frozen=True)
class Siege:
    """What became of it: every answer by kind, and what the machine looked like before and after."""

    server: Server
    answers: Sequence[tuple[str, httpx2.Response]]
    sound: Sequence[httpx2.Response]
    ended: Mapping[str, dict[str, Any]]
    footprints: tuple[Footprint, Footprint]
    listings: tuple[Listing, Listing]
    forbidden: Path


@pytest.fixture(scope="module")
def siege(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Siege]:
    world = tmp_path_factory.mktemp("siege")
    state = world / "state"
    for name in ("cwd", "home", "tmp", "forbidden"):
        (world / name).mkdir()
    rows = load(tiny_root, "lattice-orbit", columns=["view_id", "left_depth"])
    good = Sound({row["view_id"]: row["left_depth"] for row in rows}, world / "forbidden")
    archives = mutated(np.random.default_rng(SEED), good, MUTATED)
    settings: dict[str, Any] = {"quota": 10**6, "reads": "1000000/minute", "writes": "1000000/minute"}
    environment = {"HOME": str(world / "home"), "TMPDIR": str(world / "tmp"), "PYTHONPATH": str(REPOSITORY)}
    with contextlib.ExitStack() as stack:
        with contextlib.chdir(world / "cwd"):
            server = stack.enter_context(
                running_server(tiny_root, state, environment=environment, scorers=2, **settings)
            )
        before = listing([world, tiny_root], state)
        token = server.token("stranger")
        first = stormed(server, token, archives[:SETTLED])
        settled = footprint(server)
        answers = first + stormed(server, token, archives[SETTLED:])
        after = footprint(server)
        sound = [answer for _, answer in stormed(server, token, [("sound", data) for data in odd_and_sound(good)])]
        accepted = [a.json()["id"] for a in [*sound, *(a for _, a in answers)] if a.status_code == 202]
        ended = {one: server.ended(one) for one in accepted}
        listings = before, listing([world, tiny_root], state)
        yield Siege(server, answers, sound, ended, (settled, after), listings, good.forbidden)


def stormed(
    server: Server, token: str, archives: Sequence[tuple[str, bytes]]
) -> list[tuple[str, httpx2.Response]]:
    """Upload archives from several clients at once; return kind and answer of each."""
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
        sum(map(open_files, [server.process.pid, *started])),
    )


def listing(folders: Sequence[Path], besides: Path) -> Listing:
    """Return everything in the folders but what stands below ``besides``; of files size and time of change."""
    found = (path for folder in folders for path in folder.rglob("*") if besides not in (path, *path.parents))
    return {str(path): _stamp(path) for path in found}


def _stamp(path: Path) -> tuple[int, int]:
    return (path.stat().st_size, path.stat().st_mtime_ns) if path.is_file() else (0, 0)


def test_no_archive_is_a_server_error(siege: Siege) -> None:
    assert len(siege.answers) == MUTATED
    assert {answer.status_code for _, answer in siege.answers} <= {202, 422}
    assert {kind for kind, answer in siege.answers if answer.status_code == 422} == set(KINDS)
    lines = [json.loads(line) for line in siege.server.log if line.startswith("{")]
    assert {line["level"] for line in lines} == {"info"}
    assert not any("Traceback" in line for line in siege.server.log)


def test_every_refusal_tells_every_problem_in_words(siege: Siege, tiny_root: Path) -> None:
    secrets = (
        str(siege.server.state),
        str(tiny_root),
        str(REPOSITORY),
        sys.prefix,
        "Traceback",
        'File "',
        ".upload",
    )
    for kind, answer in siege.answers:
        if answer.status_code == 422:
            said = answer.json()
            assert set(said) == {"detail", "problems"}
            assert said["problems"], kind
            assert all(
                isinstance(one, str) and one.isprintable() and 10 < len(one) < 2000 for one in said["problems"]
            )
            assert "problem" in said["detail"]
            assert not any(secret in answer.text for secret in secrets), answer.text


def test_what_is_odd_and_sound_is_scored_and_the_rest_fails_with_a_reason(siege: Siege) -> None:
    assert [answer.status_code for answer in siege.sound] == [202] * len(siege.sound)
    for one, found in siege.ended.items():
        assert found["status"] in ENDED
        assert (found["status"] == "failed") == bool(found["reason"])
        if found["status"] == "scored":
            result = httpx2.get(f"{siege.server.url}/api/v1/submissions/{one}/result.json")
            json.loads(result.content, parse_constant=refuse)
        page = httpx2.get(f"{siege.server.url}/submissions/{one}", headers={"Accept": "text/html"})
        assert page.status_code == 200
    assert all(siege.ended[answer.json()["id"]]["status"] == "scored" for answer in siege.sound)


def refuse(constant: str) -> NoReturn:
    raise AssertionError(f"the result holds {constant}, which is no JSON")


def test_the_server_still_answers(siege: Siege) -> None:
    assert httpx2.get(f"{siege.server.url}/healthz").json()["status"] == "ok"
    for path in ("/", "/api/v1/leaderboard?config=lattice-orbit", "/api/v1/leaderboard.csv?config=lattice-orbit"):
        assert httpx2.get(siege.server.url + path, timeout=60).status_code == 200


def test_what_was_accepted_is_kept_and_nothing_else(siege: Siege) -> None:
    state = siege.server.state
    assert {path.stem for path in (state / "archives").iterdir()} == set(siege.ended)
    assert {path.name for path in state.iterdir()} <= {
        "archives", "spool", "leaderboard.sqlite", "leaderboard.sqlite-wal", "leaderboard.sqlite-shm"
    }  # fmt: skip
    spools = [path for path in (state / "spool").iterdir() if path.is_dir()]
    assert len(spools) == 3  # the server's and the two scorers'
    assert not any(list(spool.iterdir()) for spool in spools)
    assert {path.name for path in (state / "spool").iterdir()} == {
        "entrance.lock", *(name for spool in spools for name in (spool.name, f"{spool.name}.lock"))
    }  # fmt: skip


def test_nothing_is_written_elsewhere_and_no_pickle_runs(siege: Siege, tmp_path: Path) -> None:
    before, after = siege.listings
    assert after == before
    assert not list(siege.forbidden.iterdir())
    marker = tmp_path / "ran"  # the payload is a real one
    np.load(io.BytesIO(payload(marker)), allow_pickle=True)
    assert marker.exists()


def test_memory_and_open_files_do_not_grow(siege: Siege) -> None:
    settled, after = siege.footprints
    assert after.server_bytes - settled.server_bytes < MOST_GROWTH_BYTES, siege.footprints
    assert after.children_bytes - settled.children_bytes < MOST_GROWTH_BYTES, siege.footprints
    assert after.files <= settled.files + CLIENTS, siege.footprints
