"""Croissant description of a dataset folder: its files with their SHA-256, and its tables."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from cards.dataset import PRETTY_NAME
from cards.templates import render
from rebar_depth_bench.bar_crossings.crossings_file import CROSSINGS_FILE, CROSSINGS_SCHEMA
from rebar_depth_bench.data.bars import BARS_FILE, BARS_SCHEMA, read_bars
from rebar_depth_bench.data.files import MANIFEST_FILE, file_sha256
from rebar_depth_bench.data.manifest import DatasetFolder
from rebar_depth_bench.data.schema import COLUMN_DESCRIPTIONS, ROW_SCHEMA, column_kind

_PARQUET, _OTHER = "application/x-parquet", "application/octet-stream"
_MEDIA_TYPES = {".json": "application/json", ".md": "text/markdown", ".parquet": _PARQUET, ".webp": "image/webp"}
_DATA_TYPES = {
    pa.string(): "sc:Text",
    pa.float64(): "sc:Float",
    pa.uint16(): "sc:Integer",
    pa.uint32(): "sc:Integer",
}
"""Croissant's types of columns; all others hold encoded images, of which depth is one."""


def croissant(folder: DatasetFolder, hub_id: str | None = None) -> str:
    """Return the Croissant description of a dataset folder as JSON.

    The addresses of files are those of the Hub repository ``hub_id``; without one, they are paths relative to the
    JSON file, which has to be in the folder. Raises ``DatasetError`` if ``bars.parquet`` is listed but not intact.
    """
    page = f"https://huggingface.co/datasets/{hub_id}" if hub_id else "."
    statements = render("croissant.yaml.j2", folder=folder, name=PRETTY_NAME, page=page, hub_id=hub_id)
    description = yaml.safe_load(statements)
    distribution, record_sets = description["distribution"], description["recordSet"]
    manifest_sha256 = file_sha256(folder.file(MANIFEST_FILE))
    for name, sha256 in sorted({**folder.files, MANIFEST_FILE: manifest_sha256}.items()):
        file = {"encodingFormat": _MEDIA_TYPES.get(Path(name).suffix, _OTHER), "sha256": sha256}
        address = f"{page}/resolve/main/{name}" if hub_id else name
        distribution.append(_node("FileObject", name, contentUrl=address, **file))
    # The repository, or the folder, has no digest, which is mandatory.
    repository = {"contentUrl": page, "encodingFormat": "git+https", "sha256": manifest_sha256}
    repository["description"] = "All files; the SHA-256 is that of manifest.json, which has those of the others."
    distribution.append(_node("FileObject", "repository", **repository))
    for config in folder.config_by_name.values():
        shards = f"{config.name}/shards"
        containers = [{"@id": "repository"}]
        if not hub_id:  # Readers check the digests of these shards. From the Hub, they would also download them.
            containers = [*({"@id": name} for name in config.shards), *containers]
        file_set = {"containedIn": containers, "encodingFormat": _PARQUET, "includes": list(config.shards)}
        distribution.append(_node("FileSet", shards, **file_set))
        source = {"fileSet": {"@id": shards}}
        splits = f"(?:{re.escape(config.name)}/)?({'|'.join(config.splits)}).*"  # Readers also match its result.
        from_path = {"extract": {"fileProperty": "fullpath"}, "transform": {"regex": splits}}
        split = _node("Field", f"{config.name}/split", dataType="sc:Text", source={**source, **from_path})
        split["references"] = {"field": {"@id": "dataset/splits/name"}}
        columns = [column for column in ROW_SCHEMA if column.name not in config.absent_columns]
        record_sets.append(_node("RecordSet", config.name, field=[split, *_fields(config.name, columns, source)]))
    tables = {}
    if BARS_FILE in folder.files:
        bars = folder.verified_file(BARS_FILE)
        read_bars(bars)  # Refuses damaged tables.
        stored = pq.read_schema(bars).names  # The column ``nominal_axis`` may be absent.
        tables[BARS_FILE] = [column for column in BARS_SCHEMA if column.name in stored]
    if CROSSINGS_FILE in folder.files:
        tables[CROSSINGS_FILE] = list(CROSSINGS_SCHEMA)
    for file_name, columns in tables.items():
        table = Path(file_name).stem
        fields = _fields(table, columns, {"fileObject": {"@id": file_name}})
        record_sets.append(_node("RecordSet", table, field=fields))
    return json.dumps(description, indent=1) + "\n"


def _node(kind: str, identifier: str, **values: Any) -> dict[str, Any]:
    return {"@type": f"cr:{kind}", "@id": identifier, "name": identifier, **values}


def _fields(table: str, columns: Iterable[pa.Field], source: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the fields of the columns of a table."""
    fields = []
    for column in columns:
        value = column.type
        while pa.types.is_list(value) or pa.types.is_fixed_size_list(value):
            value = value.value_type
        field = _node("Field", f"{table}/{column.name}", dataType=_DATA_TYPES.get(value, "sc:ImageObject"))
        if description := COLUMN_DESCRIPTIONS.get(column_kind(column.name)):
            field["description"] = description
        if value != column.type:
            field["repeated"] = True
        field["source"] = {**source, "extract": {"column": column.name}}
        if pa.types.is_struct(value):
            field["source"]["transform"] = {"jsonPath": "bytes"}
        fields.append(field)
    return fields
