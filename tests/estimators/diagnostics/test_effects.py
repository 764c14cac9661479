"""Sizes, intervals, onsets and causes of simulated innovations of which everything is known."""

import numpy as np
import pytest
from scipy.stats import binom

from estimators.diagnostics.effects import KINDS, common_scale, effects, onset

RUNS = 400


def by_cause(e):
    return {effect.cause: effect for effect in effects(e)}


def correlated(rng, phi, n):
    """AR(1) of unit variance."""
    e = np.empty(n)
    e[0] = rng.normal()
    for k in range(1, n):
        e[k] = phi * e[k - 1] + np.sqrt(1.0 - phi**2) * rng.normal()
    return e


def spikes(rng, share, n):
    """Standard noise in which this share is at ±5.5, each by itself."""
    far = rng.random(n) < share
    far[1:] &= ~far[:-1]
    return np.where(far, 5.5 * rng.choice([-1.0, 1.0], n), rng.normal(size=n)), float(np.mean(far))


MADE = {
    "shifted": lambda rng, n: rng.normal(0.6, 1.0, n),
    "narrow": lambda rng, n: rng.normal(0.0, 1.7, n),
    "wide": lambda rng, n: rng.normal(0.0, 0.5, n),
    "correlated": lambda rng, n: correlated(rng, 0.5, n),
    "alternating": lambda rng, n: correlated(rng, -0.5, n),
    "spiky": lambda rng, n: spikes(rng, 0.03, n)[0],
}
TRUE = {"shifted": 0.6, "narrow": 1.7, "wide": 0.5, "correlated": 0.5, "alternating": -0.5}


def covers(truth, seed, find):
    """Whether as many intervals hold the truth as those of 95 % may."""
    rng = np.random.default_rng(seed)
    found = [find(rng) for _ in range(RUNS)]
    assert all(each.low <= each.size <= each.high for each in found)
    return 0.9 * RUNS <= sum(each.low <= truth <= each.high for each in found) <= 0.99 * RUNS


@pytest.mark.parametrize("cause", TRUE)
def test_intervals_cover_the_truth(cause):
    """Of 95 % intervals between 90 and 99 % hold the truth: with 400 runs a sound one leaves that once in 10⁵ times."""
    assert binom.cdf(0.9 * RUNS, RUNS, 0.95) + binom.sf(0.99 * RUNS, RUNS, 0.95) < 1e-4
    assert covers(TRUE[cause], 1, lambda rng: by_cause(MADE[cause](rng, 200))[cause])


def test_the_mean_of_correlated_innovations_is_known_less_well():
    """A mean of AR(1) has (1 + φ) / (1 - φ) times the variance: an interval as of white noise would hold 60 %."""
    assert covers(0.4, 2, lambda rng: by_cause(0.4 + correlated(rng, 0.6, 400))["shifted"])


def test_the_share_of_spikes_is_counted():
    """All at 5.5 are, and of the normal ones beyond 4 one in 16,000."""
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(RUNS):
        e, share = spikes(rng, 0.03, 500)
        found = by_cause(e)["spiky"]
        assert abs(found.size - share) <= 2.5 / 500
        # What was drawn with 3 %, less those that would have stood side by side.
        inside += found.low <= 0.03 / 1.03 <= found.high
    # The normal interval of a small share is known to be short: 93 % at 15 of 500 (Brown, Cai & DasGupta 2001).
    assert 0.88 * RUNS <= inside <= 0.99 * RUNS


def test_the_scale_of_rows_together_covers_the_truth():
    """NIS of three rows, of which one is missing at times, all with 1.2 times the noise."""

    def find(rng):
        dof = rng.integers(2, 4, 100)
        found = common_scale(1.2 * np.sqrt(rng.chisquare(dof) / dof), dof)
        assert found.cause == "narrow"
        return found

    assert covers(1.2, 10, find)


@pytest.mark.parametrize("cause", KINDS)
def test_the_cause_is_named(cause):
    rng = np.random.default_rng(4)
    named = [effects(MADE[cause](rng, 300))[0].cause for _ in range(100)]
    assert named.count(cause) >= 95


def test_ratios_are_those_of_the_normal_density():
    """Generalised likelihood ratios by hand: of (3, 1, 2, 2) with mean 2, variance ½ and lag-1 sum -1 of 2."""
    found = by_cause(np.array([3.0, 1.0, 2.0, 2.0]))
    assert found["shifted"].size == 2.0 and found["shifted"].ratio == pytest.approx(0.5 * 4 * 4.0)
    assert found["wide"].size == pytest.approx(np.sqrt(0.5))
    assert found["wide"].ratio == pytest.approx(0.5 * 4 * (0.5 - 1.0 + np.log(2.0)))
    assert found["alternating"].size == pytest.approx(-0.5)
    assert found["alternating"].ratio == pytest.approx(-0.5 * 4 * np.log(0.75))


def test_neighbours_are_no_spikes():
    """Several in a row on one side are a shift, on both sides they alternate."""
    e = np.random.default_rng(6).normal(size=200)
    e[100:103] = 5.5
    assert "spiky" not in by_cause(e)
    e[101] = -5.5
    assert by_cause(e)["spiky"].size == pytest.approx(3 / 200)


# Where it began

BEFORE, AFTER = 300, 200


def told(e, mean=0.0, deviation=1.0, phi=0.0):
    """The likeliest onset if what follows it is known."""
    last = np.append(0.0, e[:-1])
    rest = deviation**2 * (1.0 - phi**2)
    ratio = -0.5 * ((e - mean - phi * last) ** 2 / rest + np.log(rest) - e**2)
    return int(np.argmax(np.cumsum(ratio[::-1])[::-1]))


@pytest.mark.parametrize(
    ("cause", "truth"),
    [
        ("shifted", {"mean": 0.6}),
        ("narrow", {"deviation": 1.7}),
        ("wide", {"deviation": 0.5}),
        ("correlated", {"phi": 0.5}),
        ("alternating", {"phi": -0.5}),
    ],
)
def test_the_onset_is_found(cause, truth):
    """Nine in ten are off by no more than half as much again as of one who is told the size of the change."""
    rng = np.random.default_rng(7)
    runs = [np.append(rng.normal(size=BEFORE), MADE[cause](rng, AFTER)) for _ in range(RUNS)]
    off = np.abs([onset(e, cause) - BEFORE for e in runs])
    least = np.abs([told(e, **truth) - BEFORE for e in runs])
    assert np.quantile(off, 0.9) <= 1.5 * np.quantile(least, 0.9)


def test_the_first_spike_is_the_onset():
    e = np.random.default_rng(8).normal(size=100)
    assert onset(e, "spiky") == 99
    e[[40, 70]] = 6.0, -6.0
    assert onset(e, "spiky") == 40


# Too little


@pytest.mark.parametrize("n", range(4))
@pytest.mark.parametrize("value", [0.0, 1.0, -2.5, 1e6, -1e6])
def test_few_or_equal_innovations_are_sized_too(n, value):
    """No warning, no exception, nothing that is not a number; beyond 6 σ it counts as 6."""
    found = effects(np.full(n, value))
    with np.errstate(all="raise"):
        assert effects(np.full(n, value)) == found
    for effect in found:
        assert effect.cause in KINDS
        assert np.isfinite([effect.size, effect.low, effect.high, effect.ratio]).all()
        assert effect.low <= effect.size <= effect.high
    shifted = next(effect for effect in found if effect.cause == "shifted")
    assert shifted.size == (np.clip(value, -6.0, 6.0) if n else 0.0)
    for cause in KINDS if n else ():
        assert 0 <= onset(np.full(n, value), cause) < n


def test_one_innovation_has_the_interval_of_one():
    (found,) = effects(np.array([0.7]))
    assert (found.low, found.high) == pytest.approx((0.7 - 1.959964, 0.7 + 1.959964))
