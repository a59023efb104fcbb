"""Names of methods and submitters: normal form, invisible characters, stacked marks, mixed scripts."""

from __future__ import annotations

import unicodedata

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from leaderboard.names import confused_scripts, name_problem, normalised


@pytest.mark.parametrize(
    "name", ["sgbm", "Müller & Söhne", "深度估计 v2", "метод", "Nguyễn", "depth/3 (K)", "e\u0301", "שיטה", "ไทย"]
)
def test_names_of_many_languages_are_accepted(name: str) -> None:
    assert name_problem(normalised(name)) is None
    assert confused_scripts(normalised(name)) == []


@pytest.mark.parametrize(
    "name",
    [
        "\u3164\u3164\u2800",
        "a\u200bb",
        "a\u2060b",
        "\u202egnp",
        "a\u00adb",
        "x\ufe0f",
        "\U000e0041",
        "\u0301\u0301",
        "z" + "\u0335" * 12,
        "",
    ],
)
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
