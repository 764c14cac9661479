"""Black-box models: the same answers as compiled ones, on any executor; what they may not do is one clear line."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from blocks import BOX, ONE, both_block, f_block
from test_fold import identical

from estimators.compiled import compile_model
from estimators.errors import EstimatorError, ModelError
from estimators.fold import Fold, fold
from estimators.log import INPUT, READING, RESET, TICK, Log, Readings
from estimators.registry import ESTIMATORS, find_estimator, unfit
from estimators.tuning import Tuning

SECOND = 1_000_000_000
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
        log.extend(Readings.one(t, t, kind, sensor, values, ONE.width))
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
    identical(box, one)
    assert np.all(np.isfinite(box.mean))


@pytest.mark.parametrize("name", ["filterpy-ukf", "filterpy-enkf"])
def test_filterpy_without_derivatives_gives_the_bits_of_the_compiled_model(name):
    log = some_log()
    identical(*(fold(name, m, Tuning.of(m), log) for m in (BOX, ONE)))


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
    identical(fold("enkf", split, tuning, log), fold("enkf", BOX, tuning, log))


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
    with np.errstate(all="ignore"), pytest.raises(ModelError, match=f"model duffing: {says}") as caught:
        compile_model(replace(BOX, f=function))
    assert "\n" not in str(caught.value)


def test_a_function_that_processes_cannot_import():
    with pytest.raises(ModelError, match="f fails on .*use threads"):
        compile_model(replace(BOX, f=lambda X, u, p, dt: X, executor="processes"))


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


def test_a_failure_in_the_middle_leaves_a_fold_that_can_go_on():
    """The sensor's function fails once; the fold is then where it remembers itself, and folds to the same bits."""
    broken = [False]

    def both(X, u, p):
        if broken[0]:
            raise OSError("the licence server is away")
        return both_block(X, u, p)

    model = replace(BOX, sensors=(replace(BOX.sensors[0], h=both), BOX.sensors[1]))
    log = some_log(150)
    growing = Fold("enkf", model, Tuning.of(model), log)
    growing.advance(100)
    broken[0] = True
    with pytest.raises(ModelError, match="h of sensor both fails on a block of 50 states: OSError: the licence server"):
        growing.advance()
    assert growing.n <= 100
    broken[0] = False
    growing.advance()
    identical(growing.track, fold("enkf", BOX, Tuning.of(BOX), log))
