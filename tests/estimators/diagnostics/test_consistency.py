"""By what a mean NIS is judged, against innovations that are drawn as a commissioned twin's are."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

from estimators.diagnostics.consistency import NisVerdict
from estimators.diagnostics.health import JUDGED_MEAN, MEAN, VARIANCE, nis_bounds, normal_nis
from estimators.diagnostics.score import nis_verdict
from estimators.log import READING, Events
from estimators.track import GATED, USED, Track
from tests.cases import cases
from tests.models import FLOAT_AND_SONAR as MODEL

BASELINE = np.array([[0.3, 0.5, 0.7], [0.0, 1.0, 0.0], [-0.5, 2.0, -0.4]])  # bias, scale, correlation of each row
N = 400
RUNS = 4000


def drawn(rng, b, s, phi):
    """Stationary AR(1) innovations of N readings, RUNS times."""
    e = np.empty((RUNS, N))
    e[:, 0] = rng.standard_normal(RUNS)
    for k in range(1, N):
        e[:, k] = phi * e[:, k - 1] + np.sqrt(1 - phi**2) * rng.standard_normal(RUNS)
    return b + s * e


def test_bounds_hold_95_of_100_means_of_correlated_innovations():
    """Four thousand runs of 400 readings of each sensor, drawn as their baseline says."""
    rng = np.random.default_rng(1)
    squares = [drawn(rng, *row) ** 2 for row in BASELINE]
    normal = normal_nis(MODEL, BASELINE)
    total = sum(squares).sum(axis=1)
    expected = N * (normal[0, MEAN] + 2 * normal[1, MEAN])
    # Standard error of a mean of 4,000.
    assert abs(total.mean() - expected) < 4 * total.std() / np.sqrt(RUNS)
    variance = N * (normal[0, VARIANCE] + 2 * normal[1, VARIANCE])
    # A variance of 4,000 values is known to sqrt(2 / 4000), 2.2 %; the sum's own formula leaves out the ends, 1 %.
    assert total.var() == pytest.approx(variance, rel=0.1)
    low, high = nis_bounds(np.array([N, 2 * N]), 2 * N, normal)
    inside = np.mean((low <= total / (2 * N)) & (total / (2 * N) <= high))
    assert inside == pytest.approx(0.95, abs=4 * np.sqrt(0.05 * 0.95 / RUNS))
    # The bounds of white innovations of this mean would hold fewer.
    free = 3 * N
    narrow = [expected / free * chi2.ppf(q, free) / (2 * N) for q in (0.025, 0.975)]
    assert np.mean((narrow[0] <= total / (2 * N)) & (total / (2 * N) <= narrow[1])) < 0.8


def test_white_innovations_leave_the_chi_square():
    normal = normal_nis(MODEL, np.array([[0.0, 1.0, 0.0]] * 3))
    assert normal.tolist() == [[1.0, 1.0, 2.0]] * 2
    bounds = nis_bounds(np.array([30, 20]), 40, normal)
    assert bounds == nis_bounds(np.array([30, 20]), 40)
    assert bounds == pytest.approx([chi2.ppf(q, 50) / 40 for q in (0.025, 0.975)], rel=1e-12)


def test_a_smaller_normal_does_not_make_divergence_earlier():
    assert normal_nis(MODEL, BASELINE)[0, JUDGED_MEAN] == 1.0
    assert normal_nis(MODEL, BASELINE)[0, MEAN] == pytest.approx(0.34, rel=1e-12)


def test_no_readings_have_no_bounds():
    assert np.isnan(nis_bounds(np.array([0, 0]), 0)).all()
    assert NisVerdict(np.nan, np.nan, np.nan, False).words == "no reading to judge"


@cases(__file__, "nis_words.csv")
def test_it_says_where_a_mean_lies_and_by_what(nis, commissioned, words):
    """Numbers that differ read differently, with the same decimals."""
    nis, commissioned = float(nis), commissioned == "True"
    assert NisVerdict(nis, 0.9, 1.1, commissioned).words == words
    # Of measurements of eight rows all three are eight times as large.
    assert NisVerdict(8 * nis, 7.2, 8.8, commissioned, dof=8.0).words == words


def test_of_a_commissioned_twin_the_same_readings_are_compared_as_were_taken_for_normal():
    """On the data of the commission a NIS is inside, though outliers are in its mean and refused ones are not."""
    rng = np.random.default_rng(4)
    n = 2000
    e = np.concatenate((rng.normal(0, 0.5, n), [30.0] * 5, [8.0] * 40))
    verdict = np.repeat([USED, USED, GATED], [n, 5, 40])
    track, t = Track.allocate(e.size, 1, 0, 2), np.arange(e.size, dtype=np.int64)
    track.verdict[:], track.dof[:], track.nis[:] = verdict, 1, e**2
    track.innovation[:, 0], track.innovation_std[:, 0] = e, 1.0
    track.innovation[:, 1] = track.whitened[:] = np.nan
    events = Events(t, t, np.full(e.size, READING, np.int8), np.zeros(e.size, np.int32), np.zeros((e.size, 2)))
    clipped = np.clip(e, -6, 6)
    baseline = np.array([[clipped.mean(), clipped.std(), 0.0], [0, 1, 0], [0, 1, 0]])
    found = nis_verdict(track, events, MODEL, baseline)
    assert found.nis == pytest.approx((e[: n + 5] ** 2).mean(), rel=1e-12) and found.nis > found.high
    assert found.judged == pytest.approx((clipped**2).mean(), rel=1e-12) and found.place == "inside"
    assert found.words == (
        f"mean NIS {found.nis:.2f} per degree of freedom, {found.judged:.2f} with rejected measurements included and "
        f"outliers limited to 6 σ, inside the 95 % bounds {found.low:.2f} to {found.high:.2f} of the commissioned "
        "baseline"
    )
    # Outliers of 30 σ allow for any mean, but not for bands that are off by more than a quarter.
    own = nis_verdict(track, events, MODEL)
    assert own.place == "above" and np.isnan(own.judged) and own.high == pytest.approx(1.25**2, rel=1e-12)


@pytest.mark.parametrize("phi", [0.0, 0.9, -0.9])
def test_a_filter_whose_innovations_have_the_right_size_is_inside_nineteen_times_in_twenty(phi):
    """AR(1) innovations of variance 1: chi-square's bounds hold fewer of the means, whose variance is larger."""
    runs, n = 400, 2000
    rng = np.random.default_rng(6)
    t = np.arange(n, dtype=np.int64)
    track = Track.allocate(n, 1, 0, 2)
    track.verdict[:], track.dof[:] = USED, 1
    events = Events(t, t, np.full(n, READING, np.int8), np.zeros(n, np.int32), np.zeros((n, 2)))
    inside, white = 0, 0
    for _ in range(runs):
        e = lfilter([1.0], [1.0, -phi], np.sqrt(1 - phi**2) * rng.standard_normal(n + 200))[200:]
        track.nis[:] = e**2
        found = nis_verdict(track, events, MODEL)
        inside += found.place == "inside"
        white += found.white_low <= found.nis <= found.white_high
        assert (found.white_low, found.white_high) == pytest.approx(
            [chi2.ppf(q, n) / n for q in (0.025, 0.975)], rel=1e-9
        )
        assert found.low <= found.white_low and found.white_high <= found.high
    # Four deviations of a share of 400 below 95 %; the mean of n squares has the variance 2 (1 + φ²) / (1 - φ²) / n.
    assert inside / runs > 0.95 - 4 * np.sqrt(0.95 * 0.05 / runs)
    expected = 2 * norm.cdf(1.96 * np.sqrt((1 - phi**2) / (1 + phi**2))) - 1
    assert white / runs == pytest.approx(expected, abs=4 * np.sqrt(0.25 / runs))
    # A covariance that is too small by a factor of two is found with any correlation.
    track.nis[:] = 2 * e**2
    assert nis_verdict(track, events, MODEL).place == "above"
