"""Normal scores and rank histograms of ensembles: against SciPy, and by drawing truth and members alike."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest, norm, t

from estimators.ensemble.analysis import score_of
from estimators.fold import Fold
from estimators.log import READING
from estimators.tuning import Tuning
from tests.estimators.ensemble.test_ensemble_filters import MATRICES, NAMES, members_of
from tests.estimators.linear_models import ROWS
from tests.support import folded, log_of


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("used", [True, False])
def test_scores_are_students(name, used):
    """With 30 members Wallace's closed form is within 0.002 of the exact distribution, for the |e| < 4 met here."""
    model = MATRICES.model
    y = MATRICES.H[2] @ MATRICES.mean + MATRICES.D[2] @ MATRICES.u + np.array([1.0, -2.0, 0.5])
    y[1] = np.nan
    tuning = Tuning.of(model).with_options({"members": 30}).set("use.third", used)
    fold = Fold(name, model, tuning, log_of(model.width, (0, READING, y, 2)))
    X = members_of(fold)
    fold.advance()
    expected = X @ MATRICES.H[2].T + MATRICES.D[2] @ MATRICES.u
    own = expected.var(0, ddof=1) * (1 + 1 / 30)
    S = own + MATRICES.R[2]
    dof = 29 * (S / own) ** 2
    e = (y - expected.mean(0)) / np.sqrt(S)
    exact = np.sign(e) * norm.isf(t.sf(np.abs(e), dof))
    found = fold.track.whitened[0]
    assert np.isnan(found[1])
    np.testing.assert_allclose(found[[0, 2]], exact[[0, 2]], rtol=0, atol=0.002)


@pytest.mark.parametrize("N", [10, 20, 100])
@pytest.mark.parametrize("r", [1e-4, 0.1, 1.0, 10.0])
def test_scores_are_normal_where_truth_and_members_are_drawn_alike(N, r):
    """40,000 draws: their variance is right to √(2/40000) = 0.7 %, so 2 % and four of these are allowed.

    Beyond 3 lie 108 ± 10 of them if they are normal; a quarter more is granted to the two moments by which the degrees
    of freedom are chosen, and four standard deviations.
    """
    rng = np.random.default_rng(N)
    n = 40_000
    members = rng.normal(size=(n, N))
    y = rng.normal(size=n) + np.sqrt(r) * rng.normal(size=n)
    residual, square = y - members.mean(1), members.var(1, ddof=1) / r
    e = np.array([score_of(residual[k], r, square[k], N) for k in range(n)])
    assert abs(np.var(e) - 1) < 0.02 + 4 * 0.007
    beyond = np.mean(np.abs(e) > 3) / 0.0027
    assert 1 - 0.4 < beyond < 1.25 + 0.4
    if N == 10 and r < 0.5:
        # What would be had without: 1.3 times the variance, five times as many beyond 3.
        plain = residual / np.sqrt(r * (1 + square))
        assert np.var(plain) > 1.25 and np.mean(np.abs(plain) > 3) > 4 * 0.0027


@pytest.mark.parametrize("name", NAMES)
def test_rank_histogram_is_flat_where_truth_and_members_are_drawn_alike(name):
    """The first reading of many seeds: ten bins within the 1e-4 bound of χ² with 9 degrees of freedom.

    The members' mean is made exact when they are drawn, so members do not quite lie as the truth does; with 100 of
    them that is worth a part in 100 of the variance, far below the chance of 300 ranks.
    """
    model = MATRICES.model
    counts = np.zeros(10)
    rng = np.random.default_rng(1)
    scores = []
    for seed in range(150):
        x = MATRICES.mean + MATRICES.std * rng.normal(size=model.nx)
        y = MATRICES.H[1] @ x + MATRICES.D[1] @ MATRICES.u + np.sqrt(MATRICES.R[1]) * rng.normal(size=ROWS[1])
        tuning = Tuning.of(model).with_options({"members": 100})
        fold = folded(name, model, log_of(model.width, (0, READING, y, 1)), replace(tuning, seed=seed))
        account = fold.account()
        assert account["members"] == 100 and sum(account["ranks"]) == ROWS[1]
        counts += account["ranks"]
        scores.extend(fold.track.whitened[0, : ROWS[1]])
    assert np.sum((counts - 30) ** 2 / 30) < chi2.ppf(1 - 1e-4, 9)
    assert kstest(scores, "norm").pvalue > 1e-4


def test_rank_histogram_shows_where_the_readings_lie():
    """Far above all members, and far below: the last bin and the first."""
    model = MATRICES.model
    for off, place in ((100.0, 9), (-100.0, 0)):
        y = MATRICES.H[0] @ MATRICES.mean + MATRICES.D[0] @ MATRICES.u + off
        fold = folded("etkf", model, log_of(model.width, (0, READING, y, 0)))
        assert fold.account()["ranks"][place] == 1 and sum(fold.account()["ranks"]) == 1
        e = fold.track.innovation[0, 0] / fold.track.innovation_std[0, 0]
        assert fold.account()["spread"] == pytest.approx(1 / e**2)
