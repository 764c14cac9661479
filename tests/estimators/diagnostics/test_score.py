"""The sums of a track written by hand, of which every number follows from the definitions."""

import numpy as np
import pytest
from scipy.stats import chi2, f, multivariate_normal, multivariate_t

from estimators.diagnostics.field_pictures import Picture
from estimators.diagnostics.health import HealthPolicy
from estimators.diagnostics.score import health_of, score
from estimators.log import READING, Events
from estimators.track import ADVISORY, GATED, HELD_OUT, MISSING, USED, Track
from tests.models import FLOAT_AND_SONAR as MODEL

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
    track.health[:] = ADVISORY
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
