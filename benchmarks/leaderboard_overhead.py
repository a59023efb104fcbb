"""Benchmark of the leaderboard's overhead: requests per second beside a bare FastAPI app with the same bytes.

python -m benchmarks.leaderboard_overhead [--rows N] [--seconds S] [--repeats N]

Both servers run in processes of their own with uvicorn's h11 protocol, and are measured by turns with 1 and 50
clients. The bare app returns the bodies that the leaderboard has rendered, from memory, without middleware.
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
from pathlib import Path

import rebar_depth_bench as rdb
from benchmarks.filled_board import add_scored_submissions, running_server
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
            with bare_app(bodies) as bare_port:
                rows = []
                for number, (route, path) in enumerate(targets.items()):
                    size = (bodies / f"{number:02d}").stat().st_size
                    for clients in CLIENTS:
                        ours, bare = _rates([(served.port, path), (bare_port, f"/{number}")], clients, options)
                        rows.append(
                            (
                                f"`{route}`",
                                f"{size / 1000:.0f}",
                                clients,
                                f"{ours:.0f}",
                                f"{bare:.0f}",
                                f"{ours / bare:.0%}",
                            )
                        )
    print_markdown(["route", "kB", "clients", "leaderboard/s", "bare/s", "share"], rows)
    return 0


def _rates(servers: Sequence[tuple[int, str]], clients: int, options: argparse.Namespace) -> list[float]:
    """Return the median rates of the (port, path) pairs, measured by turns."""
    rates: list[list[float]] = [[] for _ in servers]
    for turn in range(options.repeats):
        for index, (port, path) in enumerate(servers):
            plan = LoadPlan("127.0.0.1", port, [(path, path)], clients, options.seconds)
            result = run_load(plan, SEED + turn)
            assert not result.errors, result.errors[:3]
            rates[index].append(len(result.all_read_s) / result.wall_s)
    return [statistics.median(one) for one in rates]


@contextmanager
def bare_app(bodies: Path) -> Iterator[int]:
    """Run the bare app until the block ends; yield its port."""
    port = free_port()
    process = subprocess.Popen([sys.executable, "-c", _BARE_APP, str(port), str(bodies)])
    try:
        wait_until(lambda: _answers(port), "the bare app answers")
        yield port
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
