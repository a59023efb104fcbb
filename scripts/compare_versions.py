"""Byte comparison of the outputs of two versions of the project.

Runs the same commands in two checkouts, each with its own ``.venv``, and compares every file that they write:
dataset folders of all configs, two variants and the example scenes (of the new checkout), exports, archives, and
the JSON, CSV, LaTeX and HTML of scoring, comparison and tables; also the database schema and the OpenAPI
document of the leaderboard.

    python scripts/compare_versions.py OLD_CHECKOUT NEW_CHECKOUT --work DIR [--demo]

``--demo`` adds the dataset of ``make demo`` (six views of 1280 x 720, some minutes a version). A side whose
outputs are in ``DIR`` already is not run again. Exit status 1 means that a file differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TINY = ("--width", "96", "--height", "54", "--samples", "1")
DEMO = ("--config", "lattice", "--views", "6", "--samples", "8")

SUBMISSIONS = """
import sys
import numpy as np
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
"""
"""Three submissions made from ground truth with a fixed seed, so that both versions score the same predictions."""

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


def commands(work: Path, examples: Path, demo: bool) -> Iterator[list[str]]:
    """Yield the arguments of ``python`` that each version runs, with all outputs below ``work``."""
    build = ["-m", "dataset_builder", "--out"]
    bench = ["-m", "rebar_depth_bench"]
    root, scenes, results = work / "dataset", work / "scenes", work / "results"
    sweeps = ("lattice-distance", "pile-distance", "pier-distance")
    yield [*build, f"{root}", "--views", "2", *TINY]
    yield [*build, f"{root}", "--config", *sweeps, "--views", "12", *TINY]
    yield [*build, f"{root}", "--config", "lattice", "--variant", "wet", "formwork", "--views", "1", *TINY]
    for scene in ("beam.toml", "column.ifc"):
        yield [*build, f"{scenes}", "--scene", f"{examples / scene}", "--views", "1", *TINY]
    mesh = ["--mesh", f"{root}/meshes/lattice.ply", "--views", "1", *TINY]
    yield [*build, f"{work}/mesh", "--config", "lattice", *mesh]
    yield ["-m", "dataset_builder", "export", f"{root}", "--out", f"{work}/export", "--config", "lattice", "pier"]
    roots: list[tuple[Path, Path, tuple[str, ...]]] = [
        (root, results, ("lattice", "pile", "pier", "lattice-orbit", *sweeps))
    ]
    if demo:
        yield [*build, f"{work}/demo", *DEMO]
        roots.append((work / "demo", work / "demo-results", ("lattice",)))
    for data, out, configs in roots:
        out.mkdir(parents=True, exist_ok=True)
        yield ["-c", SUBMISSIONS, f"{data}", f"{out}", *configs]
        exact, scaled, holes = (f"{out}/{name}.zip" for name in ("exact", "scaled", "holes"))
        at = ["--data", f"{data}"]
        for name, archive in (("exact", exact), ("scaled", scaled), ("holes", holes)):
            files = [word for kind in ("json", "csv", "html") for word in (f"--{kind}", f"{out}/{name}.{kind}")]
            yield [*bench, "score", archive, *at, *files]
        files = ["--json", f"{out}/extended.json", "--html", f"{out}/extended.html"]
        yield [*bench, "score", scaled, *at, "--extended", *files, "--extended-csv", f"{out}/extended.csv"]
        yield [*bench, "compare", exact, scaled, holes, *at, "--json", f"{out}/c.json", "--csv", f"{out}/c.csv"]
        yield [*bench, "table", exact, scaled, holes, *at, "--latex", f"{out}/t.tex", "--csv", f"{out}/t.csv"]
    service = work / "service"
    service.mkdir(parents=True, exist_ok=True)
    yield ["-c", SERVICE, f"{root}", f"{service}"]


def run_version(checkout: Path, work: Path, examples: Path, demo: bool) -> None:
    """Run all commands of one checkout in its own environment; write ``log.txt`` beside the outputs."""
    work.mkdir(parents=True)
    python = checkout / ".venv" / "bin" / "python"
    keep = {name: os.environ[name] for name in ("PATH", "HOME", "LANG") if name in os.environ}
    environment = {**keep, "HF_HOME": f"{work}/hf", "XDG_CACHE_HOME": f"{work}/cache", "HF_HUB_OFFLINE": "1"}
    with (work / "log.txt").open("w") as log:
        for arguments in commands(work, examples, demo):
            shown = " ".join(word if len(word) < 200 else "..." for word in arguments)
            print(f"{checkout.name}: {shown}", file=sys.stderr, flush=True)
            log.write(f"$ {shown}\n")
            log.flush()
            subprocess.run([python, *arguments], cwd=checkout, env=environment, stdout=log, stderr=log, check=True)


def digests(work: Path) -> dict[str, str]:
    """Return the SHA-256 of every output below ``work`` by relative path; caches and the log are left out."""
    found = {}
    for path in sorted(work.rglob("*")):
        name = path.relative_to(work).as_posix()
        skipped = name.startswith(("hf/", "cache/", "service/state")) or name == "log.txt"
        if path.is_file() and not skipped:
            content = path.read_bytes()
            if name == "service/openapi.json":
                content = json.dumps(interface(json.loads(content)), sort_keys=True).encode()
            found[name] = hashlib.sha256(content.replace(str(work).encode(), b"WORK")).hexdigest()
    return found


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
    """Run both versions, compare, print what differs; return 0 where everything is the same."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="folder for the outputs")
    parser.add_argument("--demo", action="store_true", help="add the dataset of make demo")
    options = parser.parse_args()
    sides = []
    for name in ("old", "new"):
        work = options.work.absolute() / name
        if not work.exists():  # a finished side is compared again, not made again
            partial = work.with_name(f"{name}.partial")
            shutil.rmtree(partial, ignore_errors=True)
            run_version(
                getattr(options, name).absolute(), partial, options.new.absolute() / "examples", options.demo
            )
            partial.rename(work)
        sides.append(digests(work))
    old, new = sides
    differing = sorted(name for name in old.keys() | new.keys() if old.get(name) != new.get(name))
    kinds = sorted({Path(name).suffix for name in old})
    print(f"{len(old)} files compared ({', '.join(kinds)}): {len(differing)} differ")
    for name in differing:
        state = "only new" if name not in old else "only old" if name not in new else "differs"
        print(f"  {name}: {state}")
    return 1 if differing else 0


if __name__ == "__main__":
    raise SystemExit(main())
