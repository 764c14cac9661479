"""Steps that cross a time: the fewest that `max_step` allows, whatever the floating point makes of the quotient."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from estimators import registry
from estimators.compiled.context import SLACK, steps_of
from estimators.fold import fold
from estimators.log import TICK, Events
from estimators.tuning import Tuning
from tests.estimators.linear_models import random_linear
from tests.estimators.test_fold import in_python
from tests.support import SECOND, as_log


@pytest.mark.parametrize("exponent", range(-9, 10))
def test_whole_multiples_at_all_magnitudes(exponent):
    """k steps of d·10^e seconds take k steps: by ceil of the quotient, one in ten took one more."""
    for digit in (1, 2, 3, 5, 6, 7, 9):
        step = float(Fraction(digit) * Fraction(10) ** exponent)
        for k in (1, 2, 3, 6, 7, 11, 13, 100, 999, 10_000):
            assert steps_of(float(Fraction(k) * Fraction(digit) * Fraction(10) ** exponent), step) == k
            assert steps_of(k * step, step) == k
    assert steps_of(0.3, 0.1) == 3


def test_timestamps_in_whole_nanoseconds():
    for hertz in (3, 7, 30, 60, 1000 / 3, 30_000):
        for k in (1, 2, 3, 50):
            for begun in (0.0, 1.7e9):
                first = round(begun * 1e9)
                last = first + round(k * 1e9 / hertz)
                assert steps_of((last - first) * 1e-9, 1.0 / hertz) == k


@pytest.mark.parametrize("seed", range(3))
def test_no_step_is_longer_than_allowed_and_none_is_wasted(seed):
    rng = np.random.default_rng(seed)
    for _ in range(2000):
        step = float(10 ** rng.uniform(-6, 6))
        dt = step * float(10 ** rng.uniform(-3, 4))
        n = steps_of(dt, step)
        assert dt / n <= step * (1 + SLACK) and (n == 1 or dt > step * (n - 1))
    assert steps_of(5.0, np.inf) == 1 and steps_of(0.0, 1.0) == 1


@pytest.mark.parametrize("name", ["ekf", "ekf-python"])
def test_the_fold_crosses_a_gap_in_as_many_steps(name, monkeypatch):
    """x' = x + A x dt is Euler's rule, so the number of steps shows in the mean: (1 + A dt/3)³."""
    monkeypatch.setitem(registry.ESTIMATORS, "ekf-python", in_python("ekf"))
    matrices = random_linear(np.random.default_rng(1), 3, 2)
    model = replace(matrices.model, max_step=0.1)
    ticks = [Events.one(t, 0, TICK, 0, (), model.width) for t in (0, 3 * SECOND // 10)]
    track = fold(name, model, Tuning.of(model), as_log(Events.concat(ticks, model.width)))
    x = matrices.mean
    for _ in range(3):
        x = x + 0.1 * (matrices.A @ x + matrices.B @ matrices.u)
    np.testing.assert_allclose(track.mean[1], x, rtol=1e-13)
