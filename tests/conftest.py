"""Test tiers, markers derived from fixtures, and the tiny dataset that most tests use."""

from __future__ import annotations

import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import settings
from xdist.scheduler import LoadFileScheduling

# Before anything of ours is imported: libraries read these once.
_CACHES = tempfile.TemporaryDirectory(prefix="rebar-test-caches-")
os.environ.update(HF_HOME=_CACHES.name, XDG_CACHE_HOME=_CACHES.name, HF_HUB_OFFLINE="1")
# Several processes share the cores, and threads that wait for each other take processor time.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")

from rebar_depth_bench import SubmissionWriter, load  # noqa: E402
from rebar_depth_bench.cli.demo import copy_sample  # noqa: E402
from tests import building, dask_cluster, requirements  # noqa: E402
from tests.building import TINY_DATASET, RunBuild, StartBuild  # noqa: E402
from tests.dask_cluster import NewCluster  # noqa: E402
from tests.requirements import Repetitions  # noqa: E402
from tests.small_disks import NewDisk, mounted_disks  # noqa: E402

# A shell that runs the tests in the background ignores this signal, and child processes would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No test is timed: a busy machine is no failure.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

if TYPE_CHECKING:
    from tests.hub_server import HubServer

GOLDEN_TEXTS = Path(__file__).parent / "data" / "golden"

FIXTURE_MARKERS = {
    "blender": "blender",
    "running_server": "server",
    "running_nginx": "server",
    "scripted": "server",
    "hub": "server",
    "running_postgres": "postgres",
    "new_cluster": "dask",
    "chromium_program": "browser",
}
"""Markers by the fixtures that start something heavy; a test has them through whichever fixtures it requests."""
SHARED_SERVER_FILES = {f"tests/leaderboard/test_{name}.py" for name in ("browser", "client", "pages")}
"""Files whose tests use the servers of the fixtures ``board`` and ``waiting``."""
TIERS = {
    "quick": {*FIXTURE_MARKERS.values(), "slow", "nightly"},
    "test": {"nightly"},
    "nightly": set[str](),
}
"""Markers that each tier leaves out."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--tier`` and ``--update-golden``."""
    parser.addoption(
        "--tier",
        choices=TIERS,
        default="test",
        help="quick: no Blender, server, database, cluster or browser, and nothing slow; "
        "test: all but long stress tests (default); nightly: everything, with full repetitions",
    )
    parser.addoption(
        "--update-golden", action="store_true", help="write the texts of tests/data/golden instead of comparing"
    )


class SharedServerScheduling(LoadFileScheduling):  # type: ignore[misc]  # It has no types.
    """Schedule whole files, and all files that share servers, to one process, which makes their fixtures once."""

    def _split_scope(self, nodeid: str) -> str:
        file = str(super()._split_scope(nodeid))
        return "shared servers" if file in SHARED_SERVER_FILES else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> SharedServerScheduling:
    """Return the scheduler of ``pytest --numprocesses``."""
    return SharedServerScheduling(config, log)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests by their fixtures and deselect those that the tier leaves out."""
    left_out = TIERS[config.getoption("--tier")]
    deselected = []
    for item in items:
        fixtures = getattr(item, "fixturenames", ())
        parameters = item.callspec.params.values() if hasattr(item, "callspec") else ()
        markers = {FIXTURE_MARKERS[name] for name in fixtures if name in FIXTURE_MARKERS}
        if any(isinstance(value, str) and value == "postgresql" for value in parameters):
            markers.add("postgres")
        for marker in markers:
            item.add_marker(marker)
        if left_out & {marker.name for marker in item.iter_markers()}:
            deselected.append(item)
    if deselected:
        config.hook.pytest_deselected(items=deselected)
        items[:] = [item for item in items if item not in set(deselected)]
    # Files that start something heavy come first, so that no process is left with a long one at the end.
    heavy = {item.path for item in items if {marker.name for marker in item.iter_markers()} & TIERS["quick"]}
    items.sort(key=lambda item: item.path not in heavy)


@pytest.fixture(scope="session")
def repetitions(request: pytest.FixtureRequest) -> Repetitions:
    """Choose how often a stress test repeats: ``repetitions(few, many)`` is ``many`` in the nightly tier."""
    is_nightly = request.config.getoption("--tier") == "nightly"
    return lambda few, many: many if is_nightly else few


@pytest.fixture(scope="session")
def check_golden(request: pytest.FixtureRequest) -> Callable[[str, str], None]:
    """Compare a text with the file of that name in ``tests/data/golden``, which ``--update-golden`` writes."""

    def check(name: str, text: str) -> None:
        if request.config.getoption("--update-golden"):
            (GOLDEN_TEXTS / name).write_bytes(text.encode())
        assert text == (GOLDEN_TEXTS / name).read_bytes().decode(), f"see {name}, and --update-golden"

    return check


@pytest.fixture(scope="session", autouse=True)
def _private_caches() -> Iterator[None]:
    """Keep the caches of ``datasets`` and the Hub apart from the user's; the Hub is offline."""
    yield
    _CACHES.cleanup()


@pytest.fixture(scope="session")
def blender() -> None:
    """Mark tests that start Blender; ``make`` has checked its system libraries before."""


@pytest.fixture
def new_disk(tmp_path: Path) -> Iterator[NewDisk]:
    """Mount small disks: ``new_disk(size_bytes)``."""
    with mounted_disks(tmp_path) as new:
        yield new


@pytest.fixture(scope="session")
def run_build(blender: None) -> RunBuild:
    """Run ``rebar-build`` to its end."""
    return building.run_build


@pytest.fixture(scope="session")
def start_build(blender: None) -> StartBuild:
    """Start ``rebar-build`` in a process group of its own."""
    return building.start_build


@pytest.fixture(scope="session")
def new_cluster() -> NewCluster:
    """Make a dask cluster that ends with a block."""
    return dask_cluster.new_cluster


@pytest.fixture(scope="session")
def chromium_program() -> str:
    """Return the path of the system's Chromium; skip without it or the library of Playwright's driver."""
    requirements.require("browser")
    path = requirements.chromium_path()
    assert path is not None
    return path


@pytest.fixture(scope="session")
def tiny_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of ``tests/data/tiny``: lattice (nine views), lattice-orbit (two), 160 x 90.

    ``make sample-data`` renders both samples anew; the nightly tier compares them with fresh renders.
    """
    root = tmp_path_factory.mktemp("tiny") / "dataset"
    copy_sample(TINY_DATASET, root)
    return root


@pytest.fixture(scope="session")
def tiny_truth(tiny_root: Path) -> dict[str, np.ndarray]:
    """Return the left depth of every view of the tiny ``lattice`` config, by view id."""
    rows = load(tiny_root, "lattice", columns=["view_id", "left_depth"])
    return {row["view_id"]: row["left_depth"] for row in rows}


@pytest.fixture(scope="session")
def tiny_masks(tiny_root: Path) -> dict[str, np.ndarray]:
    """Return the left steel mask of every view of the tiny ``lattice`` config, by view id."""
    rows = load(tiny_root, "lattice", columns=["view_id", "left_mask"])
    return {row["view_id"]: row["left_mask"] for row in rows}


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the test a ground-truth cache of its own, and return its folder, which does not exist yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    return tmp_path / "caches" / "rebar-depth-bench"


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    """Run a Hub on this machine, to which this process publishes with a token and without Xet."""
    from huggingface_hub import close_session, constants

    from tests.hub_server import TOKEN, running_hub

    with running_hub() as server:
        settings_of_hub = {"ENDPOINT": server.url, "HF_HUB_OFFLINE": False, "HF_HUB_DISABLE_XET": True}
        template = f"{server.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        settings_of_hub |= {"HUGGINGFACE_CO_URL_TEMPLATE": template}
        for name, value in settings_of_hub.items():
            monkeypatch.setattr(constants, name, value)
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        monkeypatch.setenv("NO_PROXY", "127.0.0.1")
        close_session()
        yield server
        close_session()


@pytest.fixture
def archive_of(tmp_path: Path) -> Callable[..., Path]:
    """Write predictions, by view id, as a submission archive."""

    def write(predictions: dict[str, np.ndarray], name: str = "submission.zip") -> Path:
        with SubmissionWriter(tmp_path / name, method="test") as writer:
            for view_id, depth_m in predictions.items():
                writer.add(view_id, depth_m)
        return tmp_path / name

    return write
