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
from rebar_depth_bench.scoring.comparison import compare
from rebar_depth_bench.scoring.result import DatasetIdentity
from tests.bench.reporting.results import HOSTILE, example, examples, result, scored_view

COMMANDS = {
    *("begin", "end", "centering", "caption", "label", "setlength", "tabcolsep", "small", "medskip", "tiny"),
    *("toprule", "midrule", "bottomrule", "cmidrule", "multicolumn", "textbf", "emph", "downarrow", "dagger"),
    *("ddagger", "mathrm", "char", "max", "textbackslash", "textasciitilde", "textasciicircum", "textless"),
    *("textgreater", "textbar", "textasciigrave", "uparrow", "footnotesize", "texttt"),
}
"""Commands that a table may contain."""


def checked(table: str) -> str:
    """Check braces, commands, environments, column counts and line breaks of a table, and return it."""
    depth = 0
    for token in re.findall(r"\\.|[{}]", table, re.DOTALL):
        depth += {"{": 1, "}": -1}.get(token, 0)
        assert depth >= 0
    assert depth == 0
    comments, begin, rest = table.partition(r"\begin{table*}")
    assert comments.startswith("% needs \\usepackage{booktabs}\n% rebar-")
    assert all(line.startswith("% ") for line in comments.splitlines())
    rest = begin + rest
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
    assert r"Depth Pro &  &  &  & 15.46 & 0.262 & 0.043 & 0.92 \\" in checked(mixed)
    anchored = checked(latex_table([result(scored_view("pier/0000"))], published=True))
    row = next(line for line in anchored.splitlines() if line.startswith("COLMAP+ArUco"))
    assert [cell.count(r"$^{\dagger}$") for cell in row.split(" & ")[4:]] == [1, 1, 1, 1]
    assert "dagger" not in mixed.split(r"\begin{tabular}")[1]


def bold_rows(table: str) -> dict[str, list[str]]:
    """Return the bold numbers of each row that has any."""
    rows = (line.split(" & ") for line in table.splitlines() if " & " in line)
    return {cells[0]: bold for cells in rows if (bold := re.findall(r"\\textbf\{(.*?)\}", " ".join(cells)))}


def test_best_error_is_bold_only_among_comparable_results() -> None:
    """With a result that has gaps, only the rank error, which counts them, is compared."""
    [good, fair, gaps] = [
        result(*(scored_view(f"lattice/{12 * i:04d}", error, coverage) for i in range(8)), method=name)
        for name, error, coverage in (("good", 0.02, 1.0), ("fair", 0.03, 1.0), ("gaps", 0.001, 0.5))
    ]
    assert "textbf" not in latex_table([good], published=True)
    pair = checked(latex_table([fair, good], published=True))
    assert bold_rows(pair) == {"good": ["0.0196", "0.0200"]}, "their RMSE is equal"
    assert "Bold" in pair
    assert "constant, gaps" not in pair
    table = checked(latex_table([good, fair, gaps], published=False))
    assert r"\emph{constant, gaps} &  &  &  &  &  & 0.0529 &  \\" in table
    assert bold_rows(table) == {"good": ["0.0196"]}


def test_numbers_that_compare_leaves_undecided_are_not_bold() -> None:
    """The lower mean is bold where the difference is alike in all views, not where it changes its sign."""
    steady, lower, mixed = (
        result(*(scored_view(f"lattice/{12 * i:04d}", error + (-1) ** i * change) for i in range(8)), method=name)
        for name, error, change in (("steady", 0.030, 0.0), ("lower", 0.028, 0.0), ("mixed", 0.026, 0.02))
    )
    for other, verdict in ((lower, "better"), (mixed, "undecided")):
        rows = {row.column.place: row.verdict for row in compare(steady, other).configs["lattice"]}
        assert rows["native.abs_rel"] == verdict
    assert list(bold_rows(latex_table([steady, lower], published=False))) == ["lower"]
    undecided = latex_table([steady, lower, mixed], published=False)
    assert "mixed &" in undecided.partition("steady &")[0], "above the others"
    assert "textbf" not in undecided
    assert "Bold" not in undecided


def test_all_numbers_of_chosen_pixels_are_marked_and_reasons_are_comments() -> None:
    whole, gaps = (
        result(*(scored_view(f"{config}/0000", coverage=share) for config in configs), method=name)
        for name, share, configs in (("whole", 1.0, ("lattice", "pile")), ("gaps", 0.5, ("lattice", "pile")))
    )
    table = checked(latex_table([whole, gaps], published=False, absent=["lattice (why)"]))
    heads = next(line for line in table.splitlines() if line.startswith("Method & ")).rstrip("\\ ").split(" & ")
    row = next(line for line in table.splitlines() if line.startswith("gaps & ")).rstrip("\\ ").split(" & ")
    marked = [head for head, cell in zip(heads, row, strict=True) if cell.endswith("$^{*}$")]
    assert marked == heads[4:], "rank error, coverage and the share within 5 mm are of all pixels"
    comments, caption = table.partition(r"\begin{table*}")[0], table.partition(r"\caption")[2].split("\n")[0]
    for reason in (r"gaps, pile (coverage 50.0 \% is below 95 \%)", "lattice (why)", whole.dataset.digest):
        assert reason in comments
        assert reason not in caption
    assert caption.count("$^{*}$") == 1


NAMES = (
    *(HOSTILE, r"\end{tabular}\input{/etc/passwd}", "100% & more", "a_b^c~d#e$f{g}h}i{", "[2cm]", "*"),
    *("\\", "\\\\", "a\nb\r\nc", "%", "`?", '"', "a--b''c", "日本"),
)


@pytest.mark.parametrize("name", NAMES)
def test_hostile_names_are_escaped(name: str) -> None:
    plain, table = (
        checked(latex_table([result(*example().views[:8], method=method), example()], published=True))
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
