"""LaTeX tables of results: golden texts, and validity, escaping and bold values in other cases."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.reporting.latex import escape_latex, latex_table
from rebar_depth_bench.scoring.result import DatasetIdentity
from tests.bench.reporting.results import HOSTILE, example, examples, result, scored_view

COMMANDS = {
    *("begin", "end", "centering", "caption", "label", "setlength", "tabcolsep", "small", "medskip", "tiny"),
    *("toprule", "midrule", "bottomrule", "cmidrule", "multicolumn", "textbf", "emph", "downarrow", "dagger"),
    *("ddagger", "mathrm", "char", "max", "textbackslash", "textasciitilde", "textasciicircum", "textless"),
    *("textgreater", "textbar", "textasciigrave"),
}
"""Commands that a table may contain."""


def checked(table: str) -> str:
    """Check braces, commands, environments, column counts and line breaks of a table, and return it."""
    depth = 0
    for token in re.findall(r"\\.|[{}]", table, re.DOTALL):
        depth += {"{": 1, "}": -1}.get(token, 0)
        assert depth >= 0
    assert depth == 0
    comment, _, rest = table.partition("\n")
    assert comment == r"% needs \usepackage{booktabs}"
    assert set(re.findall(r"\\([A-Za-z]+)", re.sub(r"\\\\", "", rest))) <= COMMANDS
    assert not re.search(r"\\\\\s*[\[*]", table), "an argument of the line break"
    assert len(re.findall(r"(?<!\\)\$", table)) % 2 == 0
    open_environments: list[str] = []
    for kind, name in re.findall(r"(?<!\\)\\(begin|end)\{(\w+\*?)\}", table):
        if kind == "begin":
            open_environments.append(name)
        else:
            assert open_environments.pop() == name
    assert open_environments == []
    for width, body in re.findall(r"\\begin\{tabular\}\{l(r+)\}\n(.*?)\\end\{tabular\}", table, re.DOTALL):
        rows = re.findall(r"^(.*) \\\\$", body, re.MULTILINE)
        assert len(rows) > 2
        for row in rows:
            extra_columns = sum(int(span) - 1 for span in re.findall(r"\\multicolumn\{(\d+)\}", row))
            assert len(re.findall(r"(?<!\\)&", row)) + 1 + extra_columns == len(width) + 1, row
    for line in rest.splitlines():
        assert not re.search(r"(?<!\\)%", line), "a comment would swallow the rest"
    return table


def test_tables_are_the_golden_texts(check_golden: Callable[[str, str], None]) -> None:
    check_golden("table.tex", checked(latex_table(examples(), published=True)))
    check_golden("intervals.tex", checked(latex_table([example()], published=False, intervals=True)))


def test_rows_and_notes_appear_only_where_they_apply() -> None:
    own = checked(latex_table([result(scored_view("lattice/0000"))], published=False))
    assert not any(word in own for word in ("dagger", "Published", "FoundationStereo", "textbf", "tiny"))
    unknown = checked(latex_table([result(scored_view("beam_1/0000"))], published=True))
    assert "Published" not in unknown
    mixed = latex_table([result(scored_view("beam_1/0000"), scored_view("pile/0000"))], published=True)
    assert r"Depth Pro & -- & -- & -- & -- & -- &  & 15.46 & 0.262 & 0.043 & 0.92 \\" in checked(mixed)
    assert "dagger" not in mixed.split(r"\begin{tabular}")[1]


def test_best_error_is_bold_only_among_comparable_results() -> None:
    """With a result that has gaps, only the rank error, which counts them, is compared."""
    [good, fair, gaps] = [
        result(*(scored_view(f"lattice/{i:04d}", error, coverage) for i in range(8)), method=name)
        for name, error, coverage in (("good", 0.02, 1.0), ("fair", 0.03, 1.0), ("gaps", 0.001, 0.5))
    ]
    assert "textbf" not in latex_table([good], published=True)
    assert r"good & \textbf{0.0196} & \textbf{20.09} & \textbf{0.0200}" in latex_table(
        [fair, good], published=True
    )
    table = checked(latex_table([good, fair, gaps], published=False))
    assert r"gaps & 0.5005 & 20.09$^{*}$ & 0.0010 &" in table
    note = r"$^{*}$Errors of valid predictions are not compared with those of others: "
    assert rf"{note}gaps, lattice (coverage 50.0 \% is below 95 \%)." in table
    assert table.count("$^{*}$") == 2
    assert r"\emph{constant, gaps} &  &  &  & 0.0529 &  \\" in table
    assert re.findall(r"\\textbf\{.*?\}", table) == [r"\textbf{0.0196}"]


NAMES = (
    *(
        HOSTILE,
        r"\end{tabular}\input{/etc/passwd}",
        "100% & more",
        "a_b^c~d#e$f{g}h}i{",
        "[2cm]",
        "*",
        "\\",
        "\\\\",
    ),
    *("a\nb\r\nc", "%", "`?", '"', "a--b''c", "日本"),
)


@pytest.mark.parametrize("name", NAMES)
def test_hostile_names_are_escaped(name: str) -> None:
    plain, table = (
        checked(latex_table([result(scored_view("lattice/0000"), method=method), example()], published=True))
        for method in ("x", name)
    )
    assert "\\input" not in table
    assert "\r" not in table
    assert len(table.splitlines()) == len(plain.splitlines())


@settings(max_examples=30)
@given(st.text(max_size=40))
def test_any_name_gives_valid_latex(name: str) -> None:
    checked(latex_table([result(scored_view("lattice/0000"), method=name)], published=False))


def test_escape_latex_known_cases() -> None:
    assert escape_latex(r"a_b\c") == r"a\_b\textbackslash{}c"
    assert escape_latex("[x]*") == "{[}x{]}{*}"
    assert escape_latex("my-model, v2--x---y") == "my-model, v2-{}-x-{}-{}-y"
    assert escape_latex("a\nb\u202e") == "a?b?"


def test_mixed_datasets_and_no_results_are_refused() -> None:
    first = result(scored_view("lattice/0000"))
    other = dataclasses.replace(first, dataset=DatasetIdentity("sha256:" + "0" * 64, "1"))
    with pytest.raises(InputError, match=r"results of 2 datasets \(sha256:000000000000, sha256:fedc"):
        latex_table([first, other], published=False)
    with pytest.raises(InputError, match=r"results of 0 datasets \(no result\), expected one"):
        latex_table([], published=True)
