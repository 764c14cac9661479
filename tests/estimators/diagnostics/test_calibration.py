"""Tracks whose innovations are drawn with known faults: what is said, and that nothing is said of the others."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

from estimators.diagnostics.calibration import (
    CalibrationLimits,
    adaptive_widths,
    calibrations,
    coverage_bins,
    held_inputs,
    truth_calibration,
)
from estimators.events.batch import INPUT, READING, TRUTH, Events
from estimators.model.state_space import Input, State
from estimators.track import GATED, HELD_OUT, MISSING, USED, Track
from tests.models import FLOAT_AND_SONAR
from tests.support import SECOND

MODEL = replace(FLOAT_AND_SONAR, states=(*FLOAT_AND_SONAR.states, State("heading", "rad", 0.0, 1.0, circular=True)))


def read(e: np.ndarray, gate: float | None = None, std: float = 3.0) -> tuple[Events, Track]:
    """Readings of the float with these standardised innovations, refused beyond the gate."""
    n = e.size
    track = Track.allocate(n, 2, 0, 2)
    track.innovation[:, 0], track.innovation_std[:, 0] = std * e, std
    track.nis[:], track.dof[:] = e**2, 1
    track.verdict[:] = USED if gate is None else np.where(e**2 > chi2.ppf(gate, 1), GATED, USED)
    t = SECOND * np.arange(n)
    return Events(t, t, np.full(n, READING, np.int8), np.zeros(n, np.int32), np.zeros((n, 2))), track


def of(e: np.ndarray, gate: float | None = None, **more):
    (found,) = calibrations(MODEL, *read(e, gate), gate=gate, **more)
    return found


def normal(seed: int, n: int = 2000, rho: float = 0.0) -> np.ndarray:
    white = np.sqrt(1 - rho**2) * np.random.default_rng(seed).standard_normal(n + 200)
    return lfilter([1.0], [1.0, -rho], white)[200:]


def test_each_fault_is_said_and_no_other():
    e = normal(1)
    assert of(e).words == ()
    (said,) = of(1.36 * e).words
    assert said.startswith("float: bands a third too narrow (scale 1.3")
    (said,) = of(e / 1.5).words
    assert said.startswith("float: bands a half too wide (scale 0.6")
    (said,) = of(0.2 * e).words
    assert said.startswith("float: bands too wide by a factor of 4.9 (scale 0.20, ")
    said = of(e + 0.5).words
    assert said[-1].startswith("float: reads above the prediction (bias +0.5") and len(said) == 1
    (said,) = of(normal(1, rho=0.5)).words
    assert said.startswith("float: innovations are correlated (+0.5") and "Q too small" in said
    (said,) = of(normal(1, rho=-0.5)).words
    assert said.startswith("float: innovations are correlated (-0.49, ") and "Q too large" in said
    spiky = np.where(np.arange(e.size) % 10 == 3, 1e5, e)
    said = of(spiky, 0.9999).words
    assert any(line.startswith("float: the gate rejects 10 % (") for line in said)


def test_only_what_surely_matters_is_said():
    """A band a tenth too narrow, however many readings tell; a larger size of which the interval is too wide."""
    assert of(1.1 * normal(2, 50_000)).words == ()
    assert of(1.1 * normal(2, 50_000), limits=CalibrationLimits(width=0.05)).words != ()
    short = of(1.4 * normal(3, 24))
    assert short.words == () and short.scale.low < 1.25


@pytest.mark.parametrize("gate", [0.8, 0.99, None])
def test_a_gate_does_not_make_a_consistent_filter_look_wide(gate):
    """Means over 400,000: of e², clipped or not, the deviation is √2 / √400000 = 0.0022 at most."""
    found = of(normal(4, 400_000), gate)
    assert abs(found.ratio.value - 1.0) < 4 * 0.0023
    assert found.scale.value == pytest.approx(np.sqrt(found.ratio.value))
    share = 0.0 if gate is None else 1.0 - gate
    assert abs(found.refused.value - share) < 4 * np.sqrt(0.25 / 400_000)


def test_a_spike_that_was_refused_does_not_speak_for_all():
    e = normal(5, 1000)
    spiked = e.copy()
    spiked[500] = 1e9
    before, after = of(e, 0.9999), of(spiked, 0.9999)
    assert 0.0 < after.ratio.value - before.ratio.value <= 1.001 * chi2.ppf(0.9999, 1) / 1000
    assert abs(after.bias.value - before.bias.value) < 0.01


def test_figures_are_their_definitions():
    e = normal(6, 500) + 0.1
    found = of(e)
    assert (found.subject, found.role, found.start, found.n) == ("float", "used", 0.0, 500)
    assert found.end == pytest.approx(499.0)
    assert found.ratio.value == pytest.approx(np.mean(e**2), rel=1e-12)
    assert found.bias.value == pytest.approx(np.mean(e), rel=1e-12)
    z = e - e.mean()
    assert found.correlation.value == pytest.approx(np.sum(z[1:] * z[:-1]) / np.sum(z**2), rel=1e-12)
    for band, share in zip((0.5, 0.9, 0.95), found.coverage, strict=True):
        assert share.value == np.mean(np.abs(e) <= norm.ppf(0.5 + band / 2))


def test_sensors_held_out_have_their_coverage_and_rows_their_own():
    """Row near is as predicted, far is three times as far off; every tenth row of near is missing."""
    n = 1000
    track = Track.allocate(n, 2, 0, 2)
    e = np.column_stack((normal(9, n), 3.0 * normal(10, n)))
    e[::10, 0] = np.nan
    track.innovation[:], track.innovation_std[:] = 2.0 * e, 2.0
    track.verdict[:] = HELD_OUT
    track.verdict[5] = MISSING
    t = SECOND * np.arange(n)
    events = Events(t, t, np.full(n, READING, np.int8), np.ones(n, np.int32), np.zeros((n, 2)))
    near, far = calibrations(MODEL, events, track, gate=0.99)
    assert (near.subject, near.role, near.n, far.n) == ("sonar.near", "held out", 899, 999)
    assert np.isnan(near.scale).all() and near.words == ()
    # Of N(0, 9) the band ± 1.96 holds 48.6 %.
    assert far.coverage[2].low < 2 * norm.cdf(1.96 / 3) - 1 < far.coverage[2].high
    assert len(far.words) == 1 and far.words[0].startswith("sonar.far: ") and "in the 95 % band" in far.words[0]


def test_predictions_that_are_not_gaussian_are_judged_by_their_distribution():
    events, track = read(2.0 * normal(11))
    track.whitened[:, 0] = normal(12)
    (by_moments,) = calibrations(MODEL, events, track)
    (own,) = calibrations(MODEL, events, track, marginal=True)
    assert by_moments.words and own.words == ()
    assert own.bias.value == pytest.approx(np.mean(normal(12)))


def told(level: np.ndarray, heading: np.ndarray, std: float = 0.1) -> tuple[Events, Track]:
    """True states, told together, of estimates that stay at 0 and 3 rad."""
    n = level.size
    track = Track.allocate(n, 2, 0, 2)
    track.mean[:], track.std[:] = (0.0, 3.0), std
    t = SECOND * np.arange(n)
    values = np.column_stack((level, heading))
    return Events(t, t, np.full(n, TRUTH, np.int8), np.zeros(n, np.int32), values), track


def test_truth_outside_its_band_is_said():
    n = 1000
    lost = 0.1 * normal(13, n) + 1.0
    lost[::33] = 0.0
    level, heading = truth_calibration(MODEL, *told(lost, 3.0 + 0.1 * normal(14, n)))
    share, bias = level.words
    assert share.startswith("level: truth in its 95 % band 3.1 % (") and share.endswith(") of the time")
    assert bias.startswith("level: truth above the estimate (bias +9.")
    assert heading.words == () and heading.role == "truth"
    assert heading.ratio.low < 1.0 < heading.ratio.high


def test_angles_are_off_the_short_way_and_wide_bands_are_said():
    n = 400
    level, heading = truth_calibration(MODEL, *told(0.02 * normal(15, n), 3.0 - 2 * np.pi + 0.1 * normal(16, n)))
    assert heading.words == () and abs(heading.bias.value) < 0.3
    (said,) = level.words
    assert said.startswith("level: truth in its 90 % band 100 % (") or said.startswith("level: truth in its 95 % band")
    assert said.endswith("of the time, too wide")


def test_an_error_that_hardly_moves_is_no_certainty():
    """An estimate that was off once, slowly, by as much as its band allows: nothing sure can be said."""
    n = 5000
    slow = 0.15 * np.sin(np.linspace(0.0, 2 * np.pi, n))
    level, _ = truth_calibration(MODEL, *told(slow, 3.0 + 0.1 * normal(17, n)))
    assert level.words == () and level.scale.high / level.scale.low > 1.5


def test_few_readings_have_figures_and_no_words():
    found = of(5.0 * normal(18, 5))
    assert found.n == 5 and found.words == () and np.isnan(found.scale.low) and found.scale.value > 1.0
    events, track = read(np.zeros(0))
    assert calibrations(MODEL, events, track) == [] == truth_calibration(MODEL, events, track)
    (said,) = of(np.zeros(50)).words
    assert said.startswith("float: bands far too wide: the readings never differ from the prediction (scale 0.00")


def settled(q: float, r: float) -> tuple[float, float]:
    """Return predicted variance and gain of a random walk's filter in steady state."""
    P = 0.5 * (q + np.sqrt(q * q + 4.0 * q * r))
    return P, P / (P + r)


def test_coverage_by_time_and_operating_point_is_that_of_a_filter_whose_noise_changes():
    """The filter expects r; the sensor has twice as much in the second half, which its input tells.

    The error before a measurement has the variance V' = (1 - K)² V + K² r' + q, its innovation V + r'.
    """
    n, q, r = 10_000, 0.1, 1.0
    P, gain = settled(q, r)
    rng = np.random.default_rng(8)
    noise = np.where(np.arange(n) < n // 2, r, 2.0 * r)
    error, variance = np.sqrt(P) * rng.standard_normal(), P
    innovation, expected = np.empty(n), np.empty(n)
    for k in range(n):
        v = np.sqrt(noise[k]) * rng.standard_normal()
        innovation[k] = error + v
        expected[k] = 2.0 * norm.cdf(1.959964 * np.sqrt((P + r) / (variance + noise[k]))) - 1.0
        error = (1.0 - gain) * error - gain * v + np.sqrt(q) * rng.standard_normal()
        variance = (1.0 - gain) ** 2 * variance + gain**2 * noise[k] + q
    model = replace(MODEL, inputs=(Input("load", "kW", 0.0),))
    events, track = read(innovation / np.sqrt(P + r))
    load = np.where(np.arange(n) < n // 2, 0.0, 7.0)[:, None]
    found = coverage_bins(model, events, track, load)
    tenths = [item for item in found if item.by == "time"]
    loads = [item for item in found if item.by == "load"]
    assert [item.n for item in tenths] == [n // 10] * 10 and [item.low for item in loads] == [0.0, 7.0]
    parts = [(item, expected[k * n // 10 : (k + 1) * n // 10].mean()) for k, item in enumerate(tenths)]
    parts += [(item, expected[k * n // 2 : (k + 1) * n // 2].mean()) for k, item in enumerate(loads)]
    assert expected[0] == pytest.approx(0.95) and expected[-1] < 0.87
    for item, share in parts:
        # Positive correlation of neighbours, below 0.4, doubles the variance of the share at most.
        assert abs(item.coverage.value - share) < 4.0 * np.sqrt(2.0 * share * (1.0 - share) / item.n)
    inside = [item.coverage.low <= share <= item.coverage.high for item, share in parts]
    # Of 12 intervals of 95 %, 8 or fewer hold with a probability of 2e-4.
    assert sum(inside) >= 9
    # The second half is below 95 % beyond chance; there the adaptive interval is as much wider as it must be.
    assert all(item.coverage.high < 0.95 for item in tenths[5:])
    late = tenths[-1]
    wide = norm.ppf(0.975) / norm.ppf(0.5 + 0.5 * expected[-1])
    assert late.factor == pytest.approx(wide, rel=0.1) and abs(late.adaptive - 0.95) < 0.02


def test_adaptive_intervals_are_those_of_their_definition_and_hold_for_any_distribution():
    """Gibbs & Candès, proposition 4.1: over n predictions the error is off by (max(α, 1 - α) + γ) / (γ n) at most."""
    e = np.random.default_rng(9).standard_cauchy(5000) * np.linspace(1.0, 3.0, 5000)
    widths = adaptive_widths(e)
    alpha, rate, window, first = 0.05, 0.005, 500, 40
    assert np.isnan(widths[:first]).all()
    level = alpha
    for k in range(first, 1500):
        scores = np.sort(np.abs(e[max(0, k - window) : k]))
        place = int(np.ceil((1.0 - level) * (scores.size + 1)))
        expected = np.inf if place > scores.size else scores[place - 1]
        assert widths[k] == expected
        level += rate * (alpha - (abs(e[k]) > expected))
    missed = np.mean(np.abs(e[first:]) > widths[first:])
    assert abs(missed - alpha) <= (1.0 - alpha + rate) / (rate * (e.size - first))


def test_a_log_of_hours_is_divided_into_hours():
    found = coverage_bins(MODEL, *read(normal(6, 4 * 3600 + 1)), np.zeros((4 * 3600 + 1, 0)))
    assert [(item.low, item.high) for item in found if item.by == "time"] == [
        (3600.0 * k, 3600.0 * (k + 1)) for k in range(4)
    ]


def test_inputs_hold_until_they_change():
    t = np.arange(5)
    kind = np.array([READING, INPUT, READING, INPUT, READING], np.int8)
    value = np.array([[9.0, 9.0], [1.0, np.nan], [9.0, 9.0], [np.nan, 2.0], [9.0, 9.0]])
    model = replace(MODEL, inputs=(Input("a", "V", 0.0), Input("b", "V", 0.0)))
    held = held_inputs(model, Events(t, t, kind, np.zeros(5, np.int32), value))
    np.testing.assert_array_equal(held, [[np.nan] * 2, [1.0, np.nan], [1.0, np.nan], [1.0, 2.0], [1.0, 2.0]])
