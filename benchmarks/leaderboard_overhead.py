"""Benchmark of the leaderboard's overhead: requests per second beside a bare FastAPI app with the same bytes.

python -m benchmarks.leaderboard_overhead [--rows N] [--seconds S] [--repeats N]

Both servers run in processes of their own with uvicorn's h11 protocol, and are measured by turns with 1 and 50
clients. The bare app returns the bodies that the leaderboard has rendered, from memory, without middleware.
The share by processor time does not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import rebar_depth_bench as rdb
from benchmarks.filled_board import ServerProcess, add_scored_submissions, running_server
from benchmarks.http_load import LoadPlan, run_load
from benchmarks.timing import machine_description, print_markdown
from leaderboard.db.engine import Database
from leaderboard.settings import read_settings
from tests.leaderboard.serving import free_port
from tests.processes import wait_until
from tests.synthetic_dataset import write_archive, write_dataset

CLIENTS = (1, 50)
CONFIGS, VIEWS, SEED = ("lattice", "pile"), 24, 7

_BARE_APP = """
import sys
from pathlib import Path
import uvicorn
from fastapi import FastAPI
from fastapi.responses import Response

app = FastAPI()

def add_route(number: int, content: bytes) -> None:
    @app.get(f"/{number}")
    async def get() -> Response:
        return Response(content, media_type="text/html")

for number, path in enumerate(sorted(Path(sys.argv[2]).iterdir())):
    add_route(number, path.read_bytes())
uvicorn.run(app, port=int(sys.argv[1]), http="h11", access_log=False, log_level="warning")
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser("python -m benchmarks.leaderboard_overhead")
    parser.add_argument("--rows", type=int, default=200, help="scored rows on the board")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of a measurement")
    parser.add_argument("--repeats", type=int, default=3, help="measurements of each kind, by turns")
    options = parser.parse_args(arguments)
    print(f"{options.rows} rows; {machine_description()}; medians of {options.repeats}\n")
    with tempfile.TemporaryDirectory() as scratch:
        data, archive, state = (Path(scratch) / name for name in ("dataset", "archive.zip", "state"))
        state.mkdir(mode=0o700)
        write_dataset(data, CONFIGS, VIEWS)
        write_archive(archive, CONFIGS, VIEWS, "benchmark", SEED)
        settings = read_settings(None, {"data": str(data), "state_dir": state})
        with closing(Database(settings.database_url)) as database:
            database.migrate()
            ids = add_scored_submissions(database, rdb.score(archive, data).to_json(), options.rows, SEED)
        with running_server(data, state, "", 0) as served:
            targets = {
                "/": "/",
                "/?config=": f"/?config={CONFIGS[0]}",
                "/api/v1/leaderboard": f"/api/v1/leaderboard?config={CONFIGS[0]}",
                "/submissions/ID": f"/submissions/{ids[0]}",
            }
            bodies = Path(scratch) / "bodies"
            bodies.mkdir()
            for number, path in enumerate(targets.values()):
                with urllib.request.urlopen(f"http://{served.host}:{served.port}{path}") as response:
                    (bodies / f"{number:02d}").write_bytes(response.read())
            with bare_app(bodies) as bare:
                rows = []
                for number, (route, path) in enumerate(targets.items()):
                    size = (bodies / f"{number:02d}").stat().st_size
                    for clients in CLIENTS:
                        ours, others = _measure([(served, path), (bare, f"/{number}")], clients, options)
                        rates = (f"{ours.per_s:.0f}", f"{others.per_s:.0f}", f"{ours.per_s / others.per_s:.0%}")
                        times = (f"{1000 * ours.cpu_s:.2f}", f"{1000 * others.cpu_s:.2f}")
                        share = f"{others.cpu_s / ours.cpu_s:.0%}"
                        rows.append((f"`{route}`", f"{size / 1000:.0f}", clients, *rates, *times, share))
    heads = ["route", "kB", "clients", "leaderboard/s", "bare/s", "share"]
    print_markdown([*heads, "leaderboard ms", "bare ms", "share by processor time"], rows)
    return 0


@dataclass(frozen=True)
class Load:
    """Requests per second, and processor time of the server for a request in seconds."""

    per_s: float
    cpu_s: float


def _measure(
    servers: Sequence[tuple[ServerProcess, str]], clients: int, options: argparse.Namespace
) -> list[Load]:
    """Return the median loads of the servers and paths, measured by turns."""
    rates: list[list[float]] = [[] for _ in servers]
    times: list[list[float]] = [[] for _ in servers]
    for turn in range(options.repeats):
        for index, (server, path) in enumerate(servers):
            plan, before = (
                LoadPlan("127.0.0.1", server.port, [(path, path)], clients, options.seconds),
                server.cpu_s(),
            )
            result = run_load(plan, SEED + turn)
            assert not result.errors, result.errors[:3]
            rates[index].append(len(result.all_read_s) / result.wall_s)
            times[index].append((server.cpu_s() - before) / len(result.all_read_s))
    return [Load(*map(statistics.median, pair)) for pair in zip(rates, times, strict=True)]


@contextmanager
def bare_app(bodies: Path) -> Iterator[ServerProcess]:
    """Run the bare app until the block ends."""
    port = free_port()
    process = subprocess.Popen([sys.executable, "-c", _BARE_APP, str(port), str(bodies)])
    try:
        wait_until(lambda: _answers(port), "the bare app answers")
        yield ServerProcess("127.0.0.1", port, process.pid)
    finally:
        process.kill()
        process.wait()


def _answers(port: int) -> bool:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/0", timeout=5):
            return True
    except OSError:
        return False


if __name__ == "__main__":
    sys.exit(main())
