"""LaTeX table of results: layout, escaping, bold values and published rows."""

from __future__ import annotations

import dataclasses
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rebar_depth_bench.base.errors import InputError
from rebar_depth_bench.reporting.latex import escape_latex, latex_table
from rebar_depth_bench.scoring.result import DatasetIdentity, Result
from rebar_depth_bench.submission.declaration import NOT_DECLARED, Declaration
from tests.bench.reporting.results import HOSTILE, overflowed_view, result, scored_view, unpredicted_view

_COMMANDS = {
    *("begin", "end", "centering", "caption", "label", "setlength", "tabcolsep", "small", "medskip", "tiny"),
    *("toprule", "midrule", "bottomrule", "cmidrule", "multicolumn", "textbf", "emph"),
    *("downarrow", "dagger", "ddagger", "mathrm", "char", "max"),
    *(
        "textbackslash",
        "textasciitilde",
        "textasciicircum",
        "textless",
        "textgreater",
        "textbar",
        "textasciigrave",
    ),
}


def _check_latex(table: str) -> str:
    """Check braces, commands, environments, column counts and line breaks of a table, and return it."""
    depth = 0
    for token in re.findall(r"\\.|[{}]", table, re.DOTALL):
        depth += {"{": 1, "}": -1}.get(token, 0)
        assert depth >= 0
    assert depth == 0
    comment, _, rest = table.partition("\n")
    assert comment == r"% needs \usepackage{booktabs}"
    assert set(re.findall(r"\\([A-Za-z]+)", re.sub(r"\\\\", "", rest))) <= _COMMANDS
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


def _two_results() -> list[Result]:
    first = result(
        *[scored_view(f"lattice/{i:04d}", abs_rel=0.02) for i in range(8)], scored_view("pier/0000"), method="a_b"
    )
    second = result(
        *[scored_view(f"lattice/{i:04d}", abs_rel=0.03) for i in range(8)], unpredicted_view("pier/0000")
    )
    return [first, second]


def test_layout_matches_paper() -> None:
    table = _check_latex(latex_table(_two_results(), published=False))
    assert r" & \multicolumn{5}{c}{lattice (0.22--0.43 m)} & \multicolumn{5}{c}{pier (8--17 m)} \\" in table
    heads = r"$E$ $\downarrow$ & RMSE $\downarrow$ & AbsRel $\downarrow$ & AbsRel$_s$ $\downarrow$ & $s$"
    assert rf"Method & {heads} & {heads} \\" in table
    assert r"\cmidrule(lr){2-6} \cmidrule(lr){7-11}" in table
    assert (
        r"my model & 0.0291 & \textbf{20.09} & 0.0300 & \textbf{0.0613} & 0.625 & 1.0000 & -- & -- & -- & -- \\"
        in table
    )
    best = r"\textbf{0.0196} & \textbf{20.09} & \textbf{0.0200} & \textbf{0.0613} & 0.625"
    assert rf"a\_b & {best} & \textbf{{0.4286}} & 20.09" in table
    assert table.index(r"a\_b &") < table.index("my model &") < table.index(r"\emph{constant} & ")
    assert r"\emph{constant} &  &  &  & 0.0571 &  &  &  &  & 0.0571 &  \\" in table
    assert r"\emph{one pixel} &  & 0.71 & 0.0062 &  &  &" in table
    assert "Published" not in table
    assert "FoundationStereo" not in table


def test_caption_states_protocol_views_and_alignment() -> None:
    table = latex_table(_two_results(), published=False)
    for stated in (
        *("protocol rebar-2", "lattice 8 views, pier 1 view.", "dataset 1.2.3 (sha256:fedcba9876543210)"),
        *("native, without any alignment", r"s = \mathrm{med}(\mathrm{GT})/\mathrm{med}(\mathrm{pred})"),
        r"mean over all scored pixels of $|p - z| / \max(p, z)$",
    ):
        assert stated in table
    assert "dagger" not in latex_table([result(scored_view("lattice/0000"))], published=False)


def test_declarations_are_marked() -> None:
    views = [scored_view(f"lattice/{i:04d}") for i in range(8)]
    truth = result(*views, method="truth", declared=Declaration("rgb", uses_ground_truth=True))
    unknown = result(*views, method="unknown", declared=NOT_DECLARED)
    table = _check_latex(latex_table([truth, unknown], published=False))
    assert r"truth & 0.4286$^{\ddagger}$ & " in table
    assert r"unknown$^{?}$ & 0.4286 & " in table
    assert r"$^{\ddagger}$Not ranked (declares the use of ground truth)" in table
    assert "$^{?}$Use of ground truth not declared" in table
    assert "textbf" not in table, "one row is ranked"


def test_published_rows_are_verbatim_and_never_bold() -> None:
    results = [
        dataclasses.replace(entry, submission=dataclasses.replace(entry.submission, method=name))
        for entry, name in zip(_two_results(), "ab", strict=True)
    ]
    table = _check_latex(latex_table(results, published=True))
    own, _, paper = table.partition(r"\emph{Published, measured on the authors' renders")
    assert r"Depth Pro &  & 91.19 & 3.145 & 0.029 & 0.25 &  & 1151 & 0.901 & 0.179 & 12.17 \\" in paper
    assert (
        r"COLMAP+ArUco &  & 1.60 & 0.021 & 0.028 & 1.01 &  & 206.7$^{\dagger}$ & 0.078 & 0.083 & 0.98 \\" in paper
    )
    assert "1143" in paper
    assert "textbf" not in paper
    assert r"\textbf{20.09}" in own, "although the paper has 1.13"
    assert "Table I, not ranked." in own
    assert r"$^{\dagger}$Median-anchored to ground truth" in own


def test_no_published_rows_for_scene_not_in_paper() -> None:
    assert "Published" not in _check_latex(latex_table([result(scored_view("beam_1/0000"))], published=True))
    mixed = _check_latex(
        latex_table([result(scored_view("beam_1/0000"), scored_view("pile/0000"))], published=True)
    )
    assert r"Depth Pro & -- & -- & -- & -- & -- &  & 15.46 & 0.262 & 0.043 & 0.92 \\" in mixed
    assert "dagger" not in mixed.split(r"\begin{tabular}")[1]


def test_single_results_and_incomparable_errors_are_not_bold() -> None:
    assert "textbf" not in latex_table(_two_results()[:1], published=True)
    low = result(*[scored_view(f"lattice/{i:04d}", abs_rel=0.001, coverage=0.5) for i in range(8)], method="gaps")
    table = _check_latex(latex_table([*_two_results(), low], published=False))
    line = next(line for line in table.splitlines() if line.startswith("gaps"))
    assert line.startswith(r"gaps & 0.5005 & 20.09 & 0.0010 &")
    assert r"\emph{constant} &  &  &  & 0.0571 &" in table
    assert r"\emph{constant, gaps} &  &  &  & 0.0529 &  &  &  &  &  &  \\" in table
    lattice = [
        row.split(" & ")[1:6] for row in table.splitlines() if row.startswith(("gaps", "my model", r"a\_b"))
    ]
    assert [cell for row in lattice for cell in row if "textbf" in cell] == [r"\textbf{0.0196}"]


def test_many_configs_split_into_several_tabulars() -> None:
    names = ("lattice", "pile", "pier", "beam")
    views = [scored_view(f"{name}/{12 * i:04d}") for name in names for i in range(8)]
    table = _check_latex(latex_table([result(*views)], published=True))
    assert table.count(r"\begin{tabular}") == 2
    assert table.count(r"\begin{table*}") == 1
    with_intervals = _check_latex(latex_table([result(*views)], published=True, intervals=True))
    assert with_intervals.count(r"\begin{tabular}") == 4
    assert r"0.7500 {\tiny[0.7500, 0.7500]}" in with_intervals
    assert r"95\,\% intervals, block bootstrap over views" in with_intervals
    assert "tiny" not in table


@pytest.mark.parametrize(
    "name",
    [
        HOSTILE,
        r"\end{tabular}\input{/etc/passwd}",
        *(
            "100% & more",
            "a_b^c~d#e$f{g}h}i{",
            "[2cm]",
            "*",
            "\\",
            "\\\\",
            "a\nb\r\nc",
            "%",
            "`?",
            '"',
            "a--b''c",
            "日本",
        ),
    ],
)
def test_hostile_names_are_escaped(name: str) -> None:
    table = _check_latex(
        latex_table([result(scored_view("lattice/0000"), method=name), *_two_results()], published=True)
    )
    assert "\\input" not in table
    assert "\r" not in table
    plain = latex_table([result(scored_view("lattice/0000"), method="x"), *_two_results()], published=True)
    assert len(table.splitlines()) == len(plain.splitlines())


@given(st.text(max_size=40))
def test_any_name_gives_valid_latex(name: str) -> None:
    _check_latex(latex_table([result(scored_view("lattice/0000"), method=name)], published=False))


def test_escape_latex_known_cases() -> None:
    assert escape_latex(r"a_b\c") == r"a\_b\textbackslash{}c"
    assert escape_latex("[x]*") == "{[}x{]}{*}"
    assert escape_latex("my-model, v2--x---y") == "my-model, v2-{}-x-{}-{}-y"
    assert escape_latex("a\nb\u202e") == "a?b?"


def test_overflowed_values_are_dashes() -> None:
    table = _check_latex(latex_table([result(overflowed_view("pier/0000"))], published=False))
    assert r"my model & 1.0000 & -- & 1.0e+200 & 0.0613" in table


def test_mixed_datasets_and_no_results_raise() -> None:
    first, second = _two_results()
    other = dataclasses.replace(second, dataset=DatasetIdentity("sha256:" + "0" * 64, "1"))
    with pytest.raises(InputError, match=r"results of 2 datasets \(sha256:000000000000, sha256:fedc"):
        latex_table([first, other], published=False)
    with pytest.raises(InputError, match=r"results of 0 datasets \(no result\), expected one"):
        latex_table([], published=True)
