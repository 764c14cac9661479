"""A sensor of more rows than a byte counts: its degrees of freedom, and what is computed from them."""

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.fold import fold
from estimators.gate.isolation import degrees
from estimators.log import READING, Events, Log
from estimators.model import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning

ROWS = 200
READINGS = 30


def _stay(x, u, p, dt, out):
    out[0] = x[0]


def _read(x, u, p, out):
    for k in range(ROWS):
        out[k] = x[0]


MODEL = StateSpaceModel(
    name="many",
    title="one level, 200 gauges",
    states=(State("x", "m", mean=0.0, std=1.0),),
    noises=(Noise("x", "m²/s", variance=1e-4),),
    sensors=(Sensor("gauges", tuple(Row(f"g{k}", "m", variance=0.25) for k in range(ROWS)), h=_read),),
    f=_stay,
    linear=True,
)


@pytest.mark.parametrize("missing", [0, 60, 150])
def test_a_sensor_of_200_rows_has_200_degrees_of_freedom(missing):
    """NIS over the readings is χ² with as many degrees as there were rows: its bounds, and the figure itself."""
    y = np.random.default_rng(2).normal(0.0, 0.5, (READINGS, ROWS))
    y[:, :missing] = np.nan
    log = Log.of(MODEL)
    t = np.arange(READINGS) * 10**9
    log.extend(Events(t, t, np.full(READINGS, READING, np.int8), np.zeros(READINGS, np.int32), y))
    track = fold("kf", MODEL, Tuning.of(MODEL), log)
    m = ROWS - missing
    assert track.dof.tolist() == [m] * READINGS == degrees(track).tolist()
    low, high = chi2.ppf([0.025, 0.975], m * READINGS) / READINGS
    np.testing.assert_allclose([track.nis_low[-1], track.nis_high[-1]], [low, high], rtol=1e-9)
    # Four deviations of the mean of χ²: the prior is wider than the truth by a level that all rows share.
    assert abs(track.nis_mean[-1] - m) < 4.0 * np.sqrt(2.0 * m / READINGS) + 1.0
