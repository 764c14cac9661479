"""Work in parallel: what it returns, and that none is left of work that is given up.

Every fold of a fit is made in its executor, and any executor gives the same bits.
"""

import multiprocessing
import os
import signal
import time
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import suppress
from multiprocessing import get_context

import numba
import numpy as np
import pytest

from app.study.fit_json import fit_json
from app.study.processes import executor_of, jobs_of, results
from config import extensions
from estimators.errors import ConfigError
from estimators.fit.fit import fit
from estimators.fit.recording import Recording
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import MODEL, log_of, simulated
from tests.waiting import wait_for

_begun: list[int] = []


def begin(number):
    """What a process does first."""
    _begun.append(number)


def double(number):
    return 2 * number, numba.get_num_threads(), list(_begun)


def interrupt(marker):
    """Send Ctrl-C to the parent in the first call, which leaves its process id; take ten minutes in each."""
    with suppress(FileExistsError):
        with open(marker, "x") as file:
            file.write(str(os.getpid()))
        os.kill(os.getppid(), signal.SIGINT)
    time.sleep(600)


def handled():
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_call_is_answered_once(jobs):
    before, _begun[:] = numba.get_num_threads(), []
    found = dict(results(double, [(1,), (2,), (3,)], jobs=jobs, begin=begin, given=(7,)))
    assert found == {k: (2 * k + 2, 1, [7]) for k in range(3)}
    assert numba.get_num_threads() == before


def test_what_is_given_up_ends(tmp_path, interruptible):
    """Without a wait for work that has begun: the ten minutes would be over before the test."""
    marker = tmp_path / "begun"
    running = results(interrupt, [(str(marker),)] * 3, jobs=2)
    with pytest.raises(KeyboardInterrupt):
        try:
            next(running)
        finally:
            pids = {child.pid for child in multiprocessing.active_children()}
    pids.add(int(marker.read_text()))
    wait_for(lambda: all(map(_gone, pids)))


def _gone(pid):
    """By the system: which thread of the pool has heard of it does not matter."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_ctrl_c_is_for_the_parent_alone():
    assert dict(results(handled, [(), ()], jobs=2)) == {0: True, 1: True}
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_no_process_is_no_number_of_processes():
    assert jobs_of(3, 2) == 2 and jobs_of(None, 1) == 1
    with pytest.raises(ConfigError, match="--jobs 0: must be 1 or more"):
        jobs_of(0, 2)


def test_a_cluster_has_processes_of_its_own():
    with pytest.raises(ConfigError, match="--jobs: counts processes of this command"):
        list(results(handled, [(), ()], cluster="local:2", jobs=2))


@pytest.mark.parametrize(
    "work",
    [lambda: list(results(handled, [()], cluster="local:2")), lambda: executor_of("local:2", None, None, "", {})],
)
def test_a_cluster_without_its_extension_is_one_line(work, monkeypatch):
    monkeypatch.setattr(extensions, "registered", lambda kind: {})
    monkeypatch.setitem(extensions._left_out, "dask", "no module")
    text = r"^--cluster local:2: needs an extension; .*'nisus\[cluster\]'`; ext.* loaded: .*\bdask \(no module\)$"
    with pytest.raises(ConfigError, match=text):
        work()


def test_without_a_cluster_the_folds_run_in_threads():
    with executor_of(None, None, None, "", {}) as executor:
        assert executor == "threads"


def bits(found):
    return repr(fit_json(found)), found.correlation.tobytes(), found.after.held_out.terms.tobytes()


def both_report():
    log = log_of(simulated(3, 300))
    log.add("silent", np.arange(300) + 0.5, simulated(4, 300))
    return log


class Counting(Executor):
    """Makes calls here, and counts them."""

    def __init__(self):
        self.calls = 0

    def map(self, fn, *iterables, timeout=None, chunksize=1):
        for items in zip(*iterables, strict=True):
            self.calls += 1
            yield fn(*items)


def test_every_fold_of_a_fit_is_made_in_its_executor():
    executor = Counting()
    options = {"wanted": ("Q", "R"), "considered": {"rate": 0.05, "offset": 1.0}}
    found = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=executor, **options)
    assert found.widths is not None and len(found.after.held_out.sensors) == 2
    assert executor.calls == found.folds  # of one recording


def test_judgement_and_widths_in_processes_are_the_same_bits():
    options = {"considered": {"rate": 0.05, "offset": 1.0}}
    with ProcessPoolExecutor(2, get_context("spawn")) as executor:
        found = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=executor, **options)
    here = fit("kf", Tuning.of(MODEL), [Recording(both_report())], executor=None, **options)
    assert bits(found) == bits(here) and found.widths.envelope == here.widths.envelope
    assert found.widths.std.tobytes() == here.widths.std.tobytes()
