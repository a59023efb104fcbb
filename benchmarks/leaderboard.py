"""Benchmark of the leaderboard under load by 50 readers, with and without concurrent uploads and scoring.

python -m benchmarks.leaderboard [--data ROOT --archive ZIP] [--db URL] [--rows N] [--json FILE]

The real server runs in a separate process, the client in this one. Without ``--data`` a small synthetic dataset
and archive are used. ``--db`` names an empty database, which is filled and not cleared afterwards; without it the
server uses SQLite. By default every reader sends its next request immediately after a response, so that reads
alone saturate the server: the rates are its maximum throughput, the latencies those of 50 concurrent readers.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path

import rebar_depth_bench as rdb
from benchmarks import filled_board
from benchmarks.filled_board import ServerProcess, add_scored_submissions, new_tokens, running_server
from benchmarks.http_load import LoadPlan, LoadResult, run_load
from benchmarks.timing import machine_description, print_markdown
from leaderboard.db.engine import Database
from leaderboard.db.submissions import SCORED
from leaderboard.settings import read_settings
from rebar_depth_bench.data.manifest import open_folder
from tests.leaderboard.serving import distinct_archive
from tests.synthetic_dataset import write_archive, write_dataset

CONFIGS, VIEWS = ("lattice", "pile"), 24
SEED = 7
COPIES = 50
ALL = "all"
ALONE, BUSY = "reads alone", "with uploads and scoring"
WARM_UP_S = 3.0


@dataclass(frozen=True)
class Latency:
    """Reads of a route: rate per second, and percentiles and maximum of the latency in milliseconds."""

    per_s: float
    p50_ms: float
    p99_ms: float
    max_ms: float


@dataclass(frozen=True)
class LoadWindow:
    """Measurements of one load window.

    ``reads`` are by route. ``unchanged`` is the share of responses with status 304. ``client_cores`` and
    ``server_cores`` are the CPU use of the client and the server process in cores.
    """

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
        data, archive = _dataset_and_archive(options, Path(scratch))
        state = Path(scratch) / "state"
        state.mkdir(mode=0o700)
        settings = read_settings(None, {"data": str(data), "state_dir": state, "db": options.db})
        with closing(Database(settings.database_url)) as database:
            database.migrate()
            if filled_board.count_submissions(database):
                print("the database holds submissions, expected an empty one", file=sys.stderr)
                return 2
            ids = add_scored_submissions(database, rdb.score(archive, data).to_json(), options.rows, SEED)
            print(
                f"{options.rows} rows on {'PostgreSQL' if options.db else 'SQLite'}; {machine_description()}\n",
                flush=True,
            )
            with running_server(data, state, options.db, options.workers) as served:
                config = open_folder(data).configs[0]
                plan = replace(_plan(options, served, config, ids), archives=_distinct(archive))
                before_mb = served.megabytes()
                windows = _measure(plan, served, database, ids, options)
                memory_mb = (before_mb, served.megabytes())
    _print_report(windows, memory_mb)
    if options.json:
        options.json.write_text(json.dumps(_to_json_object(windows, memory_mb), indent=1) + "\n")
    return 1 if any(window.errors for same_kind in windows.values() for window in same_kind) else 0


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
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--pause", type=float, default=0.0, help="seconds a reader waits between requests")
    parser.add_argument("--upload-pause", type=float, default=5.0, help="seconds an uploader waits")
    parser.add_argument("--conditional", action="store_true", help="readers keep what they have, as browsers do")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a window")
    parser.add_argument("--repeats", type=int, default=3, help="windows of each kind, by turns")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every window here")
    return parser


def _dataset_and_archive(options: argparse.Namespace, scratch: Path) -> tuple[Path, Path]:
    """Return the dataset and archive paths from the options, or those of synthetic ones written to ``scratch``."""
    if (options.data is None) != (options.archive is None):
        _parser().error("--data and --archive go together")
    if options.data is not None:
        return options.data, options.archive
    data, archive = scratch / "dataset", scratch / "archive.zip"
    write_dataset(data, CONFIGS, VIEWS)
    write_archive(archive, CONFIGS, VIEWS, "benchmark", SEED)
    return data, archive


def _distinct(archive: Path) -> Iterator[bytes]:
    """Yield copies of the archive that differ, because a leaderboard scores the same archive once."""
    copies = [distinct_archive(archive, number).read_bytes() for number in range(COPIES)]
    for number in itertools.count():
        yield copies[number] if number < COPIES else distinct_archive(archive, number).read_bytes()


def _plan(options: argparse.Namespace, served: ServerProcess, config: str, ids: Sequence[str]) -> LoadPlan:
    targets = (
        ("/", "/"),
        ("/?config=", f"/?config={config}"),
        ("/api/v1/leaderboard", f"/api/v1/leaderboard?config={config}"),
        *(("/submissions/ID", f"/submissions/{submission_id}") for submission_id in ids[:1]),
    )
    return LoadPlan(
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
    plan: LoadPlan, served: ServerProcess, database: Database, ids: Sequence[str], options: argparse.Namespace
) -> dict[str, list[LoadWindow]]:
    tokens = new_tokens(database, options.uploaders)
    windows: dict[str, list[LoadWindow]] = {ALONE: [], BUSY: []}
    run_load(replace(plan, seconds=WARM_UP_S), SEED)
    for turn in range(options.repeats):
        for name, with_tokens in ((ALONE, ()), (BUSY, tokens)):
            scored, cpu_s = filled_board.count_submissions(database, SCORED), served.cpu_s()
            result = run_load(replace(plan, tokens=with_tokens), SEED + 1000 * turn)
            scored, cpu_s = filled_board.count_submissions(database, SCORED) - scored, served.cpu_s() - cpu_s
            filled_board.clear_queue(database)
            filled_board.remove_scored_except(database, ids)
            windows[name].append(_window(result, scored, cpu_s))
    return windows


def _window(result: LoadResult, scored: int, server_cpu_s: float) -> LoadWindow:
    by_route = {ALL: result.all_read_s, **result.read_s}
    return LoadWindow(
        reads={route: _latency(route_seconds, result.wall_s) for route, route_seconds in by_route.items()},
        accepted_per_min=60 * len(result.upload_s) / result.wall_s,
        scored_per_min=60 * scored / result.wall_s,
        upload_p50_ms=1e3 * statistics.median(result.upload_s) if result.upload_s else 0.0,
        unchanged=result.unchanged / max(1, len(result.all_read_s)),
        client_cores=result.client_cores,
        server_cores=server_cpu_s / result.wall_s,
        errors=tuple(result.errors),
    )


def _latency(seconds: Sequence[float], wall_s: float) -> Latency:
    """Return the latency statistics of a route's reads, with nearest-rank percentiles."""
    ordered = sorted(seconds) or [0.0]
    p50, p99 = (ordered[min(len(ordered) - 1, int(share * len(ordered)))] for share in (0.5, 0.99))
    return Latency(len(seconds) / wall_s, 1e3 * p50, 1e3 * p99, 1e3 * ordered[-1])


def _print_report(windows: Mapping[str, Sequence[LoadWindow]], memory_mb: tuple[float, float]) -> None:
    repeats = len(windows[ALONE])
    print(f"Medians of {repeats} windows:\n")
    routes = windows[ALONE][0].reads
    rows = [
        (f"`{route}`", name, *_cells(same_kind, route)) for route in routes for name, same_kind in windows.items()
    ]
    print_markdown(["route", "", "a second", "p50 ms", "p99 ms", "max ms"], rows)
    busy = windows[BUSY]
    ratios = [
        with_uploads.reads[ALL].p99_ms / alone.reads[ALL].p99_ms
        for alone, with_uploads in zip(windows[ALONE], busy, strict=True)
    ]
    errors = [error for same_kind in windows.values() for w in same_kind for error in w.errors]
    print(f"\np99 with uploads and scoring over p99 without: {statistics.median(ratios):.2f}")
    print(
        f"uploads accepted a minute: {_median_of(busy, lambda w: w.accepted_per_min):.0f}, "
        f"median {_median_of(busy, lambda w: w.upload_p50_ms):.0f} ms each; "
        f"scored a minute: {_median_of(busy, lambda w: w.scored_per_min):.0f}"
    )
    print(f"answers 304: {_median_of(busy, lambda w: w.unchanged):.0%}; errors: {len(errors)} {errors[:3] or ''}")
    cpu_ms = _median_of(windows[ALONE], lambda w: 1e3 * w.server_cores / w.reads[ALL].per_s)
    print(f"processor time of the server for a read: {cpu_ms:.2f} ms")
    client = max(w.client_cores for same_kind in windows.values() for w in same_kind)
    print(f"the client took {client:.0%} of a core at most")
    print(f"memory of the server's process: {memory_mb[0]:.0f} MB before, {memory_mb[1]:.0f} MB after")


def _cells(windows: Sequence[LoadWindow], route: str) -> list[str]:
    figures = [astuple(window.reads[route]) for window in windows]
    return [f"{statistics.median(column):.0f}" for column in zip(*figures, strict=True)]


def _median_of(windows: Sequence[LoadWindow], figure: Callable[[LoadWindow], float]) -> float:
    return statistics.median(map(figure, windows))


def _to_json_object(
    windows: Mapping[str, Sequence[LoadWindow]], memory_mb: tuple[float, float]
) -> dict[str, object]:
    return {
        "machine": machine_description(),
        "windows": {name: [asdict(window) for window in same_kind] for name, same_kind in windows.items()},
        "server_mb": {"before": memory_mb[0], "after": memory_mb[1]},
    }


if __name__ == "__main__":
    sys.exit(main())
