"""Script of the HTML report, run in Chromium where it is installed."""

from __future__ import annotations

import html
import json
import re
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

from rebar_depth_bench.reporting.html.page import render_report
from tests.bench.reporting.results import overflowed_view, result, scored_view, unpredicted_view
from tests.bench.reporting.results import shown as images_of

_TABLE = """
<table class="sortable"><thead>
<tr><th scope="col" rowspan="2">Name</th><th scope="colgroup" colspan="2">errors</th>
<th scope="col" rowspan="2">Last</th></tr>
<tr><th scope="col">One</th><th scope="col">Two</th></tr></thead>
<tbody>
<tr><th>v10</th><td data-value="0.5">0.5</td><td data-value="2">2</td><td>b</td></tr>
<tr><th>v9</th><td>none</td><td data-value="10">10</td><td>a</td></tr>
<tr><th>v1</th><td data-value="1e-05">1.0e-05</td><td data-value="-3">-3</td><td>–</td></tr>
<tr><th>v2</th><td data-value="0.5">0.5</td><td data-value="1">1</td><td>c</td></tr>
</tbody></table>
"""


def dom_of(browser: str, page: str, folder: Path) -> str:
    """Load a page in Chromium and return the document after its scripts."""
    file = folder / "page.html"
    file.write_text(page, encoding="utf-8")
    profile = f"--user-data-dir={folder / 'profile'}"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", profile]
    command = [browser, *options, "--dump-dom", file.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def run_in_browser(browser: str, page: str, operations: str, folder: Path) -> Any:
    """Load ``page`` in Chromium and return the value of ``operations``, the body of a JavaScript function."""
    script = f"<script>document.title = JSON.stringify((() => {{ {operations} }})());</script>"
    title = re.search(r"<title>(.*?)</title>", dom_of(browser, f"{page}{script}", folder), re.DOTALL)
    assert title
    return json.loads(html.unescape(title[1]))


def test_sortable_table_sorts_numerically_with_dashes_last(chromium_program: str, tmp_path: Path) -> None:
    script = files("rebar_depth_bench.reporting.html").joinpath("static/sortable.js").read_text(encoding="utf-8")
    page = f"<title>t</title>{_TABLE}<script>{script}</script>"
    orders = run_in_browser(
        chromium_program,
        page,
        """
        const names = () => [...document.querySelectorAll("tbody th")].map((one) => one.textContent).join(" ");
        const states = () => [...document.querySelectorAll("th[aria-sort]")].map((one) => one.ariaSort).join(" ");
        const press = (index) => { document.querySelectorAll("th button")[index].click(); return names(); };
        return { Name: [press(0), press(0), press(0)], Last: [press(1), states(), press(1)],
          One: [press(2), press(2), states(), press(2)], Two: [press(3)] };
        """,
        tmp_path,
    )
    assert orders["Name"] == ["v1 v2 v9 v10", "v10 v9 v2 v1", "v10 v9 v1 v2"], "third press: as it was"
    assert orders["Last"] == ["v9 v10 v2 v1", "none ascending none none", "v2 v10 v9 v1"], "under a row span"
    assert orders["One"] == ["v1 v10 v2 v9", "v10 v2 v1 v9", "none none descending none", "v10 v9 v1 v2"]
    assert orders["Two"] == ["v1 v2 v10 v9"]


def test_view_browser_navigates_by_button_key_and_thumbnail(chromium_program: str, tmp_path: Path) -> None:
    views = [
        scored_view("lattice/0000", abs_rel=0.1),
        scored_view("lattice/0001", abs_rel=0.9),
        unpredicted_view("pile/0000"),
    ]
    page = render_report(result(*views), [images_of(view.view_id, view) for view in views])
    page = re.sub(r"<meta http-equiv=[^>]*>", "", page)  # The policy would block the test's own script.
    states = run_in_browser(
        chromium_program,
        page.replace("</body>\n</html>\n", ""),
        """
        const find = (what) => document.querySelector(what);
        const shown = () => [...document.querySelectorAll("article")].filter((one) => one.offsetHeight)
          .map((one) => one.querySelector("h3").textContent + ", " + find("output").textContent).join(" | ");
        const press = (key) =>
          find(".controls").dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
        const choose = (config) => {
          find("select").value = config; find("select").dispatchEvent(new Event("change"));
        };
        const [back, on] = document.querySelectorAll("[data-step]");
        const seen = [[shown(), back.disabled]];
        on.click(); seen.push(shown());
        press("ArrowRight"); press("ArrowRight"); seen.push([shown(), on.disabled]);
        press("ArrowLeft"); seen.push(shown());
        document.querySelectorAll(".thumbs button")[0].click(); seen.push(shown());
        choose("pile"); seen.push([shown(), back.disabled, on.disabled]);
        seen.push(document.querySelectorAll(".thumbs button:not([hidden])").length);
        choose(""); seen.push(shown());
        return seen;
        """,
        tmp_path,
    )
    worst, best, none = "lattice/0001, 1 of 3", "lattice/0000, 2 of 3", "pile/0000, 3 of 3"
    assert states == [
        [worst, True],
        best,
        [none, True],
        *(best, worst, ["pile/0000, 1 of 1", True, True], 1, worst),
    ]


def test_content_security_policy_blocks_foreign_scripts(chromium_program: str, tmp_path: Path) -> None:
    page = render_report(result(scored_view("lattice/0000"), overflowed_view("pier/0000")), [images_of()])
    foreign = page.replace("</body>", "<script>document.title = 'stranger'</script></body>")
    dom = dom_of(chromium_program, foreign, tmp_path)
    assert 'class="browser browsing"' in dom
    assert "<title>stranger" not in dom
