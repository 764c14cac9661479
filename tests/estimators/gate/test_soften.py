"""The soft gate against the closed form, and against a dense solution with the inflated noise."""

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.track import USED
from estimators.tuning import Tuning
from tests.models import unchanged
from tests.support import assert_same, folded, log_of

from .two_sensors import MODEL, TUNING

P, R, Y = 1.0, 0.01, 40.0
SOFT = TUNING.set("gate.kind", "soft")


def one_reading(name, tuning, y=Y):
    return folded(name, MODEL, log_of(MODEL.width, (0, READING, y)), tuning)


@pytest.mark.parametrize("name", ["kf", "sr-kf", "filterpy-kf"])
def test_one_row_by_the_closed_form(name):
    """With w R in place of R, S = y²/g, so x = P y / S = P g / y and P⁺ = P - P² g / y²."""
    growing = one_reading(name, SOFT)
    g, track = growing.gate_limits[1], growing.track
    assert track.verdict[0] == USED
    assert track.mean[0, 0] == pytest.approx(P * g / Y, rel=1e-6)
    assert track.std[0, 0] == pytest.approx(np.sqrt(P - P**2 * g / Y**2), rel=1e-6)
    # What is shown of the reading is what it was; its likelihood is that of the inflated noise.
    assert track.nis[0] == pytest.approx(Y**2 / (P + R), rel=1e-9)
    assert track.innovation_std[0, 0] == pytest.approx(np.sqrt(P + R), rel=1e-9)
    assert track.whitened[0, 0] == pytest.approx(Y / np.sqrt(P + R), rel=1e-9)
    assert track.log_likelihood[0] == pytest.approx(-0.5 * (g + np.log(Y**2 / g) + np.log(2 * np.pi)), rel=1e-6)


@pytest.mark.parametrize("name", ["pf", "enkf"])
def test_members_move_as_the_closed_form_says(name):
    """Within four Monte Carlo deviations of a mean of N draws of the belief."""
    growing = one_reading(name, SOFT)
    members = growing.options.get("particles") or growing.options["members"]
    assert growing.track.verdict[0] == USED
    expected = P * growing.gate_limits[1] / Y
    assert abs(growing.track.mean[0, 0] - expected) < 4 * np.sqrt(P / members) * (1 + expected)


def test_a_reading_inside_the_gate_is_used_as_it_is():
    hard, soft = (one_reading("kf", tuning, 3.0) for tuning in (TUNING, SOFT))
    assert hard.track.verdict[0] == USED
    assert_same(hard.track, soft.track)


def _both(x, u, p, out):
    out[0] = x[0]
    out[1] = x[0] + x[1]


CORRELATION = ((1.0, 0.6), (0.6, 1.0))
PLANE = StateSpaceModel(
    name="plane",
    title="Two states, rows whose noise is correlated",
    states=(State("p", "m", std=1.0), State("q", "m", std=3.0)),
    noises=(Noise("p", "m²/s", variance=1e-4), Noise("q", "m²/s", variance=1e-4)),
    sensors=(
        Sensor("s", (Row("s1", "m", variance=0.04), Row("s2", "m", variance=0.5)), h=_both, correlation=CORRELATION),
    ),
    f=unchanged,
    max_step=1.0,
    linear=True,
    source="none",
)


@pytest.mark.parametrize("name", ["kf", "sr-kf", "filterpy-kf"])
@pytest.mark.parametrize("y", [[30.0, -10.0], [12.0, np.nan], [-9.0, 40.0]])
@pytest.mark.parametrize("brought", [False, True])
def test_several_rows_against_a_dense_solution(name, y, brought):
    """x⁺ = C S⁻¹ ν with w R; the softened NIS does not pass the gate, and with one row lies on it."""
    log = Log.of(PLANE)
    own = [0.09, 0.2] if brought else None
    log.add("s", [0.0], [y], **({"variance": [own]} if brought else {}))
    growing = folded(name, PLANE, log, Tuning.of(PLANE).set("gate", 0.999).set("gate.kind", "soft"))
    there = np.isfinite(y)
    H = np.array([[1.0, 0.0], [1.0, 1.0]])[there]
    std = np.sqrt(own or [0.04, 0.5])
    noise = (np.array(CORRELATION) * np.outer(std, std))[np.ix_(there, there)]
    prior, nu = np.diag([1.0, 9.0]), np.array(y)[there]

    def nis(w):
        return float(nu @ np.linalg.solve(H @ prior @ H.T + w * noise, nu))

    g = growing.gate_limits[nu.size]
    assert nis(1.0) > g
    w = 1.0 + (1.0 / g - 1.0 / nis(1.0)) * float(nu @ np.linalg.solve(noise, nu))
    assert nis(w) <= g * (1 + 1e-12) and (nu.size > 1 or nis(w) == pytest.approx(g, rel=1e-9))
    expected = prior @ H.T @ np.linalg.solve(H @ prior @ H.T + w * noise, nu)
    assert growing.track.verdict[0] == USED
    assert growing.track.mean[0] == pytest.approx(expected, rel=1e-6)
    assert growing.track.nis[0] == pytest.approx(nis(1.0), rel=1e-9)


def test_a_softened_reading_does_not_adapt_q():
    assert one_reading("kf", SOFT.with_options({"adapt": 2.0}))._now.state[-1] == 1.0


def test_a_soft_gate_needs_a_filter_whose_r_can_change():
    with pytest.raises(EstimatorError, match="a soft gate inflates R, but its gain is for one R; use kf"):
        log = Log.of(PLANE)
        Fold("kf-steady", PLANE, Tuning.of(PLANE).set("gate", 0.99).set("gate.kind", "soft"), log)
    with pytest.raises(EstimatorError, match="set adapt to off or Q, or gate.kind to hard"):
        Fold("kf", MODEL, SOFT.with_options({"adapt": 1.0}), Log.of(MODEL))
