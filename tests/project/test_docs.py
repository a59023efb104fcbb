"""Documentation: commands parse, Python examples run, and tables and links are correct."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from argparse import ArgumentParser
from pathlib import Path

import numpy as np
import pytest

from cards.reference import FULL_SETS, reference_context
from dataset_builder.cli import argument_parser as build_parser
from dataset_builder.config.catalog import CONFIGS, SWEEPS
from dataset_builder.importing.layout import read_layout
from dataset_builder.scene.variants import VARIANTS
from leaderboard.cli import argument_parser as board_parser
from leaderboard.settings import Settings
from rebar_depth_bench.cli.main import argument_parser as bench_parser
from rebar_depth_bench.limits import LIMITS, Limit
from rebar_depth_bench.methods import find_method, own_methods
from scripts.diagrams import diagrams
from tests.bench.methods.predictors import load_predictor

DOCS = sorted(Path("docs").rglob("*.md"))
PAGES = [
    Path("README.md"),
    Path("CONTRIBUTING.md"),
    Path("ARCHITECTURE.md"),
    Path("SECURITY.md"),
    Path("cards/BENCHMARK.md"),
    Path("deploy/README.md"),
    *DOCS,
]
PARSERS: dict[str, ArgumentParser] = {
    "rebar-build": build_parser(),
    "rebar-bench": bench_parser(),
    "rebar-leaderboard": board_parser(),
}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.DOTALL)


def commands() -> list[str]:
    """Return the commands of all pages: lines of blocks, and inline ones that have arguments."""
    lines = [line for page in PAGES for block in blocks(page, "sh") for line in block.splitlines()]
    inline = [
        " ".join(command.split())
        for page in (Path("README.md"), *DOCS)
        for command in re.findall(r"`(rebar-(?:build|bench|leaderboard) [^`]*)`", page.read_text())
    ]
    with_arguments = [command for command in inline if len(command.split()) > 3]
    return [line for line in [*lines, *with_arguments] if line.startswith(tuple(PARSERS))]


@pytest.mark.parametrize("command", commands())
def test_documented_commands_parse(command: str) -> None:
    program, *arguments = shlex.split(command, comments=True)
    assert PARSERS[program].parse_args(arguments)


@pytest.mark.parametrize("page", [Path("README.md"), Path("docs/score.md")], ids=str)
def test_documented_python_runs(
    tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, page: Path
) -> None:
    text = "".join(blocks(page, "python"))
    shown = text.replace('"demo-output/dataset"', repr(str(tiny_root))).replace("(480, 640)", "(48, 64)")
    assert repr(str(tiny_root)) in shown
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"my_model": lambda rgb, K: np.full(rgb.shape[:2], K[0, 0] / 200)}
    exec(shown, names)
    assert (tmp_path / "submission.zip").is_file()
    if "loader" in names:
        batch = next(iter(names["loader"]))  # type: ignore[call-overload]
        assert {"rgb", "depth", "mask", "K", "poses", "view_id", "right_rgb", "baseline_m"} <= set(batch)


def test_method_template_works(tmp_path: Path) -> None:
    [template] = blocks(Path("docs/methods.md"), "py")
    path = tmp_path / "my_model.py"
    path.write_text(f"load_my_model = lambda: lambda rgb, K: rgb[..., 0] * K[0, 0]\n{template}")
    method = find_method(f"{path}:METHOD")
    row = {"left_rgb": np.full((2, 3, 3), 2.0), "left_K": 5 * np.eye(3)}
    assert load_predictor(method)(row).tolist() == [[10.0] * 3] * 2
    assert set(method.info.columns) == set(row)


def test_results_in_readme_are_those_of_the_card() -> None:
    rows = re.findall(r"^\| [\w -]+, [\d.]+-[\d.]+ m \| (.*) \|$", Path("README.md").read_text(), re.MULTILINE)
    expected = []
    for config in FULL_SETS:
        context = reference_context(config)
        row = next(row for row in context["rows"][config] if row["method"] == "sgbm")
        errors = context["errors"][config]
        cells = (*(row[key] for key in ("coverage", "abs_rel", "scaled", "within")), errors["constant"][0])
        expected.append(" | ".join((*cells, errors["one_pixel"][0])))
    assert rows == expected


def test_leaderboard_settings_table_matches_code() -> None:
    page = Path("docs/leaderboard-operator.md").read_text()
    for name, field in Settings.model_fields.items():
        default = "" if field.is_required() or field.default == "" else f"`{field.default}`"
        assert f"| `{name}` | {default} | {field.description} |" in page


def test_tables_list_configs_variants_and_methods() -> None:
    build, methods = (Path(f"docs/{name}.md").read_text() for name in ("build", "methods"))
    assert table_names(build) == {*CONFIGS, *SWEEPS, *VARIANTS}
    assert table_names(methods.partition("## Your own model")[0]) == set(own_methods())
    assert all(f"| `{variant.name}` | {variant.description} |" in build for variant in VARIANTS.values())


def table_names(text: str) -> set[str]:
    return set(re.findall(r"^\| `([\w-]+)` \|", text, flags=re.MULTILINE))


def test_extras_are_documented() -> None:
    extras = tomllib.loads(Path("pyproject.toml").read_text())["project"]["optional-dependencies"]
    rows = re.findall(r"^\| (`[\w`, ]+`) \|", Path("docs/quick-start.md").read_text(), flags=re.MULTILINE)
    assert {name for row in rows for name in re.findall(r"\w+", row)} == {*extras} - {"test"}
    used = {
        name
        for page in PAGES
        for names in re.findall(r"'\.\[([\w,]+)\]'", page.read_text())
        for name in names.split(",")
    }
    assert used <= set(extras)


@pytest.mark.parametrize("language", ["json", "toml"])
def test_documented_files_can_be_parsed(language: str) -> None:
    parse = {"json": json.loads, "toml": tomllib.loads}[language]
    assert [parse(block) for page in DOCS for block in blocks(page, language)]


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_local_links_exist(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text())
    assert all((page.parent / link).exists() for link in links if "://" not in link)


def test_documented_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):.*##", Path("Makefile").read_text(), flags=re.MULTILINE))
    shown = {name for page in PAGES for name in re.findall(r"\bmake ([a-z-]+)\b(?:`|\s+#)", page.read_text())}
    assert {"demo", "test"} <= shown <= targets


def test_security_lists_every_limit() -> None:
    page = Path("SECURITY.md").read_text()
    rows = re.findall(r"^\| `(REBAR_MAX_\w+)` \| (.*?) \| (.*?) \|$", page, re.MULTILINE)
    assert rows == [(limit.variable, default_text(limit), limit.description) for limit in LIMITS]


def default_text(limit: Limit) -> str:
    """Return the default of a limit as the table shows it: ``64 MiB``, ``1800 s`` or a plain number."""
    if not limit.name.endswith("_bytes"):
        return f"{limit.default:,} {limit.name.rpartition('_')[2]}"
    power = 3 if limit.default % (1 << 30) == 0 else 2
    return f"{limit.default >> (10 * power)} {('B', 'KiB', 'MiB', 'GiB')[power]}"


def test_documented_layout_files_are_valid(tmp_path: Path) -> None:
    for block in blocks(Path("docs/import.md"), "toml"):
        path = tmp_path / "layout.toml"
        path.write_text(block)
        assert read_layout(path).truth_sigma_m > 0


def test_diagrams_are_up_to_date() -> None:
    assert {name: Path("docs/pictures", name).read_text() for name in diagrams()} == diagrams()
