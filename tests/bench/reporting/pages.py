"""HTML pages: a parser that checks the nesting and collects tags and text, and the part that golden texts hold."""

from __future__ import annotations

import re
from html.parser import HTMLParser

VOID_TAGS = {"meta", "img", "br", "path", "link", "input"}
_EMBEDDED = {
    r"<style>.*?</style>": "<style></style>",
    r"<script>.*?</script>": "<script></script>",
    r"script-src 'sha256-[^']*'": "script-src",
    r'"data:image/[^"]*"': '"data:image"',
}


def without_embedded(page: str) -> str:
    """Return a page without its style sheet, scripts and image data, for a golden text.

    The values by which cells are sorted are rounded, since the last digits depend on the processor.
    """
    for pattern, shown in _EMBEDDED.items():
        page = re.sub(pattern, shown, page, flags=re.DOTALL)
    return re.sub(r'data-value="([^"]*)"', lambda value: f'data-value="{float(value[1]):.6g}"', page)


class Page(HTMLParser):
    """Parsed HTML page; construction fails if tags do not nest."""

    def __init__(self, page: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open_tags: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text_parts: list[str] = []
        self.feed(page)
        self.close()
        assert self.open_tags == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID_TAGS:
            self.open_tags.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text_parts.append(data)

    def count(self, tag: str) -> int:
        return len(self.attributes_of(tag))

    def attributes_of(self, tag: str) -> list[dict[str, str | None]]:
        """Return the attributes of every ``tag``, in document order."""
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def text(self) -> str:
        """Return the text outside of tags, with runs of white space collapsed."""
        return re.sub(r"[ \n]+", " ", " ".join(self.text_parts))
