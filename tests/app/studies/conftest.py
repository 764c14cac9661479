"""A Dask scheduler with workers, as a site has them."""

import json
import subprocess
import sys

import pytest

from tests.app.scripted import wait_for


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """The address of a Dask scheduler with two workers, each a process of its own; and those processes."""
    path = tmp_path_factory.mktemp("dask")
    at = path / "scheduler.json"
    start = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    run = {"stderr": subprocess.DEVNULL, "cwd": path}
    begun = [subprocess.Popen([*start, "--no-dashboard", "--scheduler-file", str(at)], **run)]
    wait_for(at.is_file)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(at), "--host", "127.0.0.1"]
    begun += [subprocess.Popen([*worker, "--nthreads", "2", "--no-dashboard", "--no-nanny"], **run) for _ in range(2)]
    yield json.loads(at.read_text())["address"]
    for process in begun:
        process.kill()
        process.wait()
