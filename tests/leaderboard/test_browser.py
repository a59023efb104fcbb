"""The pages in a real Chromium: upload, watch, sort, read, by mouse and by keyboard; axe has nothing serious."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from tests.leaderboard.conftest import Shared, Write

SCORED_MS = 60_000
WIDTHS = {"desk": 1280, "phone": 360}


@contextmanager
def opened(chromium: Browser, *, scheme: str = "light", width: int = 1280, script: bool = True) -> Iterator[Page]:
    """Yield a fresh tab; at its end nothing has been complained of on its console."""
    complaints: list[str] = []

    def hear(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and "status of 4" not in message.text:
            complaints.append(message.text)

    context = chromium.new_context(
        color_scheme="dark" if scheme == "dark" else "light",
        viewport={"width": width, "height": 760},
        java_script_enabled=script,
    )
    page = context.new_page()
    page.on("console", hear)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    try:
        yield page
    finally:
        context.close()
    assert complaints == []


def methods(page: Page) -> list[str]:
    return page.locator("table.board").first.locator("tbody >> nth=0").locator("th a bdi").all_text_contents()


def test_upload_watch_it_score_and_find_it_on_the_board(
    chromium: Browser, board: Shared, write_archive: Write
) -> None:
    archive = write_archive("from the browser", 1.2)
    with opened(chromium) as page:
        page.goto(board.url)
        page.get_by_role("link", name="How to submit").click()
        page.get_by_label("Token", exact=True).fill(board.token)
        page.get_by_label("Archive", exact=True).set_input_files(archive)
        page.get_by_role("button", name="Upload and check").click()
        page.wait_for_url(re.compile("/submissions/"))
        expect(page.get_by_role("heading", level=1)).to_have_text("from the browser")
        expect(page.locator("#state")).to_contain_text("Scored", timeout=SCORED_MS)
        expect(page.get_by_role("heading", name="Every view")).to_be_visible()
        page.get_by_role("link", name="Board", exact=True).click()
        page.get_by_role("link", name="from the browser").first.click()
        expect(page.get_by_role("link", name="result.json")).to_be_visible()


@pytest.mark.parametrize("script", [True, False])
def test_a_refused_upload_says_every_problem(
    chromium: Browser, board: Shared, tmp_path: Path, script: bool
) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip at all")
    with opened(chromium, script=script) as page:
        page.goto(f"{board.url}/how-to-submit")
        for token, words in (("rdb_wrong", "the token is unknown"), (board.token, "the archive is refused")):
            page.get_by_label("Token", exact=True).fill(token)
            page.get_by_label("Archive", exact=True).set_input_files(broken)
            page.get_by_role("button", name="Upload and check").click()
            expect(page.get_by_role("alert")).to_contain_text(words)
        assert page.get_by_label("Token", exact=True).input_value() == (board.token if script else "")


def test_a_click_sorts_and_the_third_brings_the_ranks_back(chromium: Browser, board: Shared) -> None:
    with opened(chromium) as page:
        page.goto(f"{board.url}/?config=lattice")
        ranked = methods(page)
        head = page.get_by_role("columnheader", name="RMSE").first
        orders = []
        for direction in ("ascending", "descending", "none"):
            head.get_by_role("button").click()
            expect(head).to_have_attribute("aria-sort", direction)
            orders.append(methods(page))
        values = (
            page.locator("tbody >> nth=0")
            .locator("tr")
            .evaluate_all("rows => rows.map(row => Number(row.cells[3].dataset.value))")
        )
        by_value = [name for _, name in sorted(zip(values, ranked, strict=True))]
        assert orders == [by_value, by_value[::-1], ranked]
        assert by_value != ranked
        page.goto(f"{board.url}/?config=lattice&sort=-rmse")
        assert methods(page) == by_value[::-1]
        expect(page.get_by_role("columnheader", name="RMSE").first).to_have_attribute("aria-sort", "descending")


def test_the_keyboard_alone_is_enough(chromium: Browser, board: Shared) -> None:
    with opened(chromium) as page:
        page.goto(board.url)
        page.keyboard.press("Tab")
        skip = page.get_by_role("link", name="Skip to the content")
        expect(skip).to_be_focused()
        assert (skip.bounding_box() or {"y": -1.0})["y"] >= 0
        page.keyboard.press("Enter")
        expect(page.locator("main")).to_be_focused()
        reached = []
        for _ in range(60):
            page.keyboard.press("Tab")
            assert page.evaluate(
                "() => { const s = getComputedStyle(document.activeElement);"
                " return s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) > 0 }"
            ), page.evaluate("document.activeElement.outerHTML.slice(0, 200)")
            reached.append(str(page.evaluate("document.activeElement.textContent.trim().slice(0, 12)")))
            if reached[-1] == "good":
                break
        assert {"lattice", "all configs"} <= set(reached)
        assert any(text.startswith("AbsRel") for text in reached)
        page.keyboard.press("Enter")
        page.wait_for_url(re.compile("/submissions/"))
        expect(page.get_by_role("heading", level=1)).to_have_text("good")


def test_a_waiting_page_follows_the_queue(chromium: Browser, waiting: Shared) -> None:
    with opened(chromium) as page, page.expect_response(re.compile("/api/v1/submissions/")) as answer:
        page.goto(waiting.page("later"))
        expect(page.locator("#place")).to_have_text("2")
        assert answer.value.json()["status"] == "queued"


def addresses(board: Shared, waiting: Shared) -> dict[str, str]:
    return {
        "board": f"{board.url}/",
        "one config": f"{board.url}/?config=lattice&sort=rmse",
        "empty board": f"{waiting.url}/",
        "scored": board.page("good") + "?views=lattice",
        "failed": waiting.page("failed"),
        "queued": waiting.page("later"),
        "how to submit": f"{waiting.url}/how-to-submit",
        "no page": f"{board.url}/nope",
    }


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("device", sorted(WIDTHS))
def test_nothing_serious_for_axe_and_nothing_too_wide(
    chromium: Browser, board: Shared, waiting: Shared, scheme: str, device: str
) -> None:
    with opened(chromium, scheme=scheme, width=WIDTHS[device]) as page:
        for name, address in addresses(board, waiting).items():
            page.goto(address)
            found = Axe().run(page).response["violations"]
            serious = [(one["id"], one["nodes"][0]["html"][:200]) for one in found if one["impact"] != "minor"]
            assert serious == [], name
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
