"""Loading, writing archives and scoring in a process without what only Linux or POSIX systems have."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import rebar_depth_bench as rdb

HIDE = """
import asyncio, os, sys  # On POSIX systems, asyncio needs sysconf when it is imported.
for name in ("fcntl", "resource"):
    sys.modules[name] = None
for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_DIRECTORY", "pread", "sched_getaffinity", "sysconf"):
    vars(os).pop(name, None)
os.process_cpu_count = os.cpu_count  # Python 3.13 defines it so where there is no sched_getaffinity.
"""
RUN = """
import rebar_depth_bench as rdb
root, archive, result = sys.argv[1:]
rows = rdb.load(root, "lattice")
with rdb.SubmissionWriter(archive, method="copy") as writer:
    for row in rows:
        writer.add(row["view_id"], row["left_depth"] * 1.1)
with open(result, "wb") as file:
    file.write(rdb.score(archive, root).to_json())
"""


def test_load_write_and_score_without_posix(tiny_root: Path, tmp_path: Path) -> None:
    archive, result = tmp_path / "copy.zip", tmp_path / "copy.json"
    command = [sys.executable, "-c", HIDE + RUN, str(tiny_root), str(archive), str(result)]
    # Without fcntl, the lock files that other tests have left in the cache of datasets would be waited for.
    caches = os.environ | {"HF_HOME": str(tmp_path), "HF_DATASETS_CACHE": str(tmp_path / "datasets")}
    done = subprocess.run(command, capture_output=True, text=True, env=caches)
    assert done.returncode == 0, done.stderr
    assert result.read_bytes() == rdb.score(archive, tiny_root).to_json()
