"""Parts of pages and requests: upload forms, links, and names of methods."""

from __future__ import annotations

import asyncio
import unicodedata
from collections.abc import AsyncIterator

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from leaderboard.names import confused_scripts, name_problem, normalised
from leaderboard.uploads import UploadForm
from leaderboard.web.pages.rendering import link_html
from tests.leaderboard.serving import END, MULTIPART, multipart_part


def read_form(content: bytes, step: int, with_token: bool) -> tuple[str, bytes]:
    """Return token and archive of a form that arrives in parts of ``step`` bytes."""

    async def read() -> tuple[str, bytes]:
        async def chunks() -> AsyncIterator[bytes]:
            for start in range(0, len(content), step):
                yield content[start : start + step]

        form = UploadForm(chunks(), MULTIPART)
        token = await form.token() if with_token else ""
        return token, b"".join([part async for part in form.archive()])

    return asyncio.run(read())


@settings(max_examples=40)
@given(st.binary(max_size=300), st.text("abcXYZ-_09", max_size=60), st.integers(1, 400), st.booleans())
def test_form_is_read_in_any_parts(archive: bytes, token: str, step: int, with_token: bool) -> None:
    content = multipart_part(token.encode(), 'Content-Disposition: form-data; name="token"')
    content += multipart_part(archive) + END
    assert read_form(content, step, with_token) == (token if with_token else "", archive)


@pytest.mark.parametrize("url", [None, "", "javascript:alert(1)", "data:text/html,x", "//x.org", "ftp://x.org"])
def test_only_http_urls_are_linked(url: str | None) -> None:
    assert link_html(url) == ""


@pytest.mark.parametrize(
    "name", ["sgbm", "Müller & Söhne", "深度估计 v2", "метод", "Nguyễn", "depth/3 (K)", "e\u0301", "שיטה", "ไทย"]
)
def test_names_of_many_languages_are_accepted(name: str) -> None:
    assert name_problem(normalised(name)) is None
    assert confused_scripts(normalised(name)) == []


INVISIBLE = ("\u3164\u2800", "a\u200bb", "a\u2060b", "\u202egnp", "a\u00adb", "x\ufe0f", "\U000e0041", "")
STACKED = ("\u0301\u0301", "z" + "\u0335" * 12)


@pytest.mark.parametrize("name", [*INVISIBLE, *STACKED])
def test_invisible_and_stacked_characters_are_refused(name: str) -> None:
    assert name_problem(normalised(name)) is not None


@pytest.mark.parametrize(
    ("name", "scripts"),
    [("sgbm", []), ("sg\u0431m", ["Cyrillic", "Latin"]), ("αβγ", []), ("α-net", ["Greek", "Latin"])],
)
def test_letters_of_scripts_that_resemble_each_other_are_marked(name: str, scripts: list[str]) -> None:
    assert confused_scripts(name) == scripts


@given(st.text(max_size=20))
@example("0\u16800")
def test_accepted_names_are_printable_and_stay_as_they_are(name: str) -> None:
    plain = normalised(name)
    assert normalised(plain) == plain
    if name_problem(plain) is None:
        assert plain.isprintable()
        assert unicodedata.is_normalized("NFKC", plain)
