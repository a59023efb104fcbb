"""Archives on a disk and at a real remote place, an FTP server in a process of its own."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import httpx2
import pytest

from leaderboard.db.engine import Database
from leaderboard.db.jobs import Job
from leaderboard.redact import without_password
from leaderboard.scoring.subprocess_backend import local_score
from leaderboard.scoring.worker import AwayError
from leaderboard.settings import read_settings
from leaderboard.storage.archive_store import Archives, GoneError, written_s
from leaderboard.uploads.accept import AWAY as INTAKE_AWAY
from leaderboard.web.context import ORPHAN_S, clear
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import InputError
from tests.leaderboard.conftest import Write
from tests.leaderboard.serving import make_token, running_server
from tests.leaderboard.watching import wait_until

USER, PASSWORD = "keeper", "open-sesame"
CONTENT = bytes(range(256)) * 1000


@dataclass(frozen=True)
class Place:
    """Where archives are kept: the URL as ``--archives`` takes it, and the folder that is behind it."""

    url: str
    folder: Path


def answers(port: int) -> bool:
    with socket.socket() as connection:
        return connection.connect_ex(("127.0.0.1", port)) == 0


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@contextmanager
def ftp_server(folder: Path, port: int) -> Iterator[str]:
    """Run an FTP server over ``folder`` that only ``USER`` may write to; yield the URL of its root."""
    command = [sys.executable, "-m", "pyftpdlib", "-i", "127.0.0.1", "-p", str(port), "-d", str(folder)]
    process = subprocess.Popen(
        [*command, "-w", "-u", USER, "-P", PASSWORD], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: answers(port), "the FTP server listens")
        yield f"ftp://{USER}:{PASSWORD}@127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def ftp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    folder = tmp_path_factory.mktemp("ftp")
    with ftp_server(folder, free_port()) as url:
        yield Place(url, folder)


@pytest.fixture(params=["folder", "file URL", "ftp"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """A place that does not exist yet, two folders deep."""
    if request.param == "ftp":
        ftp: Place = request.getfixturevalue("ftp")
        return Place(f"{ftp.url}/{tmp_path.name}/kept", ftp.folder / tmp_path.name / "kept")
    kept = tmp_path / "some where" / "kept"
    return Place(str(kept) if request.param == "folder" else f"file://{kept}", kept)


@pytest.fixture
def new_file(tmp_path: Path) -> Callable[[], Path]:
    def make() -> Path:
        path = tmp_path / f"{time.monotonic_ns()}.upload"
        path.write_bytes(CONTENT)
        return path

    return make


def test_an_archive_is_kept_found_read_and_deleted(
    place: Place, new_file: Callable[[], Path], tmp_path: Path
) -> None:
    archives, scratch = Archives(place.url), tmp_path / "scratch"
    scratch.mkdir()
    assert archives.ids() == set()
    source = new_file()
    archives.put("an-id_1", source)
    assert not source.exists(), "an upload that is kept is no longer in the spool"
    assert {path.name: path.read_bytes() for path in place.folder.iterdir()} == {"an-id_1.zip": CONTENT}
    assert archives.ids() == Archives(place.url).ids() == {"an-id_1"}
    with archives.local("an-id_1", scratch) as path:
        assert path.read_bytes() == CONTENT
    assert not list(scratch.iterdir())
    archives.delete("an-id_1")
    assert not list(place.folder.iterdir())
    assert archives.ids() == set()


def test_what_is_not_there_is_told_and_deleting_it_is_no_error(place: Place, tmp_path: Path) -> None:
    archives = Archives(place.url)
    archives.delete("never-was")
    with pytest.raises(GoneError), archives.local("never-was", tmp_path):
        pytest.fail("there is nothing to read")
    assert not (tmp_path / "never-was.zip").exists()


def test_the_age_is_the_files(place: Place, new_file: Callable[[], Path]) -> None:
    archives, now = Archives(place.url), time.time()
    archives.put("old", new_file())
    assert archives.age_s("old", now) == pytest.approx(0, abs=60)
    os.utime(place.folder / "old.zip", (now - 5000, now - 5000))
    assert archives.age_s("old", now) == pytest.approx(5000, abs=1)


def test_other_files_are_no_archives(place: Place) -> None:
    archives = Archives(place.url)
    (place.folder / "notes.txt").write_text("not ours")
    (place.folder / "half.part").write_text("under way")
    assert archives.ids() == set()


def test_many_threads_keep_archives_at_once(place: Place, new_file: Callable[[], Path]) -> None:
    archives = Archives(place.url)
    names = [f"id-{number}" for number in range(12)]
    with ThreadPoolExecutor(6) as threads:
        list(threads.map(archives.put, names, [new_file() for _ in names]))
    assert archives.ids() == set(names)
    assert {path.read_bytes() for path in place.folder.iterdir()} == {CONTENT}


def test_a_place_that_refuses_us_is_told_without_the_password(ftp: Place) -> None:
    wrong = ftp.url.replace(PASSWORD, "wrong-sesame")
    with pytest.raises(InputError, match="archives cannot be kept there") as refusal:
        Archives(f"{wrong}/kept")
    assert "sesame" not in str(refusal.value)
    assert without_password("s3://bucket/archives") == "s3://bucket/archives"
    assert without_password("ftp://a:b@c@host/x") == "ftp://...@host/x"


@pytest.mark.parametrize(
    "told",
    [
        {"mtime": 1e9},
        {"mtime": datetime.fromtimestamp(1e9, UTC)},  # SFTP
        {"LastModified": datetime.fromtimestamp(1e9, UTC)},  # S3
        {"updated": "2001-09-09T01:46:40.000Z"},  # Google
        {"modify": "20010909014640"},  # FTP
        {"modify": "20010909014640.000"},
    ],
)
def test_the_ways_in_which_stores_tell_the_time(told: dict[str, object]) -> None:
    assert written_s(told) == pytest.approx(1e9)


@pytest.mark.parametrize("told", [{}, {"size": 3}, {"modify": "Nov 21 23:25"}])
def test_stores_that_do_not_tell_the_time(told: dict[str, object]) -> None:
    assert written_s(told) is None


def test_a_service_keeps_its_archives_there_and_leaves_nothing(
    tiny_root: Path, tmp_path: Path, write_archive: Write, ftp: Place
) -> None:
    state, kept = tmp_path / "state", ftp.folder / "service"
    archive, settings = write_archive("small", configs=("lattice-orbit",)), {"archives": f"{ftp.url}/service"}
    token = make_token(state, "alice")
    with running_server(tiny_root, state, scorers=0, **settings) as server:  # type: ignore[arg-type]
        first = server.accepted(archive, token)
    for name, age_s in (("orphan", 2 * ORPHAN_S), ("young", 0.0)):
        (kept / f"{name}.zip").write_bytes(CONTENT)
        os.utime(kept / f"{name}.zip", (time.time() - age_s,) * 2)
    with running_server(tiny_root, state, **settings) as server:  # type: ignore[arg-type]
        kept_names = {path.name for path in kept.iterdir()}
        assert kept_names == {"young.zip", f"{first}.zip"}, "archives of nobody are cleared once old"
        (kept / "young.zip").unlink()
        second = server.accepted(archive, token)
        assert (kept / f"{second}.zip").read_bytes() == archive.read_bytes()
        for submission in (first, second):
            assert server.ended(submission)["status"] == "scored"
            address, owner = f"{server.url}/api/v1/submissions/{submission}", {"Authorization": f"Bearer {token}"}
            assert httpx2.delete(address, headers=owner, timeout=60).status_code == 204
        assert not list(kept.iterdir())
        assert not (state / "archives").exists()
        wait_until(lambda: not list((state / "spool").glob("*/*")), "the spool is empty")
        log = "\n".join(server.log)
    assert PASSWORD not in log
    assert sorted(path.name for path in (state / "spool").iterdir()) == ["entrance.lock"]


def test_a_place_that_is_away_for_a_while_costs_nothing(
    tiny_root: Path, tmp_path: Path, write_archive: Write
) -> None:
    state, port, archive = tmp_path / "state", free_port(), write_archive("small", configs=("lattice-orbit",))
    (tmp_path / "ftp").mkdir()
    with ExitStack() as stack:
        away = stack.enter_context(ExitStack())
        url = away.enter_context(ftp_server(tmp_path / "ftp", port))
        server = stack.enter_context(running_server(tiny_root, state, archives=f"{url}/kept", quota=1, scorers=0))
        token = server.token("alice")
        away.close()
        refused = server.submit(archive, token)
        assert (refused.status_code, refused.json()["detail"]) == (503, INTAKE_AWAY)
        stack.enter_context(ftp_server(tmp_path / "ftp", port))
        submission = server.accepted(archive, token)
        assert not list((state / "spool").glob("*/*.upload"))
    settings = read_settings(None, {"data": str(tiny_root), "state": state, "archives": f"{url}/kept"})
    score, job = local_score(settings, tmp_path), Job(submission, open_folder(str(tiny_root)).digest)
    with pytest.raises(AwayError, match="Connection refused"):
        score(job, lambda: True)
    with ftp_server(tmp_path / "ftp", port):
        outcome = score(job, lambda: True)
    assert outcome is not None
    assert outcome.result is not None


def test_a_database_that_knows_nothing_clears_nothing(tmp_path: Path) -> None:
    archives, old = Archives(str(tmp_path / "kept")), tmp_path / "kept" / "old.zip"
    old.write_bytes(CONTENT)
    os.utime(old, (0, 0))
    with closing(Database(f"sqlite:///{tmp_path / 'db.sqlite'}")) as database:
        database.migrate()
        clear(database, archives)
    assert old.is_file()
