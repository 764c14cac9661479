"""The price of a refusal is a density's: it integrates to one, and no filter wins by refusing."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, norm

from estimators.diagnostics.score import log_density, score
from estimators.fold import fold
from estimators.log import READING, Events
from estimators.models import MODELS
from estimators.track import GATED, Track
from estimators.tuning import Tuning
from tests.support import SECOND, as_log

MOTOR = MODELS["motor_winding"]


def refused(nis, std, dof) -> Track:
    """Rows of a track whose readings were refused, of one row each."""
    std = np.atleast_2d(np.asarray(std, float))
    track = Track.allocate(std.shape[0], 1, 0, std.shape[1])
    track.verdict[:] = GATED
    track.nis[:], track.dof[:], track.innovation_std[:] = nis, dof, std
    return track


@pytest.mark.parametrize("gate", [0.5, 0.99, 0.99999])
def test_inside_and_outside_the_gate_make_one(gate):
    """One row: the normal density inside and the price outside integrate to P and 1 - P."""
    std, edge = 3.0, 3.0 * np.sqrt(chi2.ppf(gate, 1))
    inside, _ = quad(lambda e: norm.pdf(e, scale=std), -edge, edge)
    outside, _ = quad(lambda e: np.exp(log_density(refused((e / std) ** 2, [std], 1), gate)[0]), edge, np.inf)
    assert inside == pytest.approx(gate, rel=1e-9)
    assert 2 * outside == pytest.approx(1 - gate, rel=1e-6)


def test_what_has_no_density_costs_everything_and_without_a_gate_it_is_unknown():
    assert log_density(refused([np.inf, 30.0], [[1.0], [0.0]], 1), 0.99).tolist() == [-np.inf, -np.inf]
    assert np.isnan(log_density(refused(9.0, [1.0], 1), None)).all()
    assert log_density(refused(9.0, [1.0], 1).select(slice(0, 0)), None).size == 0


def heated(seed: int, steps: int = 400):
    """Readings of a winding that the model describes, drawn from it, once a second."""
    rng = np.random.default_rng(seed)
    x, ys = np.array([35.0, 0.0]), []
    for _ in range(steps):
        x = np.array([[1.0, 1.0], [0.0, 1.0]]) @ x + rng.normal(0, np.sqrt([0.01, 0.001]))
        ys.append(x[0] + rng.normal(0, 2.0))
    t = SECOND * np.arange(1, steps + 1)
    codes = np.full(steps, READING, np.int8), np.zeros(steps, np.int32)
    return as_log(Events(t, t, *codes, np.array(ys)[:, None]))


def scored(log, **changes):
    tuning = Tuning.of(MOTOR).set("gate", 0.999).set("R.winding", 4.0).set("Q.temperature", 0.01).set("Q.rate", 0.001)
    for key, value in changes.items():
        tuning = tuning.set(key.replace("_", "."), value)
    return score(fold("kf", MOTOR, tuning, log), log.events, MOTOR, gate=tuning.gate)


@pytest.mark.parametrize("seed", range(5))
def test_no_filter_wins_by_refusing(seed):
    """One that trusts nothing but its prediction refuses most readings, and on the rest it was right by chance."""
    log = heated(seed)
    good, bad = scored(log), scored(log, Q_temperature=1e-9, Q_rate=1e-9, R_winding=0.01)
    assert good.refused < 0.01 < 0.8 < bad.refused
    # What used to be compared: the more is refused, the better.
    assert bad.log_likelihood_used > good.log_likelihood_used
    # A refusal costs log(1 / (1 - P)) = 6.9 more than a consistent density would, on average.
    assert bad.log_likelihood < good.log_likelihood - np.log(1e3) * bad.gated


def test_a_filter_that_refuses_nothing_is_scored_as_before():
    log = heated(0)
    result = scored(log, gate=None)
    assert result.gated == 0 and result.log_likelihood == result.log_likelihood_used
