"""How fast the leaderboard answers 50 readers, alone and while archives come in and are scored.

python -m benchmarks.leaderboard [--data ROOT --archive ZIP] [--db URL] [--rows N] [--json FILE]

The real server runs in a process of its own, the client in this one. Without ``--data`` the dataset is a small one
made of arithmetic, and so is the archive. ``--db`` names an empty database, which is filled and left so; without
it the server keeps SQLite. Every reader asks again once it has its answer, so that reads alone keep the server
busy: figures say what it can do at most, latencies what 50 readers at once wait.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import rebar_depth_bench as rdb
from benchmarks import filled_board
from benchmarks.filled_board import Served, fill, new_tokens, running_server
from benchmarks.http_load import Plan, Tally, run_load
from benchmarks.synthetic_dataset import write_archive, write_dataset
from benchmarks.timing import machine, print_markdown
from leaderboard.db.engine import Database
from leaderboard.db.submissions import SCORED
from leaderboard.settings import read_settings
from rebar_depth_bench.data.manifest import open_folder

CONFIGS, VIEWS = ("lattice", "pile"), 24
SEED = 7
ALL = "all"
ALONE, BUSY = "reads alone", "with uploads and scoring"
WARM_UP_S = 3.0


@dataclass(frozen=True)
class Latency:
    """Reads of a route: how many a second, and what share of them took how many milliseconds at most."""

    per_s: float
    p50_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True)
class Window:
    """A stretch of load: reads by route, uploads accepted and submissions scored a minute, what was in its way."""

    reads: Mapping[str, Latency]
    accepted_per_min: float
    scored_per_min: float
    upload_p50_ms: float
    unchanged: float
    client_cores: float
    server_cores: float
    errors: tuple[str, ...]


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        data, archive = _material(options, Path(scratch))
        state = Path(scratch) / "state"
        state.mkdir()
        settings = read_settings(None, {"data": str(data), "state": state, "db": options.db})
        with closing(Database(settings.database_url)) as database:
            database.migrate()
            if filled_board.count(database):
                print("the database holds submissions, expected an empty one", file=sys.stderr)
                return 2
            ids = fill(database, rdb.score(archive, data).to_json(), options.rows, SEED)
            print(f"{options.rows} rows on {'PostgreSQL' if options.db else 'SQLite'}; {machine()}\n", flush=True)
            with running_server(data, state, options.db, options.scorers) as served:
                config = open_folder(data).configs[0]
                plan = replace(_plan(options, served, config, ids), archive=archive)
                before_mb = served.megabytes()
                windows = _measure(plan, served, database, ids, options)
                memory_mb = (before_mb, served.megabytes())
    _print(windows, memory_mb)
    if options.json:
        options.json.write_text(json.dumps(_document(windows, memory_mb), indent=1) + "\n")
    return 1 if any(one.errors for found in windows.values() for one in found) else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m benchmarks.leaderboard", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--data", type=Path, metavar="ROOT", help="a dataset folder")
    parser.add_argument("--archive", type=Path, metavar="ZIP", help="an archive of it")
    parser.add_argument("--db", default="", metavar="URL", help="an empty database; default: SQLite")
    parser.add_argument("--rows", type=int, default=200, help="scored rows on the board")
    parser.add_argument("--readers", type=int, default=50)
    parser.add_argument("--uploaders", type=int, default=8)
    parser.add_argument("--scorers", type=int, default=1)
    parser.add_argument("--pause", type=float, default=0.0, help="seconds a reader waits between requests")
    parser.add_argument("--upload-pause", type=float, default=5.0, help="seconds an uploader waits")
    parser.add_argument("--conditional", action="store_true", help="readers keep what they have, as browsers do")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a window")
    parser.add_argument("--repeats", type=int, default=3, help="windows of each kind, by turns")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every window here")
    return parser


def _material(options: argparse.Namespace, scratch: Path) -> tuple[Path, Path]:
    """Return the dataset and the archive that are given, or made here."""
    if (options.data is None) != (options.archive is None):
        _parser().error("--data and --archive go together")
    if options.data is not None:
        return options.data, options.archive
    data, archive = scratch / "dataset", scratch / "archive.zip"
    write_dataset(data, CONFIGS, VIEWS)
    write_archive(archive, CONFIGS, VIEWS, "benchmark", SEED)
    return data, archive


def _plan(options: argparse.Namespace, served: Served, config: str, ids: Sequence[str]) -> Plan:
    targets = (
        ("/", "/"),
        ("/?config=", f"/?config={config}"),
        ("/api/v1/leaderboard", f"/api/v1/leaderboard?config={config}"),
        *(("/submissions/ID", f"/submissions/{one}") for one in ids[:1]),
    )
    return Plan(
        host=served.host,
        port=served.port,
        targets=targets,
        readers=options.readers,
        seconds=options.seconds,
        pause_s=options.pause,
        conditional=options.conditional,
        upload_pause_s=options.upload_pause,
    )


def _measure(
    plan: Plan, served: Served, database: Database, ids: Sequence[str], options: argparse.Namespace
) -> dict[str, list[Window]]:
    tokens = new_tokens(database, options.uploaders)
    windows: dict[str, list[Window]] = {ALONE: [], BUSY: []}
    run_load(replace(plan, seconds=WARM_UP_S), SEED)
    for turn in range(options.repeats):
        for name, with_tokens in ((ALONE, ()), (BUSY, tokens)):
            scored, cpu_s = filled_board.count(database, SCORED), served.cpu_s()
            tally = run_load(replace(plan, tokens=with_tokens), SEED + 1000 * turn)
            scored, cpu_s = filled_board.count(database, SCORED) - scored, served.cpu_s() - cpu_s
            filled_board.empty_queue(database)
            filled_board.drop_newer(database, ids)
            windows[name].append(_window(tally, scored, cpu_s))
    return windows


def _window(tally: Tally, scored: int, server_cpu_s: float) -> Window:
    by_route = {ALL: tally.all_read_s, **tally.read_s}
    return Window(
        reads={route: _latency(found, tally.wall_s) for route, found in by_route.items()},
        accepted_per_min=60 * len(tally.upload_s) / tally.wall_s,
        scored_per_min=60 * scored / tally.wall_s,
        upload_p50_ms=1e3 * statistics.median(tally.upload_s) if tally.upload_s else 0.0,
        unchanged=tally.unchanged / max(1, len(tally.all_read_s)),
        client_cores=tally.client_cores,
        server_cores=server_cpu_s / tally.wall_s,
        errors=tuple(tally.errors),
    )


def _latency(seconds: Sequence[float], wall_s: float) -> Latency:
    """Return the figures of a route's reads; percentiles are of the nearest rank."""
    ordered = sorted(seconds) or [0.0]
    p50, p99 = (ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in (0.5, 0.99))
    return Latency(len(seconds) / wall_s, 1e3 * p50, 1e3 * p99, 1e3 * ordered[-1])


def _print(windows: Mapping[str, Sequence[Window]], memory_mb: tuple[float, float]) -> None:
    repeats = len(windows[ALONE])
    print(f"Medians of {repeats} windows:\n")
    routes = windows[ALONE][0].reads
    rows = [(f"`{route}`", name, *_cells(found, route)) for route in routes for name, found in windows.items()]
    print_markdown(["route", "", "a second", "p50 ms", "p99 ms", "max ms"], rows)
    busy = windows[BUSY]
    ratios = [
        with_uploads.reads[ALL].p99_ms / alone.reads[ALL].p99_ms
        for alone, with_uploads in zip(windows[ALONE], busy, strict=True)
    ]
    errors = [error for found in windows.values() for one in found for error in one.errors]
    print(f"\np99 with uploads and scoring over p99 without: {statistics.median(ratios):.2f}")
    print(
        f"uploads accepted a minute: {_of(busy, lambda one: one.accepted_per_min):.0f}, "
        f"median {_of(busy, lambda one: one.upload_p50_ms):.0f} ms each; "
        f"scored a minute: {_of(busy, lambda one: one.scored_per_min):.0f}"
    )
    print(f"answers 304: {_of(busy, lambda one: one.unchanged):.0%}; errors: {len(errors)} {errors[:3] or ''}")
    cpu_ms = _of(windows[ALONE], lambda one: 1e3 * one.server_cores / one.reads[ALL].per_s)
    print(f"processor time of the server for a read: {cpu_ms:.2f} ms")
    client = max(one.client_cores for found in windows.values() for one in found)
    print(f"the client took {client:.0%} of a core at most")
    print(f"memory of the server's process: {memory_mb[0]:.0f} MB before, {memory_mb[1]:.0f} MB after")


def _cells(windows: Sequence[Window], route: str) -> list[str]:
    figures = [astuple(one.reads[route]) for one in windows]
    return [f"{statistics.median(column):.0f}" for column in zip(*figures, strict=True)]


def _of(windows: Sequence[Window], figure: Callable[[Window], float]) -> float:
    return statistics.median(map(figure, windows))


def _document(windows: Mapping[str, Sequence[Window]], memory_mb: tuple[float, float]) -> dict[str, object]:
    return {
        "machine": machine(),
        "windows": {name: [asdict(one) for one in found] for name, found in windows.items()},
        "server_mb": {"before": memory_mb[0], "after": memory_mb[1]},
    }


if __name__ == "__main__":
    sys.exit(main())
