"""Workers of a Dask cluster, which make the calls of a command."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numba

from app.study.processes import deaf
from estimators.errors import ConfigError, NisusError

LOCAL = "local:"
MAX_LOCAL = 256  # Processes of a cluster on this machine
WAIT_S, CONNECT_S = 60, 10  # for a worker of a cluster, and for its scheduler
WATCH_S = 5.0  # seconds between two looks whether a cluster has a worker

_REMEDY = "give the address of a Dask scheduler, as in tcp://127.0.0.1:8786, or local:4 for four processes here"

_turn, _begun = threading.Lock(), [""]
"""Lock for one call at a time on this worker, and the work whose `begin` has been called."""


class Cluster:
    """Workers of a Dask cluster."""

    def __init__(self, client: Any, begin: Callable[..., None], given: tuple[object, ...]) -> None:
        """Take a client; `begin` is called with `given` on each worker before its first call."""
        self._client, self._executor = client, client.get_executor(pure=False)
        self._command = uuid.uuid4().hex, version("nisus"), os.getcwd()
        self._begin, self._closed, self.deserted = self.hold((begin, given)), threading.Event(), False

    def submit(self, work: Callable[..., object], *call: object) -> Future:
        """Submit a call; another worker makes it again if one dies. Its arguments may be held."""
        return self._executor.submit(_on_worker, self._command, self._begin, work, *call)

    def hold(self, value: object) -> object:
        """Send a value to the cluster: to each worker with its first call that has it among its arguments."""
        # A task rather than data: it is made again if the worker that holds it dies.
        return self._client.submit(_same, value, pure=False)

    def workers(self) -> int:
        """Return the present number of workers."""
        return len(self._client.nthreads())

    def watch(self) -> None:
        """Cancel all calls once there has been no worker for `WAIT_S`, since nothing else would end them."""
        seen = time.monotonic()
        while not self._closed.wait(WATCH_S):
            with suppress(Exception):  # of a lost connection, which ends the calls by itself
                if self.workers():
                    seen = time.monotonic()
                elif time.monotonic() - seen > WAIT_S:
                    self.deserted = True
                    self._executor.shutdown(wait=False)
                    return

    def close(self) -> None:
        """Leave the cluster without waiting for calls."""
        self._closed.set()
        self._executor.shutdown(wait=False)
        self._client.close()


@contextmanager
def dask(address: str, begin: Callable[..., None], given: tuple[object, ...]) -> Iterator[Cluster]:
    """Context manager: the workers of a cluster; for the arguments and errors see `app.study.processes.results`."""
    try:
        from distributed import Client, LocalCluster
        from distributed.comm import connect
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise ConfigError("--cluster: needs Dask; install it with `pip install 'nisus[cluster]'`") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # a lost connection is an error of the command
    warnings.filterwarnings("ignore", "Sending large graph")  # a long log, which is sent once to each worker
    own = None

    async def knock() -> None:
        (await connect(address, timeout=0.9 * CONNECT_S)).abort()

    if not address.startswith(LOCAL):
        # A Client that does not connect waits for its loop, which has ended, for two minutes when it is deleted.
        try:
            asyncio.run(asyncio.wait_for(knock(), CONNECT_S))
        except (OSError, ValueError, TypeError) as error:
            reason = str(error).splitlines()[0] if str(error) else "no answer"
            raise ConfigError(f"--cluster {address}: {reason}; {_REMEDY}") from None
    with deaf():
        if address.startswith(LOCAL):
            count = address.removeprefix(LOCAL)
            if not count.isdecimal() or not 0 < int(count) <= MAX_LOCAL:
                raise ConfigError(f"--cluster {address}: give 1 to {MAX_LOCAL} processes, for example local:4")
            own = LocalCluster(
                n_workers=int(count), threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0",
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
        client = Client(own or address, timeout=WAIT_S, set_as_default=False)
    workers = Cluster(client, begin, given)
    start = f"start one with `dask worker {address} --nthreads 1`"
    try:
        try:
            client.wait_for_workers(1, timeout=WAIT_S)
        except TimeoutError:
            raise ConfigError(f"--cluster {address}: has no worker; {start}") from None
        # Without Nisus a worker ends at its first call, and a scheduler answers none.
        found = {f"the worker {at}": it for at, it in client.run(version, "nisus", on_error="return").items()}
        with suppress(PackageNotFoundError):
            found["its scheduler"] = client.run_on_scheduler(version, "nisus")
        lacking = [name for name in (*found, "its scheduler") if not isinstance(found.get(name), str)]
        if lacking:
            raise ConfigError(f"--cluster {address}: {lacking[0]} has no Nisus; install {version('nisus')} there")
        threading.Thread(target=workers.watch, name="cluster", daemon=True).start()
        yield workers
    except KilledWorker as error:
        text = f"{error.allowed_failures + 1} workers died in one call; is their memory enough? See their logs"
        raise ConfigError(f"--cluster {address}: {text}") from None
    except CancelledError:
        if workers.deserted:
            text = f"has had no worker for {WAIT_S} s; see their logs, or {start}"
            raise ConfigError(f"--cluster {address}: {text}") from None
        text = "the connection to the scheduler is lost; see its log, and run the command again"
        raise ConfigError(f"--cluster {address}: {text}") from None
    finally:
        workers.close()
        if own is not None:
            with suppress(TimeoutError):
                own.close(timeout=WAIT_S)


def _on_worker(
    command: tuple[str, str, str], held: tuple[Callable[..., None], tuple[object, ...]], work: Callable[..., object],
    *call: object,
) -> object:  # fmt: skip
    """Make a call on a worker, which may have threads and serve other commands; `begin` sets variables of a module."""
    name, wanted, folder = command
    if version("nisus") != wanted:
        raise ConfigError(f"--cluster: a worker has Nisus {version('nisus')}, this is {wanted}; install the same")
    begin, given = held
    with _turn:
        with suppress(OSError):  # relative paths, which are not found if the folder is not there
            os.chdir(folder)
        if _begun[0] != name:
            try:
                begin(*given)
            except NisusError as error:
                text = "workers need the files of the twin at the same path"
                raise ConfigError(f"--cluster: a worker of {socket.gethostname()} fails: {error}; {text}") from None
            _begun[0] = name
        numba.set_num_threads(1)
        return work(*call)


def _same(value: object) -> object:
    return value
