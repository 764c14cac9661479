"""The sums of a track written by hand, of which every number follows from the definitions.

The price of a refusal is a density's: it integrates to one, and no filter wins by refusing.
"""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import chi2, f, multivariate_normal, multivariate_t, norm

from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.health import HealthPolicy
from estimators.diagnostics.score import health_of, log_density, score
from estimators.fold import fold
from estimators.log import READING, Events
from estimators.models import MODELS
from estimators.track import ADVISORY, GATED, HELD_OUT, MISSING, USED, Track
from estimators.tuning import Tuning
from tests.models import FLOAT_AND_SONAR as MODEL
from tests.support import SECOND, as_log

NAN = np.nan
GATE = 0.99
TOGETHER = np.array([[1.0, 7 / 11], [7 / 11, 1.0]])
# Sensor, verdict, innovations and their deviations, NIS, log-likelihood.
ROWS = (
    (0, USED, (1.0, NAN), (1.0, NAN), 1.0, -1.5),
    (1, USED, (2.0, 1.0), (1.0, 1.0), 4.0, -2.5),
    (1, GATED, (9.0, 9.0), (1.0, 1.0), 99.0, multivariate_normal(cov=TOGETHER).logpdf([9.0, 9.0])),
    (0, MISSING, (NAN, NAN), (NAN, NAN), NAN, NAN),
    (0, MISSING, (NAN, NAN), (NAN, NAN), NAN, NAN),
    (1, HELD_OUT, (3.0, 0.5), (2.0, 0.1), 5.0, -7.0),
    (1, HELD_OUT, (-4.0, NAN), (2.0, NAN), 6.0, -8.0),
    (1, USED, (0.5, 1.0), (1.0, 1.0), 1.0, -2.0),
)


@pytest.fixture(scope="module")
def result():
    n = len(ROWS)
    track = Track.allocate(n, 1, 0, 2)
    for i, (sensor, verdict, nu, std, nis, log_likelihood) in enumerate(ROWS):
        track.verdict[i], track.dof[i] = verdict, sensor + 1
        track.innovation[i], track.innovation_std[i] = nu, std
        track.nis[i], track.log_likelihood[i] = nis, log_likelihood
    t = np.arange(n, dtype=np.int64) * 10**9
    sensors = np.array([row[0] for row in ROWS], np.int32)
    return score(track, Events(t, t, np.full(n, READING, np.int8), sensors, np.zeros((n, 2))), MODEL, gate=GATE)


def test_the_used_readings_are_summed_and_the_others_counted(result):
    assert (result.readings, result.nis_readings, result.gated, result.missing) == (8, 3, 1, 2)
    assert result.nis == 2.0 and result.log_likelihood_used == -6.0 and result.refused == 0.25
    # The refused one: 9 and 9 at deviations of 1, of NIS 162 / (1 + 7 / 11) = 99, in a Cauchy density's tail.
    outside = f.sf(chi2.ppf(GATE, 2) / 2, 2, 1)
    density = multivariate_t(df=1, shape=TOGETHER).pdf([9.0, 9.0]) * (1 - GATE) / outside
    assert result.log_likelihood == pytest.approx(-6.0 + np.log(density), rel=1e-10)
    # Three readings with 1 + 2 + 2 degrees of freedom.
    assert result.nis_low == pytest.approx(chi2.ppf(0.025, 5) / 3, rel=1e-10)
    assert result.nis_high == pytest.approx(chi2.ppf(0.975, 5) / 3, rel=1e-10)


def test_sensors_held_out_are_judged_row_by_row(result):
    """Row near: 3 and -4 at 2 each, where the band ends at 3.92; row far: 0.5 at 0.1, and one that is missing."""
    assert list(result.held_out) == ["sonar.near", "sonar.far"]
    assert (
        result.held_out["sonar.near"].rmse == pytest.approx(np.sqrt(12.5))
        and result.held_out["sonar.near"].coverage == 0.5
    )
    assert result.held_out["sonar.far"] == (0.5, 0.0, -0.5)
    # The prediction is 3 too low once and 4 too high once.
    assert result.held_out["sonar.near"].bias == 0.5


def test_a_row_that_holds_for_long_becomes_degraded_and_then_stale():
    """One of 100 s, degraded after 5 s and stale after 30 s; the other is the last and holds no time."""
    t = np.array([0, 100 * 10**9])
    events = Events(t, t, np.full(2, READING, np.int8), np.zeros(2, np.int32), np.zeros((2, 2)))
    track = Track.allocate(2, 1, 0, 2)
    track.health[:], track.age[:] = ADVISORY, 0.0
    shares = health_of(events, track, HealthPolicy(degraded_after=5.0, stale_after=30.0))
    assert (shares["advisory"], shares["degraded"], shares["stale"]) == (0.05, 0.25, 0.7)


def test_pictures_of_a_field_weigh_as_many_cells_as_they_knew():
    def picture(cells, rmse, inside):
        return Picture(0, 0, cells, rmse, inside, 1.0, None, None, None)

    empty = Events.one(0, 0, READING, 0, 0.0, 2)
    pictures = [picture(300, 1.0, 0.9), picture(0, NAN, NAN), picture(100, 3.0, 0.5)]
    fit = score(Track.allocate(1, 1, 0, 2), empty, MODEL, pictures).field
    # Squares over all 400 cells: (300 · 1 + 100 · 9) / 400 = 3; inside: 270 + 50 of 400.
    assert fit.rmse == pytest.approx(np.sqrt(3.0)) and fit.coverage == pytest.approx(0.8)
    assert score(Track.allocate(1, 1, 0, 2), empty, MODEL, pictures[1:2]).field is None


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
