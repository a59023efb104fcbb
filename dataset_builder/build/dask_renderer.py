"""Rendering on the machines of a dask cluster. The only module that imports ``distributed``.

Machines share no file system: a unit travels there as a plain value, is rendered in a Blender process in the
worker's scratch folder, and comes back as bytes with their digests. A worker that is lost has its units rendered
by others; they give the same bytes. An assembly file, which only this machine has, is handed out once and
passed on between the workers.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import uuid
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError, Future
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import distributed
from distributed.comm import get_address_host_port
from distributed.scheduler import KilledWorker

from dataset_builder.build.blender_process import BlenderProcesses
from dataset_builder.build.plan import generator_stamp
from dataset_builder.build.local_renderer import OnView, render_unit
from dataset_builder.build.shards import Staging
from dataset_builder.config.specs import CageFileSpec, ConfigSpec, MeshFileSpec
from dataset_builder.build.work_units import Delivery, Unit, check_stamp, packed
from rebar_depth_bench.errors import BuildError, InputError, RenderProcessError

_CONNECT_S = 10


@dataclass
class ClusterRenderer:
    """Renders units on the workers that ``client`` reaches."""

    client: distributed.Client
    keys: dict[str, Unit] = field(default_factory=dict)
    """What each key that dask knows stands for."""
    files: dict[str, distributed.Future] = field(default_factory=dict)
    """The assembly files on the cluster, by SHA-256. A lost one is made again from what the scheduler keeps."""

    def submit(self, unit: Unit, staging: Staging, on_view: OnView) -> Future[Delivery]:  # noqa: ARG002
        """Render ``unit`` on the next free worker; each view that is done there is told in a topic of its own."""
        key = f"render-{unit.config.name}-{uuid.uuid4().hex}"
        self.keys[key] = unit
        self.client.subscribe_topic(key, lambda event: on_view(event[1]))
        future: Future[Delivery] = self.client.get_executor(pure=False).submit(
            render_away, unit, self._assembly_file(unit.config), key=key
        )
        return future

    def _assembly_file(self, config: ConfigSpec) -> distributed.Future | None:
        spec = config.scene.assembly
        if not isinstance(spec, CageFileSpec | MeshFileSpec):
            return None
        if spec.sha256 not in self.files:
            key = f"assembly-{uuid.uuid4().hex}"
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Sending large graph", UserWarning)  # once, and it has to go
                self.files[spec.sha256] = self.client.submit(bytes, _content(spec), key=key, pure=False)
        return self.files[spec.sha256]


def _content(spec: CageFileSpec | MeshFileSpec) -> bytes:
    """Return an assembly file's bytes; raise ``InputError`` where they are not the ones that were planned with."""
    content = Path(spec.path).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != spec.sha256:
        raise InputError(f"{spec.path}: changed since it was chosen: sha256 {found} found, {spec.sha256} expected")
    return content


@contextmanager
def on_cluster(address: str) -> Iterator[ClusterRenderer]:
    """Connect to the dask scheduler at ``address``; on leaving, what is queued there is cancelled.

    Raises ``InputError`` where no scheduler answers within 10 s, where it has no worker by then, or where software
    is missing or different on it; ``RenderProcessError`` when several workers died over one unit, ``BuildError``
    when the scheduler is lost.
    """
    with _quiet_client(), closing(_connect(address)) as client:
        renderer = ClusterRenderer(client)
        with _in_words(renderer, address):
            _check_machines(client, address)
            yield renderer


@contextmanager
def _in_words(renderer: ClusterRenderer, address: str) -> Iterator[None]:
    """Raise what dask says of lost machines as errors of ours."""
    try:
        yield
    except KilledWorker as error:
        raise RenderProcessError(
            f"{_what(renderer, error.task)}: {error.allowed_failures + 1} workers died while they rendered it, "
            f"the last at {error.last_worker.address}; their own logs say why"
        ) from None
    except CancelledError:
        raise BuildError(
            f"the dask scheduler at {address} was lost; run the same command again to go on when it is up"
        ) from None


@contextmanager
def _quiet_client() -> Iterator[None]:
    """Keep dask from printing tracebacks of what is told in words."""
    logger = logging.getLogger("distributed.client")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def _what(renderer: ClusterRenderer, key: object) -> str:
    return renderer.keys[key].what if isinstance(key, str) and key in renderer.keys else "the assembly file"


def _connect(address: str) -> distributed.Client:
    expected = "expected the address that `dask scheduler` printed, such as tcp://host:8786"
    try:
        get_address_host_port(address)  # a client that fails over a bad address does not close in peace
    except ValueError as error:
        raise InputError(f"--cluster {address}: is no address ({_first_line(error)}), {expected}") from None
    try:
        return distributed.Client(address, timeout=_CONNECT_S, set_as_default=False, name="rebar-build")
    except (OSError, ImportError) as error:
        raise InputError(
            f"--cluster {address}: no dask scheduler answers there ({_first_line(error)}), {expected}"
        ) from None


def _check_machines(client: distributed.Client, address: str) -> None:
    """Raise ``InputError`` unless there are workers, and every machine has this software in the same versions."""
    try:
        client.wait_for_workers(1, timeout=_CONNECT_S)
    except TimeoutError:
        raise InputError(
            f"--cluster {address}: has no workers after {_CONNECT_S} s, expected one or more: "
            f"on each machine that renders, run: dask worker {address} --nthreads 1"
        ) from None
    ours = generator_stamp()
    for worker, stamp in client.run(generator_stamp, on_error="return").items():
        if isinstance(stamp, Mapping):
            check_stamp(ours, worker, stamp)
        else:
            raise _unable(f"worker {worker}", stamp)
    try:
        client.run_on_scheduler(generator_stamp)
    except ImportError as error:
        raise _unable(f"the scheduler {address}", error) from None


def _unable(machine: str, error: object) -> InputError:
    stamp = generator_stamp()
    return InputError(
        f"{machine} cannot run this software ({_first_line(error)}), expected "
        f"rebar-depth-bench[build,cluster] {stamp['rebar-depth-bench']} there"
    )


def _first_line(error: object) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def render_away(unit: Unit, assembly_file: bytes | None) -> Delivery:
    """Render a unit on a dask worker, in its scratch folder, and return the delivery with its bytes.

    Raises ``InputError`` where the worker's software is not the parent's, ``BuildError`` that names the worker
    where it cannot finish.
    """
    worker = distributed.get_worker()
    check_stamp(unit.stamp, worker.address, generator_stamp())
    threads = max(1, (os.cpu_count() or 1) // worker.state.nthreads)
    with (
        tempfile.TemporaryDirectory(prefix="rebar-unit-", dir=worker.local_directory) as scratch,
        BlenderProcesses() as blender,
    ):
        own = replace(unit, config=_with_own_file(unit.config, assembly_file, Path(scratch)))
        staging = Staging(Path(scratch) / "staging")
        staging.root.mkdir()
        try:
            delivery = render_unit(own, staging, threads, blender, _view_teller(worker), worker.address)
        except BuildError as error:
            raise type(error)(f"worker {worker.address}: {error}") from None
        except InputError as error:
            raise InputError(f"worker {worker.address}: {error}") from None
        return packed(delivery, unit, staging)


def _with_own_file(config: ConfigSpec, content: bytes | None, folder: Path) -> ConfigSpec:
    """Return the config with its assembly file read from ``folder``, under the name that it has."""
    spec = config.scene.assembly
    if content is None or not isinstance(spec, CageFileSpec | MeshFileSpec):
        return config
    own = folder / Path(spec.path).name
    own.write_bytes(content)
    return replace(config, scene=replace(config.scene, assembly=replace(spec, path=str(own))))


def _view_teller(worker: Any) -> OnView:
    """Return what tells the parent of each view, and ends a unit that it no longer waits for."""
    key = worker.get_current_task()

    def tell(index: int) -> None:
        task = worker.state.tasks.get(key)
        if task is None or task.state == "cancelled":
            raise BuildError("the build that asked for this unit has ended")
        worker.log_event(key, index)

    return tell
