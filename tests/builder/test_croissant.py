"""Croissant descriptions, read by ``mlcroissant`` without a network."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import mlcroissant
import numpy as np
import pytest

# No public name lists the terms of Croissant RAI; ``rdflib``, which ``mlcroissant`` requires, has schema.org's.
from mlcroissant._src.core import constants
from rdflib.namespace import SDO

import rebar_depth_bench as rdb
from cards.croissant import croissant
from cards.dataset import dataset_card
from dataset_builder.cli.main import main
from dataset_builder.importing.config_import import plan_import, run_import
from rebar_depth_bench.data.files import file_problems, file_sha256
from rebar_depth_bench.data.manifest import open_folder
from tests.builder.importing import source_data
from tests.builder.push.conftest import list_files, write_publishable
from tests.commands import run_in_process
from tests.hub_server import folder_files
from tests.synthetic_dataset import write_split_dataset

RAI = "http://mlcommons.org/croissant/RAI/"
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::DeprecationWarning:rdflib")]

RAI_TERMS = {
    *(str(value).removeprefix(RAI) for value in vars(constants).values() if str(value).startswith(RAI)),
    "hasSyntheticData",  # Of NeurIPS 2026; ``mlcroissant`` has the terms of Croissant RAI 1.0.
}
PROV_TERMS = {"wasDerivedFrom", "wasGeneratedBy", "label"}
NEURIPS_TERMS = {
    *("rai:dataBiases", "rai:dataLimitations", "rai:dataUseCases", "rai:dataSocialImpact"),
    *("rai:personalSensitiveInformation", "rai:hasSyntheticData", "prov:wasDerivedFrom", "prov:wasGeneratedBy"),
}
"""Fields that the track on evaluations and datasets of NeurIPS 2026 requires."""


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("connects to a network")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def rendered(_: Path, tiny_root: Path) -> Path:
    return tiny_root


def with_splits(folder: Path, _: Path) -> Path:
    write_split_dataset(folder / "dataset", {"a": "train", "b": "train", "c": "test"}, 2)
    (folder / "dataset" / "README.md").write_text("A card.\n")
    return list_files(folder / "dataset")


def without_bars(folder: Path, _: Path) -> Path:
    return write_publishable(folder / "dataset", ["lattice"])


def imported(folder: Path, tiny_root: Path) -> Path:
    source = source_data.write_source(folder, source_data.sample_rows(tiny_root), tiny_root)
    layout = source_data.write_layout(source, ("left_depth", "left_rgb"), tables="")
    run_import(plan_import(layout, "mock-up"), folder / "dataset")
    return folder / "dataset"


def described(root: Path, folder: Path, *options: str) -> tuple[Path, dict[str, Any]]:
    """Return the path of a description in a copy of a dataset folder, and its content."""
    path = Path(shutil.copytree(root, folder / "copy")) / "croissant.json"
    finished = run_in_process(main, "croissant", root, *options)
    assert finished.returncode == 0, finished.stderr
    path.write_text(finished.stdout)
    return path, json.loads(finished.stdout)


@pytest.mark.parametrize("make", [rendered, with_splits, without_bars, imported])
def test_every_table_of_a_folder_is_read(
    make: Callable[[Path, Path], Path], tiny_root: Path, tmp_path: Path
) -> None:
    root = make(tmp_path, tiny_root)
    path, _ = described(root, tmp_path)
    dataset = mlcroissant.Dataset(path)
    issues = dataset.metadata.ctx.issues
    recommended = {"datePublished"} | ({"citeAs"} if make is imported else set())
    assert not issues.errors
    assert len(issues.warnings) == len(recommended)
    assert all(any(f'/{name}"' in warning for name in recommended) for warning in issues.warnings)
    folder = open_folder(root)
    assert path.name not in {problem.where for problem in file_problems(open_folder(path.parent))}
    tables = [
        name.removesuffix(".parquet") for name in ("bars.parquet", "crossings.parquet") if name in folder.files
    ]
    assert [records.uuid for records in dataset.metadata.record_sets] == [
        "dataset/splits",
        *folder.configs,
        *tables,
    ]
    for config in folder.config_by_name.values():
        records = list(dataset.records(config.name))
        for split in config.splits:
            of_split = [record for record in records if record[f"{config.name}/split"] == split.encode()]
            rows = rdb.load(root, config.name, split=split)
            for record, row in zip(of_split, rows, strict=True):
                values = {name.rpartition("/")[2]: value for name, value in record.items()}
                assert set(values) - {"split"} == {name for name, value in row.items() if value is not None}
                assert values["view_id"].decode() == row["view_id"]
                assert np.array_equal(np.array(values["left_depth"]), row["left_depth"])
                assert np.array_equal(np.array(values["left_K"]), row["left_K"])
    for table in tables:
        assert len(list(dataset.records(table))) == len(getattr(rdb, table)(root))


@pytest.mark.parametrize("damaged", ["lattice/test-00001", "bars.parquet"])
def test_wrong_digest_is_found(damaged: str, tiny_root: Path, tmp_path: Path) -> None:
    path, description = described(tiny_root, tmp_path)
    (file,) = (file for file in description["distribution"] if file["name"].startswith(damaged))
    file["sha256"] = "0" * 64
    path.write_text(json.dumps(description))
    dataset = mlcroissant.Dataset(path)
    with pytest.raises(mlcroissant.GenerationError) as raised:
        list(dataset.records(damaged.partition("/")[0].removesuffix(".parquet")))
    assert "Hash of downloaded file" in str(raised.value.__cause__)


def unknown_keys(node: Any, context: Mapping[str, Any]) -> Iterator[str]:
    """Yield the keys of a description that no vocabulary has; ``mlcroissant`` ignores them."""
    for inner in node if isinstance(node, list) else ():
        yield from unknown_keys(inner, context)
    for key, value in node.items() if isinstance(node, dict) else ():
        prefix, _, name = key.rpartition(":")
        known = {"rai": name in RAI_TERMS, "prov": name in PROV_TERMS, "": name in context or name in SDO}
        if not key.startswith("@") and not known.get(prefix, False):
            yield key
        if key not in ("@context", "data"):
            yield from unknown_keys(value, context)


def test_keys_are_terms_of_their_vocabularies(tiny_root: Path, tmp_path: Path) -> None:
    _, description = described(tiny_root, tmp_path)
    context = description["@context"]
    assert not list(unknown_keys(description, context))
    assert set(description) >= NEURIPS_TERMS
    for misspelt in ("rai:dataBias", "prov:wasDerived", "recordSets"):
        assert list(unknown_keys([{misspelt: []}], context)) == [misspelt]


def test_addresses_are_those_of_the_repository(tiny_root: Path, tmp_path: Path) -> None:
    path, description = described(tiny_root, tmp_path, "--hub-id", "org/data")
    page = "https://huggingface.co/datasets/org/data"
    assert description["url"] == page
    *files, repository = (file for file in description["distribution"] if file["@type"] == "cr:FileObject")
    assert repository["contentUrl"] == page
    digests = {file["contentUrl"].removeprefix(f"{page}/resolve/main/"): file["sha256"] for file in files}
    assert digests == {name: file_sha256(tiny_root / name) for name in folder_files(tiny_root)}
    cloned = mlcroissant.Dataset(path, mapping={"repository": path.parent})
    assert len(list(cloned.records("lattice"))) == 9
    refused = run_in_process(main, "croissant", tiny_root, "--hub-id", "data")
    assert refused.returncode == 2
    assert "--hub-id is data" in refused.stderr
    assert not refused.stdout


def test_statements_are_those_of_the_card(tiny_root: Path, tmp_path: Path) -> None:
    _, description = described(tiny_root, tmp_path)
    card = " ".join((tiny_root / "README.md").read_text().split())
    for text in (description["rai:dataUseCases"], *description["rai:dataLimitations"], description["citeAs"]):
        assert " ".join(text.split()) in card


def test_only_what_the_manifest_has_is_stated_of_imported_data(tiny_root: Path, tmp_path: Path) -> None:
    _, description = described(imported(tmp_path, tiny_root), tmp_path)
    assert description["license"] == ["mock-up: its authors state no licence"]
    assert set(description) >= NEURIPS_TERMS - {"rai:hasSyntheticData"}
    assert "rai:hasSyntheticData" not in description
    text = json.dumps({**description, "@context": {}, "recordSet": []})
    words = ("Cycles", "creativecommons", "Maintainers", "measured", 'ynthetic"')
    assert not [word for word in words if word in text]


def test_folder_without_colour_is_not_said_to_have_images(tiny_root: Path) -> None:
    folder = open_folder(tiny_root)
    plain = [config.model_copy(update={"colour": None}) for config in folder.config_by_name.values()]
    uncoloured = folder.model_copy(update={"config_by_name": {config.name: config for config in plain}})
    card = dataset_card(folder.version, folder.digest, plain, folder.files)
    for text in (croissant(uncoloured), card):
        assert not [words for words in ("Cycles", "images are synthetic") if words in text]
    assert json.loads(croissant(uncoloured))["rai:hasSyntheticData"] is True
