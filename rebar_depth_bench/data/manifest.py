"""Manifest of a dataset folder or Hub repository: its configs, digests and files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from rebar_depth_bench.data.config_tables import DIGEST_PATTERN, Digest, RelativePath, Sha256
from rebar_depth_bench.data.dataset_config import DatasetConfig
from rebar_depth_bench.data.digests import file_sha256, views_digest
from rebar_depth_bench.data.location import Located, local_path
from rebar_depth_bench.data.manifest_table import ManifestTable
from rebar_depth_bench.errors import DatasetError, InputError, Problem, escape_text
from rebar_depth_bench.limits import JSON_BYTES
from rebar_depth_bench.reading import parse_json, read_file
from rebar_depth_bench.validation import Expected, format_location, one_of, text, validate_table

MANIFEST_FILE = "manifest.json"
MANIFEST_FORMAT = "rebar-depth-dataset-2"
OLD_FORMAT = "rebar-depth-dataset-1"
"""Format of folders that ``rebar-build --rewrite-manifest`` converts."""


class DatasetFolder(Located):
    """Dataset with a validated manifest.

    ``files`` are the hex SHA-256 digests of its files, by path; ``crossings`` are the parameters by which the
    crossings of bars were found.
    """

    version: str
    digest: str
    files: dict[str, str]
    config_by_name: dict[str, DatasetConfig]
    crossings: dict[str, Any] = Field({})

    @property
    def configs(self) -> tuple[str, ...]:
        """Names of the configs."""
        return tuple(self.config_by_name)

    def config(self, name: str) -> DatasetConfig:
        """Return a config; raise ``DatasetError`` if there is none of that name."""
        if name not in self.config_by_name:
            raise DatasetError(f"{self.root}: no config {name!r}, expected one of {', '.join(self.configs)}")
        return self.config_by_name[name]

    def verified_file(self, name: str) -> Path:
        """Return the local path of a file after comparing its SHA-256 with the manifest.

        Raises ``DatasetError`` if the file cannot be read or differs.
        """
        path = self.file(name)
        found, expected = file_sha256(path), self.files.get(name)
        if found != expected:
            raise DatasetError(
                f"{path}: the SHA-256 is {found[:16]}, expected {(expected or 'one')[:16]} as in the manifest; "
                f"rebar-bench verify {self.root} lists damaged files"
            )
        return path

    def expected_views(self, split: str | None = None) -> dict[str, tuple[int, int]]:
        """Return the (height, width) of every view of every config, or of one split, keyed by view id."""
        configs: Iterable[DatasetConfig] = self.config_by_name.values()
        if split is not None:
            configs = [config.of_split(split) for config in configs if split in config.splits]
        return {view_id: config.grid for config in configs for view_id in config.view_ids}


class _GroundTruth(ManifestTable):
    digest: Digest


class _Format(ManifestTable):
    format: Annotated[str, one_of(MANIFEST_FORMAT)]


class _Manifest(ManifestTable):
    """Manifest of the supported format; its configs are validated one by one."""

    version: Annotated[str, text(100)]
    protocol: Annotated[str, one_of("rebar-2")]
    ground_truth: _GroundTruth
    crossings: dict[str, Any] = Field({})
    configs: Annotated[dict[str, dict[str, Any]], Expected("a table of one or more configs", bool)]
    files: dict[RelativePath, Sha256]


def open_folder(root: str | Path, *, expect_digest: str | None = None) -> DatasetFolder:
    """Open a dataset folder or Hub dataset repository.

    Raises ``DatasetError`` if ``root`` is neither, or with all problems of its manifest if that is invalid, and if
    the dataset's digest is not ``expect_digest``.
    """
    if expect_digest is not None and not re.fullmatch(DIGEST_PATTERN, expect_digest):
        raise InputError(
            f"the expected digest is {escape_text(expect_digest)}, expected sha256: and 64 hex digits"
        )
    root = str(root)
    path = local_path(root, MANIFEST_FILE)
    values, problems = read_manifest(path)
    if isinstance(values, dict) and values.get("format") == OLD_FORMAT:
        raise DatasetError(
            f"{path}: has the format {OLD_FORMAT}, expected {MANIFEST_FORMAT}; rebar-build --out ROOT "
            "--rewrite-manifest converts it without rendering"
        )
    folder = validated_folder(values, problems, root, path)
    if expect_digest not in (None, folder.digest):
        raise DatasetError(f"{root}: the dataset has the digest {folder.digest}, expected {expect_digest}")
    return folder


def read_manifest(path: Path) -> tuple[Any, list[Problem]]:
    """Return the JSON value in a manifest, which is not checked further, or the problem of its text.

    Raises ``DatasetError`` if the file cannot be read or is larger than ``JSON_BYTES``.
    """
    return parse_json(read_file(path, JSON_BYTES, "the manifest of a dataset", DatasetError))


def validated_folder(values: Any, problems: list[Problem], root: str, path: Path) -> DatasetFolder:
    """Return the dataset in ``root`` that ``read_manifest`` has read from ``path``, if there are no ``problems``.

    Raises ``DatasetError`` with the problems, and with those of the values.
    """
    # Another format would cause many other problems.
    supported = not problems and validate_table(_Format, values, problems)
    head = validate_table(_Manifest, values, problems) if supported else None
    place = {"root": root, "commit": "" if Path(root).is_dir() else path.parent.name}
    configs = _read_configs(values.get("configs"), place, problems) if supported else {}
    if head is not None and not problems:
        digest = views_digest(view for config in configs.values() for view in config.views)
        if head.ground_truth.digest != digest:
            found, expected = f"got {head.ground_truth.digest}", f"the digest of all views, {digest}"
            problems.append(Problem("conflict", "ground_truth.digest", found, expected))
    if head is None or problems:
        raise DatasetError.from_problems(path, problems)
    return DatasetFolder(
        **place,
        version=head.version,
        digest=head.ground_truth.digest,
        files=head.files,
        config_by_name=configs,
        crossings=head.crossings,
    )


def _read_configs(entries: object, place: dict[str, str], problems: list[Problem]) -> dict[str, DatasetConfig]:
    """Return the valid configs of a manifest, and append the problems of the others."""
    configs: dict[str, DatasetConfig] = {}
    for name, entry in entries.items() if isinstance(entries, dict) else ():
        if not isinstance(entry, dict):  # A problem of the whole manifest.
            continue
        where = format_location("configs", name)
        if entry.get("name", name) != name:
            found, expected = f"got {escape_text(str(entry['name']))}", f"{escape_text(name)}, the config's key"
            problems.append(Problem("conflict", format_location(where, "name"), found, expected))
        fields = {**DatasetConfig.fields_of_entry(name, entry), **place}
        if config := validate_table(DatasetConfig, fields, problems, where):
            configs[name] = config
    problems += _scene_problems(configs.values())
    return configs


def _scene_problems(configs: Iterable[DatasetConfig]) -> Iterator[Problem]:
    """Yield a problem for each scene without views, or unlike one of the same name in an earlier config."""
    first: dict[str, tuple[str, tuple[object, ...]]] = {}
    for config in configs:
        with_views = set(config.scene_by_view.values())
        for scene in config.scenes:
            if scene.name not in with_views:
                where = format_location("configs", config.name, "views")
                yield Problem(
                    "missing", where, f"scene {scene.name} has no view", "one view or more of each scene"
                )
            shown = (scene.board, scene.appearance, scene.mesh)
            other, expected = first.setdefault(scene.name, (config.name, shown))
            if shown != expected:
                where = format_location("configs", config.name, "scenes")
                found = f"scene {scene.name} has another board, mesh or appearance than in {other}"
                yield Problem("conflict", where, found, "one scene for each name")
