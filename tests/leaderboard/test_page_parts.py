"""Parts of pages and requests: upload forms, untrusted text, names of methods, and error responses."""

from __future__ import annotations

import asyncio
import json
import unicodedata
from collections.abc import AsyncIterator

import pytest
from fastapi import Request
from hypothesis import example, given, settings
from hypothesis import strategies as st

from leaderboard.names import confused_scripts, name_problem, normalised
from leaderboard.uploads import UploadForm
from leaderboard.web.pages.rendering import clean_text, error_response, format_size, link_html, time_html
from rebar_depth_bench.base.errors import Problem


def multipart_body(*parts: tuple[str, bytes]) -> bytes:
    encoded_parts = b"".join(
        b'--B\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)
        for name, content in parts
    )
    return encoded_parts + b"--B--\r\n"


def read_form(content: bytes, step: int, with_token: bool) -> tuple[str, bytes]:
    """Return token and archive of a form that arrives in parts of ``step`` bytes."""

    async def read() -> tuple[str, bytes]:
        async def chunks() -> AsyncIterator[bytes]:
            for start in range(0, len(content), step):
                yield content[start : start + step]

        form = UploadForm(chunks(), "multipart/form-data; boundary=B")
        token = await form.token() if with_token else ""
        return token, b"".join([part async for part in form.archive()])

    return asyncio.run(read())


@settings(max_examples=40)
@given(st.binary(max_size=300), st.text("abcXYZ-_09", max_size=60), st.integers(1, 400), st.booleans())
def test_form_is_read_in_any_parts(archive: bytes, token: str, step: int, with_token: bool) -> None:
    content = multipart_body(("token", token.encode()), ("archive", archive))
    assert read_form(content, step, with_token) == (token if with_token else "", archive)


@pytest.mark.parametrize("url", [None, "", "javascript:alert(1)", "data:text/html,x", "//x.org", "ftp://x.org"])
def test_only_http_urls_are_linked(url: str | None) -> None:
    assert link_html(url) == ""


def test_clean_text_keeps_newlines_and_removes_controls() -> None:
    assert clean_text("a\nb\u202ec\x00") == "a\nb\ufffdc\ufffd"
    assert len(clean_text("x" * 10_000)) == 4000
    assert clean_text(None) == ""
    assert ">example.org</a>" in link_html("https://example.org/a?b=1")
    assert time_html(0.0) == '<time datetime="1970-01-01T00:00:00Z">1970-01-01 00:00 UTC</time>'
    assert [format_size(n) for n in (999, 1024, 8 << 30, 22_120_682)] == [
        "999 bytes",
        "1 KiB",
        "8 GiB",
        "21.1 MiB",
    ]


def test_error_response_lists_text_and_details_in_same_order() -> None:
    request = Request({"type": "http", "path": "/api/v1/submissions", "headers": []})
    problems = [Problem("invalid", f"{index}.npy", "the dtype is <i4", "float32") for index in range(23)]
    content = json.loads(bytes(error_response(request, 422, "invalid", None, problems).body))
    assert list(content) == ["detail", "problems", "problem_details"]
    assert [Problem(**detail) for detail in content["problem_details"]] == problems[:20]
    assert content["problems"] == [*map(str, problems[:20]), "... and 3 more"]


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


def test_wide_and_compatible_letters_become_plain_ones() -> None:
    assert normalised(" \uff53\uff47\uff42\uff4d \u2460 ") == "sgbm 1"


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
