"""Black-box models: the same answers as compiled ones, on any executor; what they may not do is one
clear line; and a process that is killed leaves no workers behind."""

import os
import re
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from estimators.compiled import black_box
from estimators.compiled.black_box import _pool
from estimators.compiled.model import compile_model
from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, Events, Log
from estimators.registry import ESTIMATORS, find_estimator, unfit
from estimators.track import DIVERGED, FAILED, NONE
from estimators.tuning import Tuning
from tests.estimators.ensemble.blocks import BOX, ONE, both_block, f_block
from tests.support import as_log, assert_same, error_of, log_of
from tests.waiting import wait_for

COMPILED = [name for name, entry in ESTIMATORS.items() if entry.blocks is not None]


def some_log(events=80):
    rng = np.random.default_rng(4)
    log = Log(ONE.width)
    t = 0
    for _ in range(events):
        t += int(rng.choice([0, 40_000_000, 333_000_000]))
        kind = int(rng.choice([READING, INPUT, TICK, RESET], p=[0.8, 0.1, 0.08, 0.02]))
        sensor = int(rng.integers(2)) if kind == READING else 0
        values = {READING: rng.normal(0, 0.5, 2 - sensor), INPUT: rng.normal(0, 0.3, 1)}.get(kind, ())
        if kind == READING and rng.random() < 0.15:
            values[0] = np.nan
        log.extend(Events.one(t, t, kind, sensor, values, ONE.width))
    return log


def test_which_filters_run_on_blocks():
    assert {"enkf", "etkf", "ensrf", "letkf", "pf", "pf-reg"} <= set(COMPILED)
    for name in ("kf-steady", "ekf", "ukf", "ckf", "sr-ekf", "pf-ekf"):
        assert "duffing is a black box" in unfit(ESTIMATORS[name], BOX)
    with pytest.raises(EstimatorError, match="ukf does not apply: duffing is a black box.*not compiled.*use pf"):
        find_estimator("ukf", BOX)


@pytest.mark.parametrize("name", COMPILED)
def test_compiled_filters_give_the_bits_of_the_compiled_model(name):
    """The same arithmetic in blocks: all that could differ is a wrong member, which would be seen at once."""
    options = {"members": 30.0} if ESTIMATORS[name].family == "ensemble" else {"particles": 300.0}
    log = some_log()
    one, box = (fold(name, m, Tuning.of(m).with_options(options), log) for m in (ONE, BOX))
    assert_same(box, one)
    assert np.all(np.isfinite(box.mean))


@pytest.mark.parametrize("name", ["filterpy-ukf", "filterpy-enkf"])
def test_filterpy_without_derivatives_gives_the_bits_of_the_compiled_model(name):
    log = some_log()
    assert_same(*(fold(name, m, Tuning.of(m), log) for m in (BOX, ONE)))


def test_filterpy_ekf_differentiates_the_block():
    """Central differences of steps of 6e-6 are good to (6e-6)² f‴ + ε/6e-6, some 1e-10; a hundred steps gather more."""
    log = some_log()
    box, one = (fold("filterpy-ekf", m, Tuning.of(m), log) for m in (BOX, ONE))
    np.testing.assert_allclose(box.mean, one.mean, atol=1e-7)
    np.testing.assert_allclose(box.std, one.std, atol=1e-7)
    np.testing.assert_array_equal(box.verdict, one.verdict)


@pytest.mark.parametrize(
    "executor", ["threads", "processes", ThreadPoolExecutor(3)], ids=["threads", "processes", "own"]
)
def test_executors_split_the_block_and_change_nothing(executor):
    log = some_log(12)
    split = replace(BOX, executor=executor)
    tuning = Tuning.of(BOX).with_options({"members": 31.0})
    assert_same(fold("enkf", split, tuning, log), fold("enkf", BOX, tuning, log))


def test_an_executor_gets_pieces():
    sizes = []

    def watched(X, u, p, dt):
        sizes.append(len(X))
        return f_block(X, u, p, dt)

    box = compile_model(replace(BOX, f=watched, executor=ThreadPoolExecutor(3)))
    sizes.clear()
    X = np.random.default_rng(0).normal(0, 1, (31, 2))
    u, p = np.array([0.3]), np.array([0.7, 0.2])
    np.testing.assert_array_equal(box.f_block(X, u, p, 0.1), f_block(X, u, p, 0.1))
    assert sorted(sizes) == [10, 10, 11]


def test_a_worker_that_may_have_no_processes_calls_the_same_pieces_itself(monkeypatch):
    """A worker of Dask is a daemon. Blocks of another size may round differently."""
    pieces = []

    def watched(X, u, p, dt):
        pieces.append((len(X), os.getpid()))
        return f_block(X, u, p, dt)

    monkeypatch.setattr(black_box, "current_process", lambda: SimpleNamespace(daemon=True))
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 4)
    box = compile_model(replace(BOX, f=watched, executor="processes"))
    pieces.clear()
    X = np.random.default_rng(0).normal(0, 1, (31, 2))
    box.f_block(X, np.array([0.3]), np.array([0.7, 0.2]), 0.1)
    assert pieces == [(size, os.getpid()) for size in (8, 8, 8, 7)]


def test_one_state_at_a_time_for_the_simulator():
    one, box = compile_model(ONE), compile_model(BOX)
    x, u, p = np.array([0.3, -0.8]), np.array([0.3]), np.array([0.7, 0.2])
    for k, rows in ((None, 2), (0, 2), (1, 1)):
        a, b = np.empty(rows), np.empty(rows)
        for compiled, out in ((one, a), (box, b)):
            compiled.f(x, u, p, 0.1, out) if k is None else compiled.h[k](x, u, p, out)
        np.testing.assert_array_equal(a, b)


def fails(X, u, p, dt):
    raise RuntimeError("the solver\nis out of licences")


def writes(X, u, p, dt):
    X[:, 0] += 1.0
    return X


def mixes(X, u, p, dt):
    return X - X.mean(axis=0)


def draws(X, u, p, dt):
    return X + np.random.default_rng().normal(size=X.shape)


def drops(X, u, p, dt):
    return X[:, :1]


def infinite(X, u, p, dt):
    return X / 0.0


@pytest.mark.parametrize(
    ("function", "says"),
    [
        (fails, "f fails on a block of 3 states: RuntimeError: the solver is out of licences"),
        (writes, "f fails on .* read-only"),
        (mixes, "f returns another value for a state alone than in a block"),
        (draws, "f returns another value for a state alone than in a block"),
        (drops, r"f returns shape \(3, 1\) for 3 states; it must be \(3, 2\)"),
        (infinite, "f returns 2 of 2 numbers that are not finite at the prior"),
    ],
)
def test_what_a_black_box_may_not_do(function, says):
    with np.errstate(all="ignore"):
        assert re.search(f"model duffing: {says}", error_of(ModelError, compile_model, replace(BOX, f=function)))


class Held:
    """A function that cannot be pickled, for one of the reasons there are: pickle raises another error for each."""

    def __init__(self, kept):
        self.kept = kept

    def __call__(self, X, u, p, dt):
        return X


class Refuses(Held):
    def __reduce__(self):
        raise self.kept


def nested():
    deep = []
    for _ in range(100_000):
        deep = [deep]
    return deep


@pytest.mark.parametrize(
    "function",
    [
        lambda X, u, p, dt: X,
        (lambda: lambda X, u, p, dt: X)(),  # a local object: AttributeError, in other words since Python 3.13
        Held(Lock()),  # TypeError
        Held(nested()),  # RecursionError
        Refuses(ValueError("no copies")),  # whatever it likes
    ],
    ids=["lambda", "local", "lock", "nested", "refuses"],
)
def test_a_function_that_processes_cannot_import(function):
    with pytest.raises(ModelError, match="f fails on .*use threads"):
        compile_model(replace(BOX, f=function, executor="processes"))


def load_weights(X, u, p, dt):
    raise ValueError("pickle data was truncated")


@pytest.mark.parametrize("executor", [None, "threads", "processes"])
def test_a_function_that_speaks_of_pickles_is_to_be_mended(executor):
    with pytest.raises(ModelError, match="pickle data was truncated; mend it, or let it return NaN"):
        compile_model(replace(BOX, f=load_weights, executor=executor))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"executor": "gpu"}, "executor is 'gpu'; it must be 'threads', 'processes'"),
        ({"F": lambda x, u, p, dt, out: None}, "leave out F, H and log_likelihood"),
        ({"black_box": False, "executor": "threads"}, "executor is for a black box"),
    ],
)
def test_declarations_that_contradict_themselves(change, says):
    with pytest.raises(ModelError, match=says):
        replace(BOX, **change)


class Switch:
    """A black box whose functions fail while they are named in `off`."""

    def __init__(self):
        self.off = set()

    def f(self, X, u, p, dt):
        self.check("f")
        return f_block(X, u, p, dt)

    def both(self, X, u, p):
        self.check("both")
        return both_block(X, u, p)

    def check(self, name):
        if name in self.off:
            raise OSError("the licence server is away")

    def model(self):
        return replace(BOX, f=self.f, sensors=(replace(BOX.sensors[0], h=self.both), BOX.sensors[1]))


ANY = (*COMPILED, "filterpy-ekf", "filterpy-ukf", "filterpy-enkf")


def few(name):
    """A tuning with few members."""
    options = {"ensemble": {"members": 9.0}, "particle": {"particles": 60.0}}
    return Tuning.of(BOX).with_options(options.get(ESTIMATORS[name].family, {}))


def folded(name, switch, log, off):
    """A fold event by event; `off` says what fails at which event."""
    growing = Fold(name, switch.model(), few(name), log)
    for k in range(log.n):
        switch.off = {off[k]} if k in off else set()
        assert growing.advance(1) == 1
    return growing


@pytest.mark.parametrize("name", ANY)
def test_a_reading_whose_h_fails_is_as_one_without_a_value(name):
    """Nothing of the state may have changed, not even how often it drew: the bits behind it are the same."""
    log = some_log(40)
    fails = [int(k) for k in log.events.of_sensor(0)[3:8]]
    growing = folded(name, Switch(), log, dict.fromkeys(fails, "both"))
    without = some_log(40)
    without.value[fails] = np.nan
    expected = fold(name, BOX, few(name), without)
    track = growing.track
    assert np.all(track.verdict[fails] == FAILED) and growing.failures == len(fails)
    for column in ("mean", "std", "nis"):
        np.testing.assert_array_equal(getattr(track, column), getattr(expected, column))
    said = r"test_black_box.py:\d+: model duffing: h of sensor both fails on .* states?: OSError: the licence"
    assert re.search(said, str(growing.failure)) and "\n" not in str(growing.failure)
    # Once it answers again, a refold knows nothing of it.
    growing.rewind(0)
    growing.advance()
    assert_same(growing.track, fold(name, BOX, few(name), some_log(40)))


@pytest.mark.parametrize("name", ANY)
def test_a_reading_that_f_does_not_reach_is_as_if_it_had_not_come(name):
    """The estimate then is no number, and goes on from where it stood; so does one that a tick asks for."""
    log = some_log(40)
    kind, t = log.events.kind, log.events.t
    moves = np.flatnonzero((kind[1:] == READING) & (np.diff(t) > 0)) + 1
    # None of several at one time: the next of them would have to make the step.
    alone = [int(k) for k in moves if k + 1 < log.n and t[k + 1] > t[k]][2:5]
    tick = [int(k) for k in np.flatnonzero(kind == TICK) if t[k] > t[k - 1]][:1]
    assert len(alone) == 3 and tick
    growing = folded(name, Switch(), log, dict.fromkeys(alone + tick, "f"))
    kept = np.setdiff1d(np.arange(log.n), alone + tick)
    expected, track = fold(name, BOX, few(name), as_log(log.events.select(kept))), growing.track
    assert np.all(track.verdict[alone] == FAILED) and np.all(track.verdict[tick] == NONE)
    assert np.all(np.isnan(track.mean[alone + tick])) and np.all(np.isnan(track.std[alone + tick]))
    assert np.all(track.health[alone + tick] == DIVERGED)
    for column in ("mean", "std", "nis", "verdict"):
        np.testing.assert_array_equal(getattr(track, column)[kept], getattr(expected, column))


def test_an_f_that_fails_half_way_keeps_the_steps_that_were_made():
    """Of three steps to an input at 0.4 s the second fails: the next event goes on from 0.133 s, with that input.

    The tolerance is for 0.4 / 3 s, which the clock has in whole nanoseconds.
    """
    calls = [0, 0]

    def second_fails(X, u, p, dt):
        calls.append(dt)
        if len(calls) == 2:
            raise OSError("the licence server is away")
        return f_block(X, u, p, dt)

    first = (0.0, READING, [0.2, 0.1])
    model = replace(BOX, f=second_fails)
    growing = Fold(
        "filterpy-ukf", model, Tuning.of(BOX), log_of(ONE.width, first, (0.4, INPUT, [2.0]), (0.5, READING, [0.3, 0.2]))
    )
    calls.clear()
    growing.advance()
    assert growing.failures == 1 and np.isnan(growing.track.mean[1, 0])
    steps = log_of(ONE.width, first, (0.4 / 3, INPUT, [2.0]), (0.5, READING, [0.3, 0.2]))
    expected = fold("filterpy-ukf", BOX, Tuning.of(BOX), steps)
    np.testing.assert_allclose(growing.track.mean[2], expected.mean[2], rtol=1e-8)
    np.testing.assert_allclose(growing.track.std[2], expected.std[2], rtol=1e-8)


def test_a_whole_fold_of_a_black_box_that_fails_is_an_error():
    switch = Switch()
    model = switch.model()
    compile_model(model)
    switch.off = {"f"}
    with pytest.raises(ModelError, match="f fails on a block of 200 states: OSError.*return NaN in the rows of states"):
        fold("enkf", model, Tuning.of(model), some_log(5))


def gives_up(X, u, p, dt):
    raise SystemExit("no display")


def test_the_place_of_what_can_be_called_otherwise():
    """A partial, an object with __call__, one that ends the process, and one that fails in another process."""

    class Called:
        def __call__(self, X, u, p, dt):
            return fails(X, u, p, dt)

    def with_scale(scale, X, u, p, dt):
        raise ValueError("scale")

    for function in (partial(with_scale, 2.0), Called(), gives_up):
        with pytest.raises(ModelError, match=r"test_black_box.py:\d+: model duffing: f fails"):
            compile_model(replace(BOX, f=function))
    line = fails.__code__.co_firstlineno + 1
    with pytest.raises(ModelError, match=rf"test_black_box.py:{line}: model duffing: f fails .*out of licences"):
        compile_model(replace(BOX, f=fails, executor="processes"))


PARENT = """\
import os, time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from estimators.compiled.orphan import leave_with_parent

if __name__ == "__main__":
    pool = ProcessPoolExecutor(2, get_context("spawn"), initializer=leave_with_parent)
    print(*{pool.submit(os.getpid).result() for _ in range(20)}, flush=True)
    time.sleep(600)
"""


def alive(pid):
    """Whether a process runs; one that has ended and that nobody asked about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_workers_that_were_killed_between_two_calls_are_replaced():
    box = compile_model(replace(BOX, executor="processes"))
    X = np.random.default_rng(0).normal(0, 1, (31, 2))
    u, p = np.array([0.3]), np.array([0.7, 0.2])
    expected = box.f_block(X, u, p, 0.1)
    pool = _pool("processes")
    for worker in list(pool._processes.values()):
        worker.kill()
    wait_for(lambda: pool._broken)
    np.testing.assert_array_equal(box.f_block(X, u, p, 0.1), expected)
    assert _pool("processes") is not pool


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes as Linux shows them")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(PARENT)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as parent:
        workers = [int(pid) for pid in parent.stdout.readline().split()]
        assert workers and all(map(alive, workers))
        parent.send_signal(signal.SIGKILL)
    wait_for(lambda: not any(map(alive, workers)))
