"""Pages of the documentation: their text with included files, blocks, headings, links and inline code."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
REPOSITORY_PAGES = (
    *("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"),
    *("benchmarks/README.md", "cards/BENCHMARK.md", "deploy/README.md"),
)
PAGES = tuple(ROOT / name for name in REPOSITORY_PAGES) + tuple(sorted(DOCS.rglob("*.md")))
"""All pages, those of the repository first."""
_INCLUDE = re.compile(r"```\{include\} (\S+)\n(?::.*\n)*```")


def name_of(page: Path) -> str:
    """Return the path of a page within the repository."""
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str) -> list[str]:
    """Return the contents of the code blocks of a page in a language, without those of included files."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def python_blocks(page: Path) -> list[tuple[str, str]]:
    """Return the Python blocks of a page, each with the text block right below it, which shows what it prints."""
    pattern = r"^```python\n(.*?)^```\n(?:\n```text\n(.*?)^```)?"
    return re.findall(pattern, page.read_text(), flags=re.DOTALL | re.MULTILINE)


def prose(page: Path) -> str:
    """Return the text of a page without its code blocks and comments."""
    without_comments = re.sub(r"<!--.*?-->", "", page.read_text(), flags=re.DOTALL)
    return re.sub(r"^```.*?^```$", "", without_comments, flags=re.DOTALL | re.MULTILINE)


def inline_code(page: Path) -> list[str]:
    """Return the inline code of a page, with single spaces in place of line breaks."""
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose(page))]


def shell_lines(page: Path) -> list[str]:
    """Return the lines of the shell blocks of a page."""
    return [line for block in blocks(page, "sh") for line in block.splitlines()]


def local_links(page: Path) -> list[tuple[str, str]]:
    """Return path (empty: the page itself) and anchor (may be empty) of the links of a page to local files."""
    links = re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", prose(page))
    return [(path, anchor) for path, anchor in links if "://" not in path]


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page and of the files that it includes."""
    text = page.read_text()
    included = [anchors((page.parent / path).resolve()) for path in _INCLUDE.findall(text)]
    headings = re.findall(r"^#{1,4} (.+)$", prose(page), flags=re.MULTILINE)
    return {anchor_of(heading) for heading in headings}.union(*included)


def anchor_of(heading: str) -> str:
    """Return the anchor of a heading, by the rule of GitHub and MyST."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def first_column(page: Path) -> list[str]:
    """Return the names in the first column of the tables of a page, which are code."""
    rows = re.findall(r"^\| (`[^|]*) \|", page.read_text(), flags=re.MULTILINE)
    return [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
