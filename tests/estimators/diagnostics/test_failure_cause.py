"""A reading that fails because of the model: the function, the state and the remedy are named, and nothing else is."""

import re
from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.failure_cause import failures
from estimators.fold_failures import cause_of
from estimators.log import INPUT, READING, TICK
from estimators.model.assemble import JointParameter, joint
from estimators.model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from estimators.track import FAILED
from estimators.tuning import Tuning
from tests.estimators.ensemble.blocks import BOX, both_block, f_block
from tests.models import first_state
from tests.support import folded, log_of


def drift(x, u, p, dt, out):
    out[0] = x[0] + u[0] * dt


def shrinking(x, u, p, q, dt, out):
    """A variance at the prior, and none beyond x = 1."""
    out[0, 0] = q[0] * dt * (1.0 - x[0])


def nowhere(x, u, p, q, dt, out):
    out[0, 0] = q[0] * dt / (x[0] < 1.0)


def root_step(x, u, p, dt, out):
    out[0] = 0.0 * np.sqrt(1.0 - x[0]) + x[0] + u[0] * dt


def root(x, u, p, out):
    out[0] = x[0] + 0.0 * np.sqrt(1.0 - x[0])


def walk(**changes):
    parts = dict(
        name="walk", title="", states=(State("s", "m", 0.0, 0.1),), noises=(Noise("s", "m²/s", 4.0),), f=drift,
        inputs=(Input("speed", "m/s", 0.0),), sensors=(Sensor("gauge", (Row("s", "m", 0.01),), h=first_state),),
    )  # fmt: skip
    return StateSpaceModel(**(parts | changes))


def driven(model, name="ekf"):
    """At 0 m until 2 s, then 1 m/s: past 1 m at 3 s, past 2 m at 4 s; the readings say so."""
    rows = [(0.5 * k, READING, max(0.0, 0.5 * (k - 4))) for k in range(9)]
    return folded(name, model, log_of(model.width, *rows, (2, INPUT, 1.0)))


@pytest.mark.parametrize("name", ["ekf", "ukf", "pf", "filterpy-ukf"])
@pytest.mark.parametrize(
    ("changes", "culprit", "says"),
    [
        (
            {"Q": shrinking},
            shrinking,
            r"Q\(x, u, dt\) is not positive semidefinite \(it has the eigenvalue (-[\d.e+]+)\)",
        ),
        ({"Q": nowhere}, nowhere, r"Q\(x, u, dt\) is not finite"),
        ({"f": root_step}, root_step, r"f\(x, u, dt\) is \[nan\]"),
        (
            {"sensors": (Sensor("gauge", (Row("s", "m", 0.01),), h=root),)},
            root,
            r"h\(x, u\) of sensor gauge is \[nan\]",
        ),
    ],
    ids=["indefinite Q", "infinite Q", "f", "h"],
)
def test_the_function_that_failed_is_named_with_file_line_and_state(name, changes, culprit, says):
    model = walk(**changes)
    growing = driven(model, name)
    rows = failures(growing.track)
    if not rows.size:
        assert name == "pf", "only members may have gone around it"
        return
    line = cause_of(growing, int(rows[0]))
    found = re.fullmatch(
        rf"\S*test_failure_cause.py:{culprit.__code__.co_firstlineno}: model walk: {says} at x = \[([-\d.e]+)\], "
        r"u = \[[01]\](, dt = 0.5 s)?, where the estimate got; it must be .*",
        line,
    )
    assert found, line
    # Beyond 1 m, where the functions end, and no farther than the estimate's own spread from where it was.
    assert 1.0 <= float(found[found.lastindex - ("dt" in line)]) < 3.0
    if culprit is shrinking:
        x = float(re.search(r"x = \[([-\d.e]+)\]", line)[1])
        assert float(found[1]) == pytest.approx(4.0 * 0.5 * (1.0 - x), rel=5e-3)


def test_a_reading_that_fails_by_itself_blames_no_function():
    growing = driven(walk())
    assert failures(growing.track).size == 0
    assert cause_of(growing, 8) is None


def test_failures_are_failed_readings_and_estimates_that_are_no_numbers():
    growing = driven(walk(Q=shrinking))
    track = growing.track
    expected = [
        k for k in range(len(track))
        if track.verdict[k] == FAILED or not (np.isfinite(track.mean[k, 0]) and np.isfinite(track.std[k, 0]))
    ]  # fmt: skip
    assert expected and list(failures(track)) == expected
    assert list(failures(track, expected[0] + 1)) == expected[1:]
    track.std[2, 0] = np.inf
    assert failures(track)[0] == 2
    track.std[2, 0], track.mean[1, 0] = 1.0, np.nan
    assert failures(track)[0] == 1


def test_the_inputs_that_held_are_taken():
    """u is 1 from 2 s on; without it the path stays at 0 m, where nothing fails."""
    model = walk(f=root_step, states=(State("s", "m", 0.0, 1e-6),), noises=(Noise("s", "m²/s", 0.0),))
    rows = (0, READING, 0.0), (1, INPUT, 1.0), (2, TICK, np.nan), (4, READING, 3.0), (5, READING, 4.0)
    growing = folded("ekf", model, log_of(1, *rows))
    rows = failures(growing.track)
    assert rows[0] == 4
    assert "x = [3], u = [1], dt = 1 s" in cause_of(growing, 4)


@pytest.mark.parametrize(("changes", "culprit"), [({"f": root_step}, root_step), ({"Q": shrinking}, shrinking)])
def test_the_models_own_function_is_named_where_a_parameter_is_estimated(changes, culprit):
    gain = Parameter("gain", "1", 1.0)
    growing = driven(joint(walk(parameters=(gain,), **changes), {"gain": JointParameter(0.1, 0.0)}))
    line = cause_of(growing, int(failures(growing.track)[0]))
    assert f"test_failure_cause.py:{culprit.__code__.co_firstlineno}: model walk: " in line


def test_the_path_is_walked_in_the_models_own_steps():
    """Four steps of 1 s from 0 m at 1 m/s: f is asked at 0, 1 and 2 m, and has no answer there."""
    model = walk(f=root_step, states=(State("s", "m", 0.0, 1e-6),), noises=(Noise("s", "m²/s", 0.0),), max_step=1.0)
    growing = folded("ekf", model, log_of(1, (0, READING, 0.0), (0, INPUT, 1.0), (4, READING, 4.0)))
    assert list(failures(growing.track)) == [2]
    assert "f(x, u, dt) is [nan] at x = [2], u = [1], dt = 1 s" in cause_of(growing, 2)


def test_a_block_that_returns_no_number_is_named_too():
    """The black box gives NaN where x > 0.5, and is asked at the estimate alone."""

    def both(X, u, p):
        return np.where(X[:, :1] > -5.0, both_block(X, u, p), np.nan)

    def f(X, u, p, dt):
        return np.where(u[0] < 1.0, f_block(X, u, p, dt), np.nan)

    model = replace(BOX, f=f, sensors=(replace(BOX.sensors[0], h=both), BOX.sensors[1]))
    rows = (0.0, READING, [0.2, 0.1]), (0.1, INPUT, [2.0]), (0.2, READING, [0.2, 0.1])
    growing = folded("enkf", model, log_of(model.width, *rows))
    assert list(failures(growing.track)) == [2]
    assert re.search(r"test_failure_cause.py:\d+: model duffing: f\(x, u, dt\) is \[nan, nan\]", cause_of(growing, 2))


@pytest.mark.parametrize("estimator", ["ekf", "iekf", "ukf", "ckf", "sr-ekf", "sr-ukf", "enkf", "etkf", "ensrf"])
@pytest.mark.parametrize("gate", [None, 0.999])
def test_a_reading_that_the_model_cannot_expect_has_failed_and_is_not_gated(estimator, gate):
    """Of a NIS that is no number the model is the reason, not the reading."""
    model = walk(sensors=(Sensor("gauge", (Row("s", "m", 0.01),), h=root),))
    tuning = Tuning.of(model) if gate is None else Tuning.of(model).set("gate", gate)
    log = log_of(model.width, (1, READING, 0.0), (2, INPUT, 50.0), (3, READING, 0.0))
    growing = folded(estimator, model, log, tuning)
    assert growing.track.verdict[2] == FAILED
