"""Pages in a real Chromium: upload, sorting and reading by mouse and keyboard, and accessibility (axe)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Browser, ConsoleMessage, FloatRect, Locator, Page, expect

from tests.leaderboard.conftest import LONG_NAME, SharedServer, WriteArchive

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


def box_of(element: Locator) -> FloatRect:
    box = element.bounding_box()
    assert box is not None
    return box


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


def test_column_headers_sort_and_change_the_address(chromium: Browser, board: SharedServer) -> None:
    with new_page(chromium, script=False) as page:
        page.goto(f"{board.url}/?config=lattice")
        ranked = methods(page)
        values = (
            page.locator("tbody >> nth=0")
            .locator("tr")
            .evaluate_all("rows => rows.map(row => Number(row.cells[5].textContent))")
        )
        by_value = [name for _, name in sorted(zip(values, ranked, strict=True))]
        assert by_value != ranked
        for direction, query, order in (
            ("ascending", "sort=rmse", by_value),
            ("descending", "sort=-rmse", by_value[::-1]),
        ):
            page.get_by_role("columnheader", name="RMSE").first.get_by_role("link").click()
            page.wait_for_url(re.compile(query))
            expect(page.get_by_role("columnheader", name="RMSE").first).to_have_attribute("aria-sort", direction)
            assert methods(page) == order


def test_search_and_input_class_are_in_the_address(chromium: Browser, board: SharedServer) -> None:
    with new_page(chromium, script=False) as page:
        page.goto(f"{board.url}/?config=lattice&sort=-rmse&rows=all")
        page.get_by_role("searchbox").fill("NEAR")
        page.get_by_role("button", name="Search").click()
        page.wait_for_url(re.compile("rows=all.*sort=-rmse.*q=NEAR"))
        assert methods(page) == ["near"]
        page.get_by_label("Declared inputs").select_option("stereo")
        page.get_by_role("button", name="Search").click()
        page.wait_for_url(re.compile("inputs=stereo"))
        expect(page.get_by_text("No submission of lattice matches.")).to_be_visible()


def test_two_ticked_rows_are_compared_without_javascript(chromium: Browser, crowded: SharedServer) -> None:
    with new_page(chromium, script=False) as page:
        for address, rows in (("/?config=lattice", 0), ("/", 1)):
            page.goto(crowded.url + address)
            form = page.locator("form", has=page.locator("table.board")).nth(rows)
            form.get_by_label("Compare method 2", exact=True).check()
            button = form.get_by_role("button", name="Compare two ticked rows")
            button.click()
            expect(page.get_by_text("1 row ticked, expected two")).to_be_visible()
            page.go_back()
            form.get_by_label("Compare method 2", exact=True).check()
            form.get_by_label("Compare method 0", exact=True).check()
            button.click()
            expect(page.get_by_role("heading", level=1)).to_have_text("Paired comparison")
            expect(page.locator(".lead")).to_contain_text("A: method 0. B: method 2.")


def test_rows_begin_high_and_no_column_is_cut_off(chromium: Browser, crowded: SharedServer) -> None:
    """On a screen of 1280 pixels, with a name of 200 characters and a row of 1e30 m."""
    with new_page(chromium) as page:
        for address in ("/?config=lattice", "/", f"/submissions/{crowded.ids['huge']}?views=lattice"):
            page.goto(crowded.url + address)
            assert page.locator(".scroll").evaluate_all(
                "all => all.every(one => one.scrollWidth <= one.clientWidth)"
            )
        page.goto(f"{crowded.url}/?config=lattice")
        assert box_of(page.locator("tbody tr").first)["y"] < 480
        coverage = box_of(page.get_by_role("columnheader", name="Coverage"))
        assert coverage["x"] + coverage["width"] <= 1280
        long, short = page.get_by_role("link", name=LONG_NAME), page.get_by_role("link", name="method 0")
        assert long.get_attribute("title") == LONG_NAME
        assert 1.9 < box_of(long)["height"] / box_of(short)["height"] < 2.1


def test_sticky_heading_covers_other_headings(chromium: Browser, board: SharedServer) -> None:
    """The heading of the first column stays on top when a narrow table is scrolled sideways."""
    with new_page(chromium, width=390) as page:
        page.goto(f"{board.url}/?config=lattice")
        page.locator("thead .name").scroll_into_view_if_needed()
        page.locator(".scroll").first.evaluate("element => { element.scrollLeft = 200; }")
        covered = page.evaluate(
            "() => { const box = document.querySelector('thead .name').getBoundingClientRect();"
            " return [0.2, 0.5, 0.8].map(share => document.elementFromPoint("
            "   box.left + share * box.width, box.bottom - 8).closest('th').className); }"
        )
        assert covered == ["name"] * 3


def test_owner_edits_publishes_and_deletes_on_the_page(
    chromium: Browser, waiting: SharedServer, write_archive: WriteArchive
) -> None:
    token = waiting.server.token("page owner")
    waiting.server.submit_accepted(write_archive("mine", configs=("lattice-orbit",)), token)
    with new_page(chromium, script=False) as page:
        page.goto(f"{waiting.url}/account")
        page.get_by_label("Token").fill(token)
        page.get_by_role("button", name="Show my submissions").click()
        expect(page.get_by_role("heading", name="mine")).to_be_visible()
        page.get_by_role("button", name="Publish").click()
        expect(page.get_by_text("queued · public")).to_be_visible()
        page.get_by_text("Edit details").click()
        page.get_by_label("Licence").fill("MIT")
        page.get_by_label("Code URL").fill("ftp://wrong")
        page.get_by_role("button", name="Save").click()
        expect(page.get_by_role("status")).to_contain_text("Not changed: code_url")
        page.get_by_text("Edit details").click()
        page.get_by_label("Licence").fill("MIT")
        page.get_by_role("button", name="Save").click()
        expect(page.get_by_role("status")).to_contain_text("mine is changed")
        page.get_by_text("Edit details").click()
        expect(page.get_by_label("Licence")).to_have_value("MIT")
        page.get_by_text("Delete mine").first.click()
        page.get_by_role("button", name="Delete mine").click()
        expect(page.get_by_role("status")).to_contain_text("mine is deleted")


def test_pages_are_operable_by_keyboard(chromium: Browser, board: SharedServer) -> None:
    with new_page(chromium) as page:
        page.goto(board.url)
        page.keyboard.press("Tab")
        skip = page.get_by_role("link", name="Skip to the content")
        expect(skip).to_be_focused()
        assert box_of(skip)["y"] >= 0
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
        assert "Search" in focused_texts
        page.keyboard.press("Enter")
        page.wait_for_url(re.compile("/submissions/"))
        expect(page.get_by_role("heading", level=1)).to_have_text("good")


def test_queued_page_updates_queue_position(chromium: Browser, waiting: SharedServer, small_archive: Path) -> None:
    token = waiting.server.token("impatient")
    first, second = (waiting.server.submit_accepted(small_archive, token) for _ in range(2))
    with new_page(chromium) as page:
        page.goto(f"{waiting.url}/submissions/{second}")
        place = int(page.locator("#place").text_content() or "")
        waiting.server.call("DELETE", f"/api/v1/submissions/{first}", token)
        expect(page.locator("#place")).to_have_text(str(place - 1))
        waiting.server.call("DELETE", f"/api/v1/submissions/{second}", token)


def page_urls(board: SharedServer, waiting: SharedServer, crowded: SharedServer) -> dict[str, str]:
    return {
        "board": f"{board.url}/",
        "one config": f"{board.url}/?config=lattice&sort=rmse",
        "crowded": f"{crowded.url}/?config=lattice&rows=all",
        "huge": crowded.page("huge"),
        "outdated": crowded.page("outdated"),
        "empty board": f"{waiting.url}/",
        "scored": board.page("good") + "?views=lattice",
        "failed": waiting.page("failed"),
        "queued": waiting.page("later"),
        "how to submit": f"{waiting.url}/how-to-submit",
        "comparison": f"{board.url}/compare?id={board.ids['good']}&id={board.ids['near']}",
        "account": f"{board.url}/account",
        "own submissions": f"{crowded.url}/account",
        "no page": f"{board.url}/nope",
    }


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("device", sorted(WIDTHS))
def test_pages_pass_axe_and_fit_width(
    chromium: Browser,
    board: SharedServer,
    waiting: SharedServer,
    crowded: SharedServer,
    scheme: str,
    device: str,
) -> None:
    with new_page(chromium, scheme=scheme, width=WIDTHS[device]) as page:
        for name, address in page_urls(board, waiting, crowded).items():
            page.goto(address)
            if name == "own submissions":
                page.get_by_label("Token").fill(crowded.token)
                page.get_by_role("button", name="Show my submissions").click()
                expect(page.get_by_role("heading", name="method 3").first).to_be_visible()
            violations = Axe().run(page).response["violations"]
            serious = [
                (violation["id"], violation["nodes"][0]["html"][:200])
                for violation in violations
                if violation["impact"] != "minor"
            ]
            assert serious == [], name
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), name
