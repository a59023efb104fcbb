"""Notebooks of the documentation: stored without outputs, executed on the small dataset, and their results."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

import rebar_depth_bench as rdb
from tests.conftest import TINY_DATASET

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def read(name: str) -> Any:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)  # type: ignore[no-untyped-call]


def contents(folder: Path) -> dict[Path, str]:
    return {path: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.rglob("*") if path.is_file()}


def execute(
    name: str, values: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[Any, dict[str, Any]]:
    """Execute a notebook in its folder; return it and the values of expressions at its end.

    Temporary files of the notebook are in ``tmp_path``; a change of the notebooks' folder or of the dataset fails.
    """
    monkeypatch.setenv("REBAR_NOTEBOOK_DATA", str(TINY_DATASET))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = read(name)
    entries = ", ".join(f"{key!r}: {expression}" for key, expression in values.items())
    notebook.cells.append(
        nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({{{entries}}}))")  # type: ignore[no-untyped-call]
    )
    before = contents(FOLDER), contents(TINY_DATASET)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    assert (contents(FOLDER), contents(TINY_DATASET)) == before
    (output,) = notebook.cells.pop().outputs
    return notebook, json.loads(output.text)


def pictures(notebook: Any) -> int:
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert not [output for output in outputs if output.output_type == "error"]
    return sum("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_is_stored_without_outputs(name: str) -> None:
    notebook = read(name)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert code
    assert not [cell.id for cell in code if cell.outputs or cell.execution_count is not None]
    assert notebook.metadata.kernelspec.name == "python3"
    assert set(notebook.metadata.language_info) == {"name"}, "versions of the author's kernel"


def test_index_lists_every_notebook() -> None:
    page = (FOLDER / "index.md").read_text()
    (toctree,) = re.findall(r"```\{toctree\}\n(.*?)```", page, flags=re.DOTALL)
    assert sorted(line for line in toctree.split() if not line.startswith(":")) == NOTEBOOKS
    assert sorted(re.findall(r"\]\((\w+)\.ipynb\)", page)) == NOTEBOOKS


@pytest.mark.slow
def test_inspected_bars_and_crossings_lie_on_the_steel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook, values = execute(
        "load_and_inspect",
        {
            "view": "row['view_id']",
            "bars": "len(bars)",
            "middles": "[project(axis_m.mean(0)[None])[0][0].tolist() for axis_m in bars['axis_m']]",
            "ties": "uv[is_visible].tolist()",
            "hidden": "int((~is_visible).sum())",
        },
        tmp_path,
        monkeypatch,
    )
    assert pictures(notebook) == 3
    (mask,) = (row["left_mask"] for row in rdb.load(TINY_DATASET, "lattice") if row["view_id"] == values["view"])
    assert values["bars"] == len(rdb.bars(TINY_DATASET).query("scene == 'lattice'"))
    crossings = rdb.crossings(TINY_DATASET).query("scene == 'lattice'")
    assert len(values["ties"]) + values["hidden"] == len(crossings)
    assert 0 < len(values["ties"]) < values["hidden"]
    for points in (values["middles"], values["ties"]):
        u, v = np.rint(points).astype(int).T
        # Among straight bars, the middle of an axis may be seen through a gap of the lattice.
        assert mask[v, u].mean() > 0.9


@pytest.mark.slow
def test_wrong_scale_changes_native_numbers_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cv2")
    notebook, values = execute(
        "score_and_read",
        {
            "table": "table.droplevel(1)[columns].to_dict('index')",
            "archive": "str(archives['stereo'])",
            "views": "views.set_index('view_id')['distance_m'].to_dict()",
            "medians": "by_distance[0.5].tolist()",
        },
        tmp_path,
        monkeypatch,
    )
    assert pictures(notebook) == 1
    stereo, scaled = values["table"]["stereo"], values["table"]["stereo x 1.25"]
    assert scaled["scaled_abs_rel"] == pytest.approx(stereo["scaled_abs_rel"], rel=1e-5)
    assert scaled["scale_median"] == pytest.approx(stereo["scale_median"] / 1.25)
    assert stereo["rank_error"] < 0.2 < scaled["rank_error"]
    table = rdb.score(values["archive"], TINY_DATASET).tables["lattice"]
    assert stereo["rank_error"] == pytest.approx(table.rank_error)
    assert sorted(values["views"]) == sorted(rdb.load(TINY_DATASET, "lattice", columns=["view_id"])["view_id"])
    assert min(values["views"].values()) > 0.15
    assert len(values["medians"]) >= 10
    assert 0 < np.median(values["medians"]) < 30


def test_own_cage_has_the_bars_of_its_file(blender: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    notebook, values = execute(
        "own_cage",
        {
            "diameters": "bars['diameter_m'].tolist()",
            "wanted": "[diameter / 1000 for _, diameter, _ in BARS]",
            "pixels": "pixels",
            "depths": "[float(steel_m.min()), float(steel_m.max())]",
            "files": "sorted(path.name for path in folder.iterdir())",
        },
        tmp_path,
        monkeypatch,
    )
    assert pictures(notebook) == 2
    assert values["diameters"] == values["wanted"]
    assert len(values["pixels"]) == 3
    assert all(count > 100 for counts in values["pixels"].values() for count in counts)
    # The cameras are 0.3 m from the middle of the cage, which is 0.24 m long.
    assert 0.3 - 0.15 < values["depths"][0] < values["depths"][1] < 0.3 + 0.15
    assert values["files"] == ["cage.png", "dataset", "my-beam.toml"]
