"""Pages in a real Chromium: upload, sorting and reading by mouse and keyboard, and accessibility (axe)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from tests.leaderboard.conftest import SharedServer, WriteArchive

SCORED_MS = 60_000
WIDTHS = {"desk": 1280, "phone": 360}


@contextmanager
def new_page(
    chromium: Browser, *, scheme: str = "light", width: int = 1280, script: bool = True
) -> Iterator[Page]:
    """Yield a new tab; fail at the end if its console has errors or warnings."""
    messages: list[str] = []

    def on_console_message(message: ConsoleMessage) -> None:
        if message.type in ("error", "warning") and "status of 4" not in message.text:
            messages.append(message.text)

    context = chromium.new_context(
        color_scheme="dark" if scheme == "dark" else "light",
        viewport={"width": width, "height": 760},
        java_script_enabled=script,
    )
    page = context.new_page()
    page.on("console", on_console_message)
    page.on("pageerror", lambda error: messages.append(str(error)))
    try:
        yield page
    finally:
        context.close()
    assert messages == []


def methods(page: Page) -> list[str]:
    return page.locator("table.board").first.locator("tbody >> nth=0").locator("th a bdi").all_text_contents()


def test_upload_is_scored_and_shown_on_leaderboard(
    chromium: Browser, board: SharedServer, write_archive: WriteArchive
) -> None:
    archive = write_archive("from the browser", 1.2)
    with new_page(chromium) as page:
        page.goto(board.url)
        page.get_by_role("link", name="How to submit").click()
        page.get_by_label("Token", exact=True).fill(board.token)
        page.get_by_label("Archive", exact=True).set_input_files(archive)
        page.get_by_role("button", name="Upload and check").click()
        page.wait_for_url(re.compile("/submissions/"))
        expect(page.get_by_role("heading", level=1)).to_have_text("from the browser")
        expect(page.locator("#state")).to_contain_text("Scored", timeout=SCORED_MS)
        expect(page.get_by_role("heading", name="Every view")).to_be_visible()
        page.get_by_role("link", name="Leaderboard", exact=True).click()
        page.get_by_role("link", name="from the browser").first.click()
        expect(page.get_by_role("link", name="result.json")).to_be_visible()


@pytest.mark.parametrize("script", [True, False])
def test_rejected_upload_shows_problems(
    chromium: Browser, board: SharedServer, tmp_path: Path, script: bool
) -> None:
    broken = tmp_path / "broken.zip"
    broken.write_bytes(b"PK no zip at all")
    with new_page(chromium, script=script) as page:
        page.goto(f"{board.url}/how-to-submit")
        for token, words in (("rdb_wrong", "the token is unknown"), (board.token, "the archive is invalid")):
            page.get_by_label("Token", exact=True).fill(token)
            page.get_by_label("Archive", exact=True).set_input_files(broken)
            page.get_by_role("button", name="Upload and check").click()
            expect(page.get_by_role("alert")).to_contain_text(words)
        assert page.get_by_label("Token", exact=True).input_value() == (board.token if script else "")


def test_column_header_cycles_sort_orders(chromium: Browser, board: SharedServer) -> None:
    with new_page(chromium) as page:
        page.goto(f"{board.url}/?config=lattice")
        ranked = methods(page)
        header = page.get_by_role("columnheader", name="RMSE").first
        orders = []
        for direction in ("ascending", "descending", "none"):
            header.get_by_role("button").click()
            expect(header).to_have_attribute("aria-sort", direction)
            orders.append(methods(page))
        values = (
            page.locator("tbody >> nth=0")
            .locator("tr")
            .evaluate_all("rows => rows.map(row => Number(row.cells[4].dataset.value))")
        )
        by_value = [name for _, name in sorted(zip(values, ranked, strict=True))]
        assert orders == [by_value, by_value[::-1], ranked]
        assert by_value != ranked
        page.goto(f"{board.url}/?config=lattice&sort=-rmse")
        assert methods(page) == by_value[::-1]
        expect(page.get_by_role("columnheader", name="RMSE").first).to_have_attribute("aria-sort", "descending")


def test_pages_are_operable_by_keyboard(chromium: Browser, board: SharedServer) -> None:
    with new_page(chromium) as page:
        page.goto(board.url)
        page.keyboard.press("Tab")
        skip = page.get_by_role("link", name="Skip to the content")
        expect(skip).to_be_focused()
        assert (skip.bounding_box() or {"y": -1.0})["y"] >= 0
        page.keyboard.press("Enter")
        expect(page.locator("main")).to_be_focused()
        focused_texts = []
        for _ in range(60):
            page.keyboard.press("Tab")
            assert page.evaluate(
                "() => { const s = getComputedStyle(document.activeElement);"
                " return s.outlineStyle !== 'none' && parseFloat(s.outlineWidth) > 0 }"
            ), page.evaluate("document.activeElement.outerHTML.slice(0, 200)")
            focused_texts.append(str(page.evaluate("document.activeElement.textContent.trim().slice(0, 12)")))
            if focused_texts[-1] == "good":
                break
        assert {"lattice", "all configs"} <= set(focused_texts)
        assert any(text.startswith("AbsRel") for text in focused_texts)
        page.keyboard.press("Enter")
        page.wait_for_url(re.compile("/submissions/"))
        expect(page.get_by_role("heading", level=1)).to_have_text("good")


def test_queued_page_updates_queue_position(chromium: Browser, waiting: SharedServer) -> None:
    with new_page(chromium) as page, page.expect_response(re.compile("/api/v1/submissions/")) as response_info:
        page.goto(waiting.page("later"))
        expect(page.locator("#place")).to_have_text("2")
        assert response_info.value.json()["status"] == "queued"


def page_urls(board: SharedServer, waiting: SharedServer) -> dict[str, str]:
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
def test_pages_pass_axe_and_fit_width(
    chromium: Browser, board: SharedServer, waiting: SharedServer, scheme: str, device: str
) -> None:
    with new_page(chromium, scheme=scheme, width=WIDTHS[device]) as page:
        for name, address in page_urls(board, waiting).items():
            page.goto(address)
            violations = Axe().run(page).response["violations"]
            serious = [
                (violation["id"], violation["nodes"][0]["html"][:200])
                for violation in violations
                if violation["impact"] != "minor"
            ]
            assert serious == [], name
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
