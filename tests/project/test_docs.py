"""Documentation: commands parse, Python examples run, and tables, links and pictures are correct."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterator
from contextlib import redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from _pytest.mark.structures import ParameterSet

from dataset_builder.catalog.named_configs import CONFIGS, SWEEPS
from dataset_builder.cli.main import argument_parser as build_parser
from dataset_builder.cli.main import with_command
from dataset_builder.importing import import_layout
from dataset_builder.scene.variants.registry import VARIANTS
from dataset_builder.user_files.scene_schema import read_scene_toml
from leaderboard.cli import argument_parser as board_parser
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_SCHEMA
from rebar_depth_bench.cli.demo import SAMPLE
from rebar_depth_bench.cli.main import argument_parser as bench_parser
from rebar_depth_bench.cli.main import main as bench_main
from rebar_depth_bench.data.bars import BARS_SCHEMA
from rebar_depth_bench.methods import find_method, own_methods
from rebar_depth_bench.methods.onnx.spec import OUTPUT_MEANINGS, read_onnx_toml
from rebar_depth_bench.submission import SubmissionMeta
from scripts.diagrams import PACKAGE_EDGES, diagrams
from scripts.tables import PAGES as PAGES_WITH_TABLES
from scripts.tables import TABLES, with_tables
from tests.bench.methods.predictors import load_predictor
from tests.project.pages import (
    DOCS,
    PAGES,
    ROOT,
    anchors,
    blocks,
    first_column,
    inline_code,
    local_links,
    name_of,
    python_blocks,
    shell_lines,
)

CURRENT_PAGES = [page for page in PAGES if page.name != "CHANGELOG.md"]
"""Pages about this version; the changelog also names what earlier versions had."""
PACKAGES = ("dataset_builder", "rebar_depth_bench", "leaderboard", "cards")
PARSERS: dict[str, ArgumentParser] = {
    "rebar-build": build_parser(),
    "rebar-bench": bench_parser(),
    "rebar-leaderboard": board_parser(),
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def commands(start: str | tuple[str, ...]) -> list[str]:
    lines = [line for page in PAGES for line in shell_lines(page)]
    return sorted({line for line in lines if line.startswith(start)})


@pytest.mark.parametrize("command", [*commands(tuple(PARSERS)), *commands("python examples/paper/")])
def test_documented_commands_parse(command: str) -> None:
    program, *arguments = shlex.split(command, comments=True)
    if program == "python":
        script, *arguments = arguments
        parser = import_module(Path(script).stem).argument_parser()
    else:
        parser = PARSERS[program]
    assert parser.parse_args(with_command(arguments) if program == "rebar-build" else arguments)


def subparsers(parser: ArgumentParser) -> dict[str, ArgumentParser]:
    actions = [action for action in parser._actions if isinstance(action, _SubParsersAction)]
    return {name: sub for action in actions for name, sub in action.choices.items()}


def unknown_words(parser: ArgumentParser, words: list[str]) -> Iterator[str]:
    """Yield the subcommand or the options of a mentioned command that its parser does not know."""
    while (choices := subparsers(parser)) and words and re.fullmatch(r"[a-z][a-z-]+", words[0]):
        name, *words = words
        if name not in choices and parser is not PARSERS["rebar-build"]:
            yield name
            return
        parser = choices.get(name, parser)
    # A program may be mentioned with the options of its commands.
    known = {option for one in (parser, *subparsers(parser).values()) for option in one._option_string_actions}
    yield from (word for word in words if word.startswith("-") and word != "-" and word not in known)


@pytest.mark.parametrize("page", CURRENT_PAGES, ids=name_of)
def test_mentioned_commands_and_options_exist(page: Path) -> None:
    mentioned = [code.split() for code in inline_code(page) if code.split()[:1] and code.split()[0] in PARSERS]
    assert [(words, list(unknown_words(PARSERS[words[0]], words[1:]))) for words in mentioned] == [
        (words, []) for words in mentioned
    ]


def test_documented_modules_scripts_and_make_targets_exist() -> None:
    lines = [line for page in PAGES for line in [*shell_lines(page), *inline_code(page)]]
    code = "\n".join(lines)
    assert all(find_spec(module) for module in re.findall(r"python -m ([\w.]+)", code))
    assert all((ROOT / script).is_file() for script in re.findall(r"python ((?:examples|scripts)/[\w./]+)", code))
    targets = set(re.findall(r"^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    shown = {match[1] for line in lines if (match := re.match(r"make ([a-z-]+)\b", line))}
    assert {"demo", "docs", "test"} <= shown <= targets


def test_extras_are_installed_from_the_repository_and_listed() -> None:
    text = "\n".join(page.read_text() for page in CURRENT_PAGES)
    sources = [
        path for package in PACKAGES for path in (ROOT / package).rglob("*.*") if "__pycache__" not in str(path)
    ]
    shown = text + "".join(path.read_text("utf-8", errors="ignore") for path in sources)
    assert not re.findall(r"pip install.{,3}rebar-depth-bench", shown)
    extras = set(PROJECT["optional-dependencies"])
    assert {name for group in re.findall(r"\.\[([\w,]+)\]'", text) for name in group.split(",")} <= extras
    assert set(first_column(DOCS / "quick-start.md")) == extras


def pages_with_python() -> list[ParameterSet]:
    """Return the pages with Python; those that predict the sample or import 96 views take seconds."""
    slow = dict.fromkeys(("README.md", "docs/score.md", "docs/score-by-hand.md"), pytest.mark.slow)
    pages = {name_of(page): page for page in PAGES if blocks(page, "python")}
    assert {"README.md", "docs/score.md"} <= set(pages)
    return [pytest.param(page, id=name, marks=slow.get(name, ())) for name, page in pages.items()]


@pytest.mark.parametrize("page", pages_with_python())
def test_documented_python_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo-output" / "sample").mkdir(parents=True)
    (tmp_path / "demo-output" / "sample" / "dataset").symlink_to(SAMPLE)
    names: dict[str, object] = {}
    for block, output in python_blocks(page):
        with redirect_stdout(StringIO()) as printed:
            exec(block.replace("(480, 640)", "(48, 64)"), names)
        assert not output or printed.getvalue() == output
    assert name_of(page) not in ("README.md", "docs/score.md") or any(output for _, output in python_blocks(page))
    for line in shell_lines(page):
        if "demo-output/sample/dataset" in line and line.startswith("rebar-bench"):
            program, *arguments = shlex.split(line, comments=True)
            assert (program, bench_main(arguments)) == ("rebar-bench", 0)
    writes = any("submission.zip" in block for block in blocks(page, "python"))
    assert (tmp_path / "submission.zip").is_file() == writes
    if "loader" in names:
        batch = next(iter(names["loader"]))  # type: ignore[call-overload]
        assert {"rgb", "depth", "mask", "K", "poses", "view_id", "right_rgb", "baseline_m"} <= set(batch)


def test_method_template_works(tmp_path: Path) -> None:
    [template] = blocks(DOCS / "methods.md", "py")
    path = tmp_path / "my_model.py"
    path.write_text(f"load_my_model = lambda: lambda rgb, K: rgb[..., 0] * K[0, 0]\n{template}")
    method = find_method(f"{path}:METHOD")
    row = {"left_rgb": np.full((2, 3, 3), 2.0), "left_K": 5 * np.eye(3)}
    assert load_predictor(method)(row).tolist() == [[10.0] * 3] * 2
    assert set(method.info.columns) == set(row)


def test_tables_list_what_the_code_has() -> None:
    text = {name: (DOCS / f"{name}.md").read_text() for name in ("build", "methods", "formats")}
    listed = {name: set(first_column(DOCS / f"{name}.md")) for name in text}
    configs = {name for name in listed["build"] - {*VARIANTS} if not name.startswith("--")}
    assert configs == {*CONFIGS, *SWEEPS}
    assert listed["methods"] == {*own_methods(), *OUTPUT_MEANINGS}
    columns = {*BARS_SCHEMA.names, *CROSSINGS_SCHEMA.names}
    assert columns | set(SubmissionMeta.model_fields) <= listed["formats"]
    assert all(f"| `{name}` | {item.description} |" in text["methods"] for name, item in OUTPUT_MEANINGS.items())


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_local_links_and_anchors_exist(page: Path) -> None:
    for path, anchor in local_links(page):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        assert not anchor or anchor in anchors(target), f"{path}#{anchor}"


def test_documented_toml_and_json_are_valid(tmp_path: Path) -> None:
    layouts = [
        *blocks(DOCS / "import.md", "toml"),
        (import_layout.__doc__ or "").split("```")[1].removeprefix("toml"),
    ]
    scenes = blocks(DOCS / "cages.md", "toml")
    assert layouts
    assert scenes
    for layout in layouts:
        (tmp_path / "layout.toml").write_text(layout)
        assert import_layout.read_layout(tmp_path / "layout.toml").truth_sigma_m > 0
    for scene in scenes:
        is_rig = scene.startswith("calibration")  # The keys of [rig] in a file of their own.
        assert read_scene_toml((f'ifc = "cage.ifc"\n[rig]\n{scene}' if is_rig else scene).encode(), "page")
    [model] = blocks(DOCS / "methods.md", "toml")
    (tmp_path / "my_model.toml").write_text(model)
    (tmp_path / "model.onnx").touch()
    assert read_onnx_toml(tmp_path / "my_model.toml").name == "my_model"
    assert all(tomllib.loads(block) for page in PAGES for block in blocks(page, "toml"))
    assert all(json.loads(block) for page in PAGES for block in blocks(page, "json"))


def test_architecture_table_has_the_edges_of_the_diagram() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", (ROOT / "ARCHITECTURE.md").read_text(), flags=re.MULTILINE)
    assert [name for name, _ in rows] == ["rebar_depth_bench", "dataset_builder", "leaderboard", "cards"]
    edges = {(name, imported) for name, cell in rows for imported in re.findall(r"`(\w+)`", cell)}
    assert edges == set(PACKAGE_EDGES)


def test_diagrams_are_current() -> None:
    stored = {name: (DOCS / "pictures" / name).read_text() for name in diagrams()}
    assert stored == diagrams(), "write them: python -m scripts.diagrams docs/pictures"


def test_generated_tables_are_current() -> None:
    stored = {name_of(page): page.read_text() for page in PAGES_WITH_TABLES}
    assert stored == {name: with_tables(text) for name, text in stored.items()}, "write them: make tables"
    marks = re.findall("<!-- table: (.+) -->", "".join(page.read_text() for page in PAGES))
    assert sorted(marks) == sorted(TABLES)


def test_pictures_are_used() -> None:
    text = "\n".join(page.read_text() for page in PAGES)
    for picture in (DOCS / "pictures").iterdir():
        assert f"pictures/{picture.name}" in text
