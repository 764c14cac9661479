"""The fold's loop in Python is the kernel's: driven with the compiled functions it gives the same bits."""

from dataclasses import replace

import numpy as np
import pytest

from estimators import registry
from estimators.fold import Fold, fold
from estimators.interpreted.fold_loop import MAX_PREDICT_STEPS
from estimators.log import TICK, Events, Log
from estimators.tuning import Tuning
from tests.estimators.linear_models import random_linear
from tests.estimators.test_fold import MODEL, everything, in_python
from tests.support import SECOND, as_log, assert_same


@pytest.mark.parametrize("name", ["ekf", "pf"])
def test_the_python_loop_gives_the_bits_of_the_kernel(name, monkeypatch):
    monkeypatch.setitem(registry.ESTIMATORS, f"{name}-python", in_python(name))
    events = everything(np.random.default_rng(3), 400)
    tuning = Tuning.of(MODEL).set("gate", 0.97).set("use.second", False)
    pairs = np.array([[0, 1], [2, 1]])
    compiled, python = (fold(n, MODEL, tuning, as_log(events), pairs=pairs) for n in (name, f"{name}-python"))
    assert_same(python, compiled)
    assert len(np.unique(compiled.verdict)) == 5  # none, used, gated, held out, missing: all were compared


@pytest.mark.parametrize("name", ["ekf", "enkf"])
def test_long_gaps_are_split_and_end_at_the_prior_as_in_the_kernel(name, monkeypatch):
    monkeypatch.setitem(registry.ESTIMATORS, f"{name}-python", in_python(name))
    model = replace(MODEL, max_step=0.125)
    times = np.cumsum([1, 0.3, 0.1251, 7.77, 0.125 * MAX_PREDICT_STEPS + 1, 0.5]) * SECOND
    readings = [Events.one(int(t), int(t), 0, 1, [0.3, -0.2], 3) for t in times]
    tick = Events.one(int(times[3]) + 1, 0, TICK, 0, (), 3)
    log = as_log(Events.concat([*readings, tick], 3))
    compiled, python = (fold(n, model, Tuning.of(model), log) for n in (name, f"{name}-python"))
    assert_same(python, compiled)
    # Behind the gap the reading meets the prior again.
    np.testing.assert_array_equal(compiled.innovation_std[5], compiled.innovation_std[0])


def test_a_view_has_the_numbers_of_the_context():
    """F, H, Q and blocks of f and h of a linear model are its matrices."""
    rng = np.random.default_rng(8)
    matrices = random_linear(rng, 3, 2)
    model = matrices.model
    view = Fold("filterpy-kf", model, Tuning.of(model), Log(model.width)).machine.context
    X, u, dt = rng.normal(0, 1, (5, 3)), rng.normal(0, 1, 2), 0.3
    F = np.eye(3) + dt * matrices.A
    np.testing.assert_allclose(view.F(X[0], u, dt), F, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(view.f(X, u, dt), X @ F.T + dt * matrices.B @ u, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(view.Q(X[0], u, dt), matrices.q * dt * matrices.W, rtol=1e-13)
    for k in range(3):
        np.testing.assert_allclose(view.H(k, X[0], u), matrices.H[k], rtol=1e-13)
        expected = X @ matrices.H[k].T + matrices.D[k] @ u
        np.testing.assert_allclose(view.h(k, X, u), expected, rtol=1e-13, atol=1e-13)
        np.testing.assert_array_equal(np.diag(view.R[k]), matrices.R[k])
