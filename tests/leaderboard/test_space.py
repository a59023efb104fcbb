"""The Gradio app of ``examples/space`` in a real browser, with a real leaderboard; needs ``make env-space``."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest
from playwright.sync_api import Browser, Dialog, Page, expect

from rebar_depth_bench import score
from rebar_depth_bench.reporting import formatting
from rebar_depth_bench.scoring.result import Table
from tests.bench.submission.zips import Record, build
from tests.leaderboard.conftest import HOSTILE, SharedServer, WriteArchive
from tests.leaderboard.serving import RunServer
from tests.requirements import space_python

APP = Path(__file__).parents[2] / "examples" / "space" / "app.py"
PYTHON = space_python()
START_MS, SCORED_MS = 60_000, 60_000

pytestmark = pytest.mark.skipif(PYTHON is None, reason="no environment with gradio: make env-space")


@contextmanager
def running_app(folder: Path, variables: Mapping[str, object]) -> Iterator[str]:
    """Run the app until the block ends, with files in ``folder``; yield its address."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("REBAR_", "GRADIO_"))}
    environment |= {name: str(value) for name, value in variables.items()}
    environment |= {"GRADIO_SERVER_PORT": str(port), "GRADIO_TEMP_DIR": str(folder / "uploads")}
    folder.mkdir()
    log = folder / "app.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(PYTHON), "-u", APP], cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            wait_until_open(process, port, log)
            yield f"http://127.0.0.1:{port}"
        finally:
            process.terminate()
            process.wait(30)


def wait_until_open(process: subprocess.Popen[bytes], port: int, log: Path) -> None:
    """Wait until the app answers; fail with its log if it ends."""
    while process.poll() is None:
        try:
            if httpx2.get(f"http://127.0.0.1:{port}/").is_success:
                return
        except httpx2.TransportError:
            time.sleep(0.2)
    pytest.fail(log.read_text())


@contextmanager
def open_page(chromium: Browser, url: str) -> Iterator[Page]:
    """Yield the app in a new tab; fail at the end if it ran a script of others or asked another host."""
    strange: list[str] = []

    def on_dialog(dialog: Dialog) -> None:
        strange.append(dialog.message)
        dialog.dismiss()

    context = chromium.new_context(viewport={"width": 1280, "height": 900}, accept_downloads=True)
    page = context.new_page()
    page.on("dialog", on_dialog)
    page.on("pageerror", lambda error: strange.append(str(error)))
    page.on("request", lambda request: None if is_local(request.url, url) else strange.append(request.url))
    try:
        page.goto(url)
        yield page
    finally:
        context.close()
    assert strange == []


def is_local(address: str, url: str) -> bool:
    return address.startswith((f"{url}/", "data:", f"blob:{url}/"))


def upload(page: Page, archive: Path) -> None:
    page.get_by_role("tab", name="Score an archive").click()
    page.locator("input[type=file]").first.set_input_files(archive)
    expect(page.get_by_text(archive.name)).to_be_visible(timeout=START_MS)
    page.get_by_role("button", name="Score", exact=True).click()


def shown_rows(page: Page, heading: str) -> list[list[str]]:
    """Return the texts of the rows of the visible table below a heading."""
    table = page.locator(f"h3:visible:text-is('{heading}') + .wide table")
    expect(table).to_be_visible(timeout=START_MS)
    rows: list[list[str]] = table.locator("tbody tr").evaluate_all(
        "rows => rows.map(row => [...row.cells].map(cell => cell.textContent))"
    )
    return rows


def native_cells(table: Table) -> list[str]:
    return [
        formatting.coverage_percent(table.coverage),
        formatting.rank_error_cell(table.rank_error),
        *formatting.metric_cells(table.native),
        *formatting.within_cells(table.within_mm),
    ]


SCALED = "Scaled by the true median of each view"


@pytest.fixture(scope="module")
def app(tiny_root: Path, board: SharedServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Run the app with the shared leaderboard and the tiny dataset."""
    variables = {"REBAR_LEADERBOARD": board.url, "REBAR_DATASET": tiny_root}
    with running_app(tmp_path_factory.mktemp("space") / "app", variables) as url:
        yield url


def test_ranking_is_that_of_leaderboard(chromium: Browser, board: SharedServer, app: str) -> None:
    with open_page(chromium, app) as page:
        for config in ("lattice", "lattice-orbit"):
            rows = httpx2.get(f"{board.url}/api/v1/leaderboard", params={"config": config}).json()["rows"]
            page.get_by_label("Config").click()
            page.get_by_role("option", name=config, exact=True).click()
            names = page.locator("h3:text-is('Native') + .wide tbody th")
            expect(names).to_have_count(len(rows) + 1)  # And the reference.
            shown = shown_rows(page, "Native")[:-1]
            expected = [(row["method"], "–" if row["rank"] is None else str(row["rank"])) for row in rows]
            assert [(name, rank) for name, rank, *_ in shown] == expected
            assert [row[4] for row in shown] == [f"{row['table']['rank_error']:.4f}" for row in rows]
            scaled = [f"{row['table']['scaled']['abs_rel']:.4f}" for row in rows]
            assert [row[3] for row in shown_rows(page, SCALED)[:-1]] == scaled
            assert HOSTILE in [row[0] for row in shown]


def test_archive_is_scored_as_on_command_line(
    chromium: Browser, tiny_root: Path, write_archive: WriteArchive, app: str, tmp_path: Path
) -> None:
    archive = write_archive(HOSTILE, 1.1, 0.2, inputs="stereo", uses_ground_truth=False)
    result = score(archive, tiny_root)
    with open_page(chromium, app) as page:
        upload(page, archive)
        expect(page.get_by_role("heading", name=HOSTILE)).to_be_visible(timeout=SCORED_MS)
        shown = shown_rows(page, "Native")[: len(result.tables)]
        assert shown == [[name, str(t.views), *native_cells(t)] for name, t in result.tables.items()]
        scaled = shown_rows(page, SCALED)[: len(result.tables)]
        assert [row[2:6] for row in scaled] == [formatting.metric_cells(t.scaled) for t in result.tables.values()]
        with page.expect_download() as download:
            page.get_by_role("link", name=re.compile("KB")).last.click()
        download.value.save_as(tmp_path / "result.json")
    assert (tmp_path / "result.json").read_bytes() == result.to_json()


def test_hostile_archives_are_refused_in_words(chromium: Browser, app: str, tmp_path: Path) -> None:
    entries = [
        Record(b"submission.json", b'{"method": "<img src=x onerror=alert(1)>", "inputs": "<b>"}'),
        Record(b"../../escape.npy", b"x"),
        Record(b"lattice/<img src=x onerror=alert(2)>.npy", b"x"),
    ]
    with open_page(chromium, app) as page:
        for name, data in (
            ("entries.zip", build(entries)),
            ("broken.zip", b"PK no zip"),
            ("empty.zip", build([])),
        ):
            archive = tmp_path / name
            archive.write_bytes(data)
            page.reload()
            upload(page, archive)
            alert = page.get_by_role("alert").filter(has_text=f"{name} was refused")
            expect(alert).to_be_visible(timeout=SCORED_MS)
            assert alert.get_by_role("listitem").count() >= 1
            assert "/uploads" not in alert.inner_text()
            assert page.locator("img[src=x]").count() == 0
            assert page.locator(f"h3:visible:text-is('{SCALED}')").count() == 0
        page.reload()
        page.get_by_role("tab", name="Score an archive").click()
        page.get_by_role("button", name="Score", exact=True).click()
        expect(page.get_by_role("alert").filter(has_text="No archive")).to_be_visible()


def test_results_of_folder_are_ranked(
    chromium: Browser, tiny_root: Path, write_archive: WriteArchive, tmp_path: Path
) -> None:
    folder = tmp_path / "results" / "nested"
    folder.mkdir(parents=True)
    submissions = (("far", 1.3, False), ("near", 1.1, False), ("cheat", 1.0, True), ("same", 1.1, False))
    for method, scale, cheats in submissions:
        archive = write_archive(method, scale, configs=("lattice",), uses_ground_truth=cheats)
        (folder / f"{method}.json").write_bytes(score(archive, tiny_root).to_json())
    with running_app(tmp_path / "app", {"REBAR_RESULTS": folder.parent}) as url, open_page(chromium, url) as page:
        shown = shown_rows(page, "Native")
        ranks = [("near", "1"), ("same", "1"), ("far", "3"), ("cheat", "–")]
        assert [(name, rank) for name, rank, *_ in shown[:-1]] == ranks
        upload(page, archive)
        expect(page.get_by_role("alert")).to_contain_text("REBAR_DATASET")
        (folder / "damaged.json").write_text('{"method": "<img src=x onerror=alert(1)>"}')
        page.reload()
        expect(page.get_by_role("alert")).to_contain_text("damaged.json", timeout=START_MS)


def test_unreachable_leaderboard_is_told(chromium: Browser, tiny_root: Path, tmp_path: Path) -> None:
    variables = {"REBAR_LEADERBOARD": "http://127.0.0.1:9", "REBAR_CONFIGS": "lattice pile"}
    with running_app(tmp_path / "app", variables) as url, open_page(chromium, url) as page:
        expect(page.get_by_role("alert")).to_contain_text("127.0.0.1:9", timeout=START_MS)


def test_leaderboard_with_hidden_truth_shows_disclosed_numbers(
    chromium: Browser, tiny_root: Path, write_archive: WriteArchive, running_server: RunServer, tmp_path: Path
) -> None:
    with running_server(tiny_root, tmp_path / "state", hidden_truth=True) as server:
        submission = server.submit_accepted(
            write_archive("secret", 1.2, configs=("lattice",)), server.token("ada")
        )
        server.wait_until_ended(submission)
        variables = {"REBAR_LEADERBOARD": server.url, "REBAR_CONFIGS": "lattice"}
        with running_app(tmp_path / "app", variables) as url, open_page(chromium, url) as page:
            [row, _] = shown_rows(page, "Native")
    assert row[:2] == ["secret", "1"]
    assert float(row[4]) == pytest.approx(1 - 1 / 1.2, abs=2e-3)
    assert set(row[5:]) == {"–"}
