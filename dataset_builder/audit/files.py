"""Checks of the folder as a set of files."""

from __future__ import annotations

from pathlib import Path

from dataset_builder.audit.report import Check
from dataset_builder.plan import BUILD_FOLDER
from rebar_depth_bench.digests import file_sha256, views_digest
from rebar_depth_bench.folder import MANIFEST, DatasetFolder


def check_files(folder: DatasetFolder, root: Path) -> Check:
    """Every file the manifest names is there with its SHA-256, and none stands there unnamed."""
    named = folder.manifest["files"]
    problems = [problem for name, sha256 in named.items() if (problem := _file_problem(root, name, sha256))]
    strangers = sorted(_present(root) - set(named) - {MANIFEST})
    problems += [f"{name}: is not in the manifest" for name in strangers]
    if (root / BUILD_FOLDER).exists():
        problems.append(f"{BUILD_FOLDER}: an unfinished build stands there; run rebar-build again or remove it")
    return Check("files against the manifest", f"{len(named)} files", "every SHA-256 equal", tuple(problems))


def check_digests(folder: DatasetFolder) -> Check:
    """The ground-truth digest and each config's are those of the views' digests."""
    entries = {config: folder.config(config) for config in folder.configs}
    problems = [
        f"{config}: ground_truth_digest is {entry['ground_truth_digest']}, expected {views_digest(entry['views'])}"
        for config, entry in entries.items()
        if entry["ground_truth_digest"] != views_digest(entry["views"])
    ]
    expected = views_digest([view for entry in entries.values() for view in entry["views"]])
    if folder.digest != expected:
        problems.append(f"the ground-truth digest is {folder.digest}, expected {expected}")
    return Check("digests of the manifest", folder.digest[:23], "equal to the views'", tuple(problems))


def _file_problem(root: Path, name: str, sha256: str) -> str | None:
    path = root / name
    if not path.is_file():
        return f"{name}: is missing"
    found = file_sha256(path)
    return None if found == sha256 else f"{name}: SHA-256 is {found[:16]}, expected {sha256[:16]}"


def _present(root: Path) -> set[str]:
    """Return the folder's files, those of the scoring cache and other hidden folders left out."""
    names = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    return {name for name in names if not name.startswith(".")}
