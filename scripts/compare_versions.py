"""Byte comparison of the outputs of two versions of the project.

Runs the same commands in two checkouts, each with its own ``.venv``, and compares every file that they write:
dataset folders of all configs, two variants and the example scenes (of the new checkout), exports, archives of two
methods, and the JSON, CSV, LaTeX and HTML of scoring, comparison, tables, detections and the scripts in
``examples/paper``; what commands print at 80 and at 200 columns, and their help; also the database schema and the
OpenAPI document of the leaderboard. CSV files are compared by column, archives by entry, and HTML pages by
their visible texts and images.

    python scripts/compare_versions.py OLD_CHECKOUT NEW_CHECKOUT --work DIR [--data ROOT] [--demo]

``--data`` names a dataset folder that both versions read; nothing is built. ``--demo`` adds the dataset of ``make
demo`` (six views of 1280 x 720, some minutes a version). A side whose outputs are in ``DIR`` already is not run
again. ``--expect '*cameras.json=adds a key'``, which may be repeated, names files that are meant to differ, and
the reason; ``*`` stands for any characters.

Exit status 1 means that another file differs, that nothing differs where it is meant to, or that a command of the
new version fails.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

TINY = ("--width", "96", "--height", "54", "--samples", "1")
DEMO = ("--config", "lattice", "--views", "6", "--samples", "8")
SWEEPS = ("lattice-distance", "pile-distance", "pier-distance")
SCORED = ("lattice", "pile", "pier", "lattice-orbit", "cages", *SWEEPS)
"""Configs that are scored, where the dataset has them."""
BENCH = (
    "score",
    "score-crossings",
    "compare",
    "table",
    "check",
    "verify",
    "methods",
    "predict",
    "submit",
    "cache",
)
BUILD = ("build", "audit", "export", "import", "inspect", "push")
TERMINAL = "terminal"
"""Folder of what commands print."""

SUBMISSIONS = """
import csv, sys
from pathlib import Path
import numpy as np
from PIL import Image
import rebar_depth_bench as rdb
root, out, *configs = sys.argv[1:]
for name, gain, noise in (("exact", 1.0, 0.0), ("scaled", 1.3, 0.02), ("holes", 0.9, 0.05)):
    random = np.random.default_rng(7)
    with rdb.SubmissionWriter(f"{out}/{name}.zip", method=name) as writer:
        for config in configs:
            for row in rdb.load(root, config, columns=["view_id", "left_depth"]):
                depth_m = row["left_depth"] * (gain + noise * random.standard_normal(row["left_depth"].shape))
                if name == "holes":
                    depth_m[::3, ::2] = np.nan
                writer.add(row["view_id"], depth_m.astype(np.float32))
random = np.random.default_rng(8)
with open(f"{out}/detections.csv", "w", newline="") as stream:
    table = csv.writer(stream)
    table.writerow(["view_id", "world_x", "world_y", "world_z", "confidence"])
    places_m = rdb.crossings(root).groupby("scene")["tie_point"].apply(lambda points: np.stack(points)[:300])
    for config in configs:
        for row in rdb.load(root, config, columns=["view_id", "scene"]):
            found_m = places_m[row["scene"]]
            found_m = found_m[random.random(len(found_m)) < 0.8]
            for place_m in found_m + random.normal(0, 0.004, found_m.shape):
                table.writerow([row["view_id"], *place_m, random.random()])
kitti = Path(out, "kitti")
for frame in range(2):
    truth_m = np.where(random.random((375, 1242)) < 0.2, random.uniform(2, 90, (375, 1242)), 0)
    place = kitti / "depth/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02" / f"{frame:010}.png"
    place.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((truth_m * 256).astype(np.uint16)).save(place)
    (kitti / "maps").mkdir(exist_ok=True)
    depth_m = (np.maximum(truth_m, 1) * random.normal(1.1, 0.05, truth_m.shape)).astype(np.float32)
    np.save(kitti / "maps" / f"2011_09_26_drive_0001_sync_{frame:010}_l.npy", depth_m)
(kitti / "images.txt").write_text("".join(
    f"2011_09_26/2011_09_26_drive_0001_sync {frame:010} l\\n" for frame in range(2)
))
"""
"""Three submissions, detections and two images of KITTI's layout, from ground truth or numbers of a fixed seed, so
that both versions score the same predictions.
"""

SERVICE = """
import json, sqlite3, sys
from pathlib import Path
root, out = map(Path, sys.argv[1:])
from leaderboard.web.app import make_app
from leaderboard.service import open_service
from leaderboard.settings import read_settings
with open_service(read_settings(None, {"data": str(root), "state_dir": str(out / "state")})) as service:
    (out / "openapi.json").write_text(json.dumps(make_app(service).openapi(), indent=1))
with sqlite3.connect(out / "state" / "leaderboard.sqlite") as connection:
    rows = connection.execute("select sql from sqlite_master where sql is not null order by name")
    (out / "schema.sql").write_text("\\n".join(sql for (sql,) in rows) + "\\n")
"""


@dataclass(frozen=True)
class Command:
    """Arguments of ``python``; with a ``name``, what it prints is compared, at a width of ``columns``."""

    arguments: tuple[str, ...]
    name: str = ""
    columns: int = 80


def commands(work: Path, examples: Path, data: Path | None, demo: bool) -> Iterator[Command]:
    """Yield the commands that each version runs, with all outputs below ``work``."""
    for module, names in (("rebar_depth_bench", BENCH), ("dataset_builder", BUILD)):
        for name in ("", *names):
            yield Command(("-m", module, *name.split(), "--help"), f"help-{module}-{name}")
    root = data or work / "dataset"
    if data is None:
        yield from _builds(work, root, examples)
    build = ("-m", "dataset_builder")
    yield Command((*build, "export", f"{root}", "--out", f"{work}/export", "--config", "lattice", "pier"))
    yield from _results(root, work / "results")
    if demo:
        yield Command((*build, "--out", f"{work}/demo", *DEMO))
        yield from _results(work / "demo", work / "demo-results")
    service = work / "service"
    service.mkdir(parents=True, exist_ok=True)
    yield Command(("-c", SERVICE, f"{root}", f"{service}"))


def _builds(work: Path, root: Path, examples: Path) -> Iterator[Command]:
    build = ("-m", "dataset_builder", "--out")
    cages = ("--config", "cages", "--scenes", "2", "--views-per-scene", "2")
    yield Command((*build, f"{root}", "--views", "2", *TINY))
    yield Command((*build, f"{root}", "--config", *SWEEPS, "--views", "12", *TINY))
    yield Command(
        (*build, f"{root}", "--config", "lattice", "--variant", "wet", "formwork", "--views", "1", *TINY)
    )
    yield Command((*build, f"{root}", *cages, *TINY))
    for scene in ("beam.toml", "column.ifc"):
        yield Command((*build, f"{work}/scenes", "--scene", f"{examples / scene}", "--views", "1", *TINY))
    mesh = ("--mesh", f"{root}/meshes/lattice.ply", "--views", "1", *TINY)
    yield Command((*build, f"{work}/mesh", "--config", "lattice", *mesh))


def _results(data: Path, out: Path) -> Iterator[Command]:
    """Yield the commands that predict and score the configs ``SCORED`` of a dataset."""
    held = json.loads((data / "manifest.json").read_text())["configs"]
    configs = [name for name in SCORED if name in held]
    out.mkdir(parents=True, exist_ok=True)
    yield Command(("-c", SUBMISSIONS, f"{data}", f"{out}", *configs))
    exact, scaled, holes = (f"{out}/{name}.zip" for name in ("exact", "scaled", "holes"))
    at = ("--data", f"{data}")
    for method in ("constant", "sgbm"):
        yield from _run(out, f"predict-{method}", "predict", method, *at, "--out", f"{out}/{method}.zip")
    for name, archive in (("exact", exact), ("scaled", scaled), ("holes", holes)):
        files = _files(out, name, "json", "csv", "html", "groups-csv")
        yield from _run(out, f"score-{name}", "score", archive, *at, *files)
        yield from _run(out, f"check-{name}", "check", archive, *at)
    files = _files(out, "extended", "json", "html", "extended-csv")
    yield from _run(out, "score-extended", "score", scaled, *at, "--extended", *files)
    files = _files(out, "comparison", "json", "csv")
    yield from _run(out, "compare", "compare", exact, scaled, holes, *at, *files)
    for name, options in (("table", ()), ("table-own", ("--no-published", "--intervals"))):
        files = [*_files(out, name, "latex", "csv"), "--figure", f"{out}/{name}.svg"]
        yield from _run(out, name, "table", exact, scaled, holes, *at, *options, *files)
    detections = ("score-crossings", f"{out}/detections.csv", *at)
    yield from _run(out, "detections", *detections, *_files(out, "detections", "json", "html"))
    yield from _run(out, "detections-confident", *detections, "--confidence", "0.5")
    yield from _run(out, "verify", "verify", f"{data}")
    yield from _paper(out, "distance", scaled, *at)
    yield from _paper(out, "anchor", holes, *at, "--config", "lattice", "--num-anchor-views", "1")
    yield from _paper(out, "pseudo_reference", scaled, "--reference", exact, holes, *at, "--config", "lattice")
    kitti = ("--kitti", f"{out}/kitti/depth", "--images", f"{out}/kitti/images.txt", "--ground-truth", "improved")
    yield from _paper(out, "kitti", "--predictions", f"{out}/kitti/maps", *kitti)


def _files(out: Path, name: str, *options: str) -> list[str]:
    """Return options that write files of a name, such as ``--groups-csv OUT/NAME.groups.csv``."""
    return [word for option in options for word in (f"--{option}", f"{out}/{name}.{option.replace('-', '.')}")]


def _run(out: Path, name: str, *arguments: str) -> Iterator[Command]:
    for columns in (80, 200):
        words = ("-m", "rebar_depth_bench", *arguments)
        yield Command(words, f"{out.name}-{name}-{columns}", columns)


def _paper(out: Path, script: str, *arguments: str) -> Iterator[Command]:
    files = _files(out, script, "json", "csv")
    words = (f"examples/paper/{script}.py", *arguments, *files, "--figure", f"{out}/{script}.svg")
    yield Command(words, f"{out.name}-{script}")


def run_version(checkout: Path, work: Path, examples: Path, data: Path | None, demo: bool) -> None:
    """Run all commands of one checkout in its own environment; write ``log.txt`` beside the outputs.

    What a command prints is written to the folder ``TERMINAL``, with its exit status; without a name to compare it
    by, a command that fails ends the run.
    """
    (work / TERMINAL).mkdir(parents=True)
    python = checkout / ".venv" / "bin" / "python"
    keep = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
    environment = {**keep, "HF_HOME": f"{work}/hf", "XDG_CACHE_HOME": f"{work}/cache", "HF_HUB_OFFLINE": "1"}
    with (work / "log.txt").open("w") as log:
        for command in commands(work, examples, data, demo):
            shown = " ".join(word if len(word) < 200 else "..." for word in command.arguments)
            print(f"{checkout.name}: {shown}", file=sys.stderr, flush=True)
            finished = subprocess.run(
                [python, *command.arguments],
                cwd=checkout,
                env={**environment, "COLUMNS": f"{command.columns}"},
                capture_output=True,
                text=True,
                check=False,
            )
            log.write(f"$ {shown}\n{finished.stdout}{finished.stderr}")
            log.flush()
            if command.name:
                text = f"exit status {finished.returncode}\n{finished.stdout}{_messages(finished.stderr)}"
                (work / TERMINAL / f"{command.name}.txt").write_text(text)
            elif finished.returncode:
                raise SystemExit(f"{shown}: exit status {finished.returncode}\n{finished.stderr}")


def _messages(text: str) -> str:
    """Return what a command printed to standard error, without the lines of progress."""
    lines = [line for line in text.splitlines() if not re.match(r".*: \d+ of \d+", line)]
    return "".join(f"{line}\n" for line in lines)


def digests(work: Path) -> dict[str, str]:
    """Return the SHA-256 of every output below ``work`` by relative path; caches and the log are left out.

    Each column of a CSV file has its own digest, so that a new column is told from a changed one. So has each
    entry of an archive; its run times are left out.
    """
    found = {}
    for path in sorted(work.rglob("*")):
        name = path.relative_to(work).as_posix()
        skipped = name.startswith(("hf/", "cache/", "service/state")) or name == "log.txt"
        if path.is_file() and not skipped:
            for part, whole in _parts(path).items():
                content = whole.replace(str(work).encode(), b"WORK")
                found[f"{name}: {part}" if part else name] = hashlib.sha256(content).hexdigest()
    return found


def _parts(path: Path) -> dict[str, bytes]:
    """Return what is compared of a file, by the names of its parts; "" is the whole file."""
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            entries = {name: archive.read(name) for name in archive.namelist()}
        meta = json.loads(entries["submission.json"])
        meta.get("runtime", {}).pop("seconds", None)
        return {**entries, "submission.json": json.dumps(meta).encode()}
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as stream:
            header, *rows = csv.reader(stream)
        columns = zip(header, *rows, strict=True)
        return {column: "\n".join(cells).encode() for column, *cells in columns}
    if path.suffix == ".html":
        return {"": "\n".join(page_texts(path.read_text(encoding="utf-8"))).encode()}
    if path.name == "openapi.json":
        return {"": json.dumps(interface(json.loads(path.read_bytes())), sort_keys=True).encode()}
    return {"": path.read_bytes()}


class _Texts(HTMLParser):
    """Visible words of a page, its texts for screen readers, and its images."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self._hidden = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._hidden = tag in ("script", "style")
        self.found += [value for name, value in attrs if name in ("alt", "title", "aria-label", "src") and value]

    def handle_endtag(self, tag: str) -> None:
        del tag
        self._hidden = False

    def handle_data(self, data: str) -> None:
        self.found += [] if self._hidden else data.split()


def page_texts(page: str) -> list[str]:
    """Return what a page shows: its words in order, the texts for screen readers, and its images as data."""
    texts = _Texts()
    texts.feed(page)
    return texts.found


def interface(node: Any, schemas: dict[str, Any] | None = None) -> Any:
    """Return an OpenAPI document with its schemas in place and without titles, descriptions and operation ids.

    Names of Python classes and texts may change between versions; statuses, headers, paths and keys may not.
    """
    if schemas is None:
        schemas = node["components"]["schemas"]
        node = {"paths": node["paths"], "security": node["components"].get("securitySchemes")}
    if isinstance(node, list):
        return [interface(item, schemas) for item in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        return interface(schemas[node["$ref"].rsplit("/", 1)[1]], schemas)
    texts = {"title", "description", "summary", "operationId"}
    return {
        key: interface(value, schemas)
        for key, value in node.items()
        if not (key in texts and isinstance(value, str))
    }


def main() -> int:
    """Run both versions, compare, print what differs; return 0 where only what is meant to differ does."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="folder for the outputs")
    parser.add_argument("--data", type=Path, metavar="ROOT", help="dataset folder of both versions: build none")
    parser.add_argument("--demo", action="store_true", help="add the dataset of make demo")
    expect = "files that are meant to differ, and why; may be repeated"
    parser.add_argument("--expect", action="append", default=[], metavar="PATTERN=REASON", help=expect)
    options = parser.parse_args()
    sides = []
    data = options.data and options.data.absolute()
    for name in ("old", "new"):
        work = options.work.absolute() / name
        if not work.exists():  # a finished side is compared again, not made again
            partial = work.with_name(f"{name}.partial")
            shutil.rmtree(partial, ignore_errors=True)
            checkout = getattr(options, name).absolute()
            run_version(checkout, partial, options.new.absolute() / "examples", data, options.demo)
            partial.rename(work)
        sides.append(digests(work))
    old, new = sides
    differing = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    kinds = sorted({Path(name.partition(": ")[0]).suffix for name in old})
    print(f"{len(old)} files, columns and entries compared ({', '.join(kinds)}): {len(differing)} differ")
    reasons = dict(pair.split("=", 1) for pair in options.expect)
    faults = 0
    for name in differing:
        state = "only new" if name not in old else "only old" if name not in new else "differs"
        reason = next((reason for pattern, reason in reasons.items() if fnmatchcase(name, pattern)), None)
        faults += reason is None
        print(f"  {name}: {state}{'' if reason is None else f', as expected: {reason}'}")
    for pattern in reasons:
        if not any(fnmatchcase(name, pattern) for name in differing):
            print(f"  {pattern}: expected to differ, but is the same")
            faults += 1
    for path in sorted((options.work / "new" / TERMINAL).iterdir()):
        status = path.read_text().splitlines()[0]
        if status != "exit status 0":
            print(f"  {path.name}: {status} in the new version")
            faults += 1
    return 1 if faults else 0


if __name__ == "__main__":
    raise SystemExit(main())
