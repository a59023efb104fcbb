"""Archive store on disk and on a real remote store (an FTP server in a separate process)."""

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
from leaderboard.scoring.subprocess_backend import make_subprocess_backend
from leaderboard.scoring.worker import BackendUnavailableError
from leaderboard.service import ORPHAN_AGE_S, remove_orphan_archives
from leaderboard.settings import read_settings
from leaderboard.storage.archive_store import ArchiveNotFoundError, ArchiveStore, modified_s
from leaderboard.uploads.accept import UNAVAILABLE_MESSAGE as UPLOADS_UNAVAILABLE
from rebar_depth_bench.data.manifest import open_folder
from rebar_depth_bench.errors import InputError
from tests.leaderboard.serving import RunServer, make_token
from tests.processes import wait_until

USER, PASSWORD = "keeper", "open-sesame"
CONTENT = bytes(range(256)) * 1000


@dataclass(frozen=True)
class ArchiveLocation:
    """Storage location: the URL for ``--archives`` and the local folder behind it."""

    url: str
    folder: Path


def is_listening(port: int) -> bool:
    with socket.socket() as connection:
        return connection.connect_ex(("127.0.0.1", port)) == 0


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


@contextmanager
def ftp_server(folder: Path, port: int) -> Iterator[str]:
    """Run an FTP server on ``folder`` that only ``USER`` may write to; yield the URL of its root."""
    command = [sys.executable, "-m", "pyftpdlib", "-i", "127.0.0.1", "-p", str(port), "-d", str(folder)]
    process = subprocess.Popen(
        [*command, "-w", "-u", USER, "-P", PASSWORD], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        wait_until(lambda: is_listening(port), "the FTP server listens")
        yield f"ftp://{USER}:{PASSWORD}@127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def ftp(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ArchiveLocation]:
    folder = tmp_path_factory.mktemp("ftp")
    with ftp_server(folder, free_port()) as url:
        yield ArchiveLocation(url, folder)


@pytest.fixture(params=["folder", "file URL", "ftp"])
def location(request: pytest.FixtureRequest, tmp_path: Path) -> ArchiveLocation:
    """Return a location that does not exist yet, two folders deep."""
    if request.param == "ftp":
        ftp: ArchiveLocation = request.getfixturevalue("ftp")
        return ArchiveLocation(f"{ftp.url}/{tmp_path.name}/kept", ftp.folder / tmp_path.name / "kept")
    folder = tmp_path / "some where" / "kept"
    return ArchiveLocation(str(folder) if request.param == "folder" else f"file://{folder}", folder)


@pytest.fixture
def new_file(tmp_path: Path) -> Callable[[], Path]:
    def make() -> Path:
        path = tmp_path / f"{time.monotonic_ns()}.upload"
        path.write_bytes(CONTENT)
        return path

    return make


def test_archive_is_stored_listed_read_and_deleted(
    location: ArchiveLocation, new_file: Callable[[], Path], tmp_path: Path
) -> None:
    archives, scratch = ArchiveStore(location.url), tmp_path / "scratch"
    scratch.mkdir()
    assert archives.ids() == set()
    source = new_file()
    archives.put("an-id_1", source)
    assert not source.exists(), "an upload that is kept is no longer in the spool"
    assert {path.name: path.read_bytes() for path in location.folder.iterdir()} == {"an-id_1.zip": CONTENT}
    assert archives.ids() == ArchiveStore(location.url).ids() == {"an-id_1"}
    with archives.local_copy("an-id_1", scratch) as path:
        assert path.read_bytes() == CONTENT
    assert not list(scratch.iterdir())
    archives.delete("an-id_1")
    assert not list(location.folder.iterdir())
    assert archives.ids() == set()


def test_missing_archive_raises_on_read_but_not_on_delete(location: ArchiveLocation, tmp_path: Path) -> None:
    archives = ArchiveStore(location.url)
    archives.delete("never-was")
    with pytest.raises(ArchiveNotFoundError), archives.local_copy("never-was", tmp_path):
        pytest.fail("there is nothing to read")
    assert not (tmp_path / "never-was.zip").exists()


def test_age_is_that_of_file(location: ArchiveLocation, new_file: Callable[[], Path]) -> None:
    archives, now = ArchiveStore(location.url), time.time()
    archives.put("old", new_file())
    assert archives.age_s("old", now) == pytest.approx(0, abs=60)
    os.utime(location.folder / "old.zip", (now - 5000, now - 5000))
    assert archives.age_s("old", now) == pytest.approx(5000, abs=1)


def test_other_files_are_not_listed(location: ArchiveLocation) -> None:
    archives = ArchiveStore(location.url)
    (location.folder / "notes.txt").write_text("not ours")
    (location.folder / "half.part").write_text("under way")
    assert archives.ids() == set()


def test_concurrent_uploads_are_all_stored(location: ArchiveLocation, new_file: Callable[[], Path]) -> None:
    archives = ArchiveStore(location.url)
    names = [f"id-{number}" for number in range(12)]
    with ThreadPoolExecutor(6) as threads:
        list(threads.map(archives.put, names, [new_file() for _ in names]))
    assert archives.ids() == set(names)
    assert {path.read_bytes() for path in location.folder.iterdir()} == {CONTENT}


@pytest.mark.slow
def test_login_failure_is_reported_without_password(ftp: ArchiveLocation) -> None:
    wrong = ftp.url.replace(PASSWORD, "wrong-sesame")
    with pytest.raises(InputError, match="cannot access the archive storage") as refusal:
        ArchiveStore(f"{wrong}/kept")
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
def test_modification_time_is_read_for_every_store(told: dict[str, object]) -> None:
    assert modified_s(told) == pytest.approx(1e9)


@pytest.mark.parametrize("told", [{}, {"size": 3}, {"modify": "Nov 21 23:25"}])
def test_unknown_modification_time_is_none(told: dict[str, object]) -> None:
    assert modified_s(told) is None


def test_service_stores_archives_remotely_and_cleans_up(
    tiny_root: Path, tmp_path: Path, small_archive: Path, ftp: ArchiveLocation, running_server: RunServer
) -> None:
    state, folder = tmp_path / "state", ftp.folder / "service"
    settings = {"archives": f"{ftp.url}/service"}
    token = make_token(state, "alice")
    with running_server(tiny_root, state, workers=0, **settings) as server:
        first = server.submit_accepted(small_archive, token)
    for name, age_s in (("orphan", 2 * ORPHAN_AGE_S), ("young", 0.0)):
        (folder / f"{name}.zip").write_bytes(CONTENT)
        os.utime(folder / f"{name}.zip", (time.time() - age_s,) * 2)
    with running_server(tiny_root, state, **settings) as server:
        names = {path.name for path in folder.iterdir()}
        assert names == {"young.zip", f"{first}.zip"}, "archives of nobody are cleared once old"
        (folder / "young.zip").unlink()
        second = server.submit_accepted(small_archive, token)
        assert (folder / f"{second}.zip").read_bytes() == small_archive.read_bytes()
        for submission in (first, second):
            assert server.wait_until_ended(submission)["status"] == "scored"
            address, owner = f"{server.url}/api/v1/submissions/{submission}", {"Authorization": f"Bearer {token}"}
            assert httpx2.delete(address, headers=owner, timeout=60).status_code == 204
        assert not list(folder.iterdir())
        assert not (state / "archives").exists()
        wait_until(lambda: not list((state / "spool").glob("*/*")), "the spool is empty")
        log = "\n".join(server.log)
    assert PASSWORD not in log
    assert sorted(path.name for path in (state / "spool").iterdir()) == ["entrance.lock"]


def test_storage_outage_keeps_quota_and_requeues_job(
    tiny_root: Path, tmp_path: Path, small_archive: Path, running_server: RunServer
) -> None:
    state, port = tmp_path / "state", free_port()
    (tmp_path / "ftp").mkdir()
    with ExitStack() as stack:
        first_ftp_server = stack.enter_context(ExitStack())
        url = first_ftp_server.enter_context(ftp_server(tmp_path / "ftp", port))
        server = stack.enter_context(running_server(tiny_root, state, archives=f"{url}/kept", quota=1, workers=0))
        token = server.token("alice")
        first_ftp_server.close()
        response = server.submit(small_archive, token)
        assert (response.status_code, response.json()["detail"]) == (503, UPLOADS_UNAVAILABLE)
        stack.enter_context(ftp_server(tmp_path / "ftp", port))
        submission = server.submit_accepted(small_archive, token)
        assert not list((state / "spool").glob("*/*.upload"))
    settings = read_settings(None, {"data": str(tiny_root), "state_dir": state, "archives": f"{url}/kept"})
    score, job = make_subprocess_backend(settings, tmp_path), Job(submission, open_folder(str(tiny_root)).digest)
    with pytest.raises(BackendUnavailableError, match="Connection refused"):
        score(job, lambda: True)
    with ftp_server(tmp_path / "ftp", port):
        outcome = score(job, lambda: True)
    assert outcome is not None
    assert outcome.result is not None


def test_empty_database_removes_no_orphans(tmp_path: Path) -> None:
    archives, old = ArchiveStore(str(tmp_path / "kept")), tmp_path / "kept" / "old.zip"
    old.write_bytes(CONTENT)
    os.utime(old, (0, 0))
    with closing(Database(f"sqlite:///{tmp_path / 'db.sqlite'}")) as database:
        database.migrate()
        remove_orphan_archives(database, archives)
    assert old.is_file()
