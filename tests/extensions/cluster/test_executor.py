"""Folds of one twin on a cluster: the bits of one process, for any tasks and workers; what is sent; an end early."""

import os
import pickle
import socket
import subprocess
import sys
from collections import Counter
from concurrent.futures import Future

import numpy as np
import pytest

from app.extensions.cluster import executor as module
from app.extensions.cluster.executor import ClusterExecutor, functions_of, packed, unpacked
from app.result import to_json
from app.study.check import check, figures
from app.study.checklist import checklist
from app.study.processes import executor_of
from app.twin.log_reader import read_log
from app.twin.twin import load_twin, with_held
from estimators.errors import ConfigError
from estimators.fit.fit import fit
from estimators.fit.objective import Cancelled
from estimators.fit.recording import Recording
from tests import ROOT
from tests.app.study.test_processes import bits
from tests.waiting import LIMIT_S

NAME, OVERRIDES = "motor_winding", {"R.winding": "0.2"}


@pytest.fixture(scope="module")
def twin():
    return load_twin(NAME, overrides=OVERRIDES)


@pytest.fixture(scope="module")
def log(twin):
    return read_log(twin, 300.0)[0]


def fitted(twin, log, **options):
    return fit(twin.estimator, with_held(twin).tuning, [Recording(log.copy())], **options)


def checked(twin, log, **options):
    found = check(twin, log.copy(), Counter(), **options)
    told = figures(found, checklist(found))
    # The seconds of a step, and the answers that follow from them, are measured.
    return {key: value for key, value in told.items() if key not in ("dimension", "checklist")}


@pytest.mark.parametrize("task", [1e-9, 1e9], ids=["one call a task", "one task a worker"])
def test_a_fit_on_a_cluster_is_the_same_bits(scheduler, twin, log, task, monkeypatch):
    monkeypatch.setattr(module, "TASK_S", task)
    with executor_of(scheduler, twin, with_held(twin), NAME, OVERRIDES) as executor:
        found = fitted(twin, log, executor=executor)
    assert bits(found) == bits(fitted(twin, log)) == bits(fitted(twin, log, executor=None))


def test_a_check_on_a_cluster_is_the_same_bits(scheduler, twin, log):
    with executor_of(scheduler, twin, with_held(twin), NAME, OVERRIDES) as executor:
        found = checked(twin, log, executor=executor)
    assert len(found) > 8 and to_json(found) == to_json(checked(twin, log))


class Here:
    """A cluster of one worker that is this process and begins no call by itself."""

    def __init__(self):
        self.futures: list[Future] = []
        self.sent: list[bytes] = []

    def submit(self, work, *call):
        self.futures.append(Future())
        self.call = work, call
        return self.futures[-1]

    def hold(self, value):
        self.sent.append(value[1])
        return value

    def workers(self):
        return 1


def test_a_function_is_sent_once_and_calls_that_have_not_begun_are_cancelled():
    cluster = Here()
    executor = ClusterExecutor(cluster, [])
    results = executor.map(divmod, [7], [2])
    work, (sent, items) = cluster.call
    cluster.futures[0].set_result((1.0, work(sent, items)[1]))
    assert list(results) == [(3, 1)]
    results = executor.map(divmod, [7, 8, 9], [2, 3, 4])
    executor.map(divmod, [1], [1])
    assert len(cluster.sent) == 1 and len(cluster.futures) == 5
    work, (sent, items) = cluster.call
    cluster.futures[1].set_result(work(sent, [(7, 2)]))
    assert items == [(1, 1)] and next(results) == (3, 1)
    results.close()
    assert [future.cancelled() for future in cluster.futures] == [False, False, True, True, False]


def test_the_first_call_tells_how_many_make_a_task():
    """Of a function that is called in one `map` alone, such as the faults of a check."""
    cluster = Here()
    results = ClusterExecutor(cluster, []).map(divmod, range(40), [3] * 40)
    assert len(cluster.futures) == 1
    work, (sent, items) = cluster.call
    cluster.futures[0].set_result((0.01, work(sent, items)[1]))
    assert next(results) == (0, 0) and len(cluster.futures) == 1 + 4  # 0.1 s each
    work, (sent, items) = cluster.call
    assert items == [(k, 3) for k in range(31, 40)]


def draws(seed):
    return np.random.default_rng(seed).normal(size=10_001)


class Wire(Here):
    """A cluster whose messages have a header of two bytes, as Dask's may: the numbers after it are not aligned."""

    def submit(self, work, *call):
        parts: list[pickle.PickleBuffer] = []
        message = pickle.dumps(work(*call), 5, buffer_callback=parts.append)
        moved = [memoryview(bytearray(b"\0\0" + part.raw().tobytes()))[2:] for part in parts]
        future: Future = Future()
        future.set_result(pickle.loads(message, buffers=moved))
        return future


def test_arrays_of_a_cluster_have_the_sums_of_this_process():
    """NumPy sums an array that is not aligned in pieces of 8,192 numbers, which rounds differently."""
    found = list(ClusterExecutor(Wire(), []).map(draws, range(16)))
    assert [values.sum() for values in found] == [draws(seed).sum() for seed in range(16)]


def test_a_cancelled_fit_ends(scheduler, twin, log):
    asked = []
    with executor_of(scheduler, twin, with_held(twin), NAME, OVERRIDES) as executor, pytest.raises(Cancelled):
        fitted(twin, log, executor=executor, go=asked.append)
    assert len(asked) == 1


def test_functions_are_sent_as_their_places_and_arrays_are_aligned():
    other = load_twin("motor_can")
    functions = functions_of(other.model)
    # Those of sensors are local functions, which cannot be pickled.
    assert any("<locals>" in function.__qualname__ for function in functions)
    data = packed((1, other.model, np.arange(9.0)), functions)
    _, model, values = unpacked(data, functions)
    assert model == other.model and model.f is other.model.f and values.flags.aligned
    assert unpacked(data, list(reversed(functions)))[1].f is not other.model.f


@pytest.mark.parametrize("command", ["check", "tune"])
def test_the_commands_take_a_cluster(nisus, command):
    assert "--cluster nowhere: " in nisus.refuses(command, NAME, "--duration", 60, "--cluster", "nowhere")


def test_a_wrong_address_ends_the_command():
    """A Client of Dask that does not connect waits two minutes for its own end."""
    command = [sys.executable, "-m", "app.cli.main", "check", "motor_winding", "--cluster", "http://x"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, text=True, capture_output=True, timeout=LIMIT_S)
    # Before it stands that filters are compiled, if that takes long.
    (line,) = (line for line in done.stderr.splitlines() if not line.startswith("compil"))
    assert done.returncode == 2 and line.startswith("nisus: --cluster http://x: unknown address scheme")


def test_a_server_of_another_kind_is_told(twin, monkeypatch):
    monkeypatch.setattr("app.extensions.cluster.workers.CONNECT_S", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with (
            pytest.raises(ConfigError, match=f"--cluster {address}: .*; give the address of a Dask scheduler"),
            executor_of(address, twin, twin, NAME, {}),
        ):
            pass
