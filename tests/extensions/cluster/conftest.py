"""A Dask scheduler with workers, as a site has them."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from app.extensions.cluster import workers as module
from tests import ROOT
from tests.waiting import LIMIT_S, wait_for


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """A busy machine may take minutes to start a worker."""
    monkeypatch.setattr(module, "WAIT_S", LIMIT_S)
    monkeypatch.setattr(module, "CONNECT_S", LIMIT_S)


@contextmanager
def started(path: Path, workers: int, **environment: str) -> Iterator[tuple[str, list[subprocess.Popen]]]:
    """A Dask scheduler and workers in a folder: its address, and the processes, that of the scheduler first."""
    at = path / "scheduler.json"
    start = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    # Found before a package `tests` that another project installs.
    environment["PYTHONPATH"] = str(ROOT)
    run = {"stderr": subprocess.DEVNULL, "cwd": path, "env": os.environ | environment}
    begun = [subprocess.Popen([*start, "--no-dashboard", "--scheduler-file", str(at)], **run)]

    def written():
        with suppress(OSError, ValueError):  # not there, or half
            return json.loads(at.read_text())["address"]

    address = wait_for(written)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(at), "--host", "127.0.0.1"]
    options = ["--nthreads", "2", "--no-dashboard", "--no-nanny"]
    begun += [subprocess.Popen([*worker, *options], **run) for _ in range(workers)]
    try:
        yield address, begun
    finally:
        for process in begun:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a Dask scheduler with two workers, each a process of its own."""
    with started(tmp_path_factory.mktemp("dask"), 2) as (address, _):
        yield address
