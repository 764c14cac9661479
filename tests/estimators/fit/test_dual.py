"""Dual estimation over a log: windows follow a parameter that changes, and nothing is proposed that does not win."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.errors import EstimatorError
from estimators.fit.dual import against, agrees, shift, tail, walk
from estimators.fit.fit import fit
from estimators.fit.objective import Cancelled
from estimators.fit.recording import Recording
from estimators.tuning import Tuning
from tests.estimators.fit.test_fit import MODEL, log_of
from tests.support import folded

Q, R = 0.2, 0.05
WINDOW = 1500


def wearing(seed, rates):
    """Readings, one a second, of the walk whose rate is another in each window."""
    rng = np.random.default_rng(seed)
    x, ys = rng.normal(0.0, 1.0), []
    for rate in np.repeat(rates, WINDOW):
        x = (1.0 - rate) * x + rng.normal(0.0, np.sqrt(Q))
        ys.append(x + rng.normal(0.0, np.sqrt(R)))
    return log_of(np.array(ys))


def believed(rate=0.2):
    return Tuning.of(MODEL).set("Q.level", Q).set("R.float", R).set("R.silent", R).set("p.rate", rate)


def walked(log, tuning=None, **options):
    return list(walk("kf", tuning or believed(), log, wanted=["p.rate"], **{"window": WINDOW, **options}))


def rate_line(refit):
    (line,) = refit.fitted.lines
    return line


@pytest.fixture(scope="module")
def stepped():
    return walked(wearing(2, [0.2, 0.2, 0.4, 0.4]))


def test_windows_follow_a_parameter_that_steps(stepped):
    assert [refit.events for refit in stepped] == [WINDOW] * 4
    for refit, rate in zip(stepped, [0.2, 0.2, 0.4, 0.4], strict=True):
        line = rate_line(refit)
        assert line.low < rate < line.high
    # The step is seen where it comes: an autoregression's coefficient a has the deviation √((1 - a²) / n), here of the
    # two thirds that are fitted to, so that log 2 is some ten of them.
    assert [refit.proposed for refit in stepped] == [False, False, True, False]
    assert shift(rate_line(stepped[2])) > 5.0
    # What was adopted is what the next window starts from.
    assert [refit.tuning.get("p.rate") for refit in stepped] == [0.2, 0.2, 0.2, rate_line(stepped[2]).after]


def test_the_filter_lives_with_what_it_knew_at_the_time(stepped):
    log = wearing(2, [0.2, 0.2, 0.4, 0.4])
    for k, refit in enumerate(stepped):
        fold = folded("kf", MODEL, log, refit.tuning)
        rows = slice(k * WINDOW, (k + 1) * WINDOW)
        np.testing.assert_array_equal(refit.lived.mean, fold.track.mean[rows])
        np.testing.assert_array_equal(refit.lived.std, fold.track.std[rows])


def test_intervals_hold_wear_as_often_as_they_say():
    # Of 80 intervals of 95 % fewer than 69 hold the truth once in a thousand trials (binomial).
    rates = [0.2, 0.25, 0.32, 0.4]
    lines = [
        (rate, rate_line(refit))
        for seed in range(20)
        for rate, refit in zip(rates, walked(wearing(seed, rates)), strict=True)
    ]
    inside = sum(line.low < rate < line.high for rate, line in lines)
    assert 69 <= inside
    # And they are not wide for that: those of an autoregression without R, of the two thirds that are fitted to, and
    # half as much again on average for R and for readings that hang together.
    ideal = [3.92 * np.sqrt((1 - (1 - rate) ** 2) / (WINDOW * 2 / 3)) for rate, _ in lines]
    assert 1.0 < np.mean([line.high - line.low for _, line in lines] / np.array(ideal)) < 1.5


def test_windows_overlap_and_one_is_enough():
    log = wearing(3, [0.2, 0.2])
    found = walked(log, every=WINDOW / 2)
    assert [(refit.start // 10**9, refit.end // 10**9) for refit in found] == [(0, 1499), (750, 2249), (1500, 2999)]
    # What is left is a window if it is as long as half the way to the next.
    assert [refit.events for refit in walked(log, window=1800.0)] == [1800, 1200]
    assert [refit.events for refit in walked(log, window=2200.0)] == [2200]
    # A log that is shorter than a window is one.
    (only,) = walked(log, window=5000.0)
    assert (only.events, only.start, only.end) == (log.n, 0, int(log.t[log.n - 1]))


def test_a_tail_is_folded_to_the_same_bits():
    log = wearing(4, [0.2, 0.2])
    fold = folded("kf", MODEL, log, believed())
    whole = fold.track.copy()
    for start in (0, 1, 130, 700, 999, 5000):
        part, base = tail(fold, start)
        again = folded("kf", MODEL, part, believed(), base=base)
        first = min(start, log.n - 1)
        assert part.n == log.n - first
        np.testing.assert_array_equal(again.track.mean, whole.mean[first:])
        np.testing.assert_array_equal(again.track.log_likelihood, whole.log_likelihood[first:])
        # The fold is where it was.
        assert fold.n == log.n
        np.testing.assert_array_equal(fold.track.mean, whole.mean)


def test_a_window_that_cannot_be_fitted_stops_nothing():
    log = log_of(np.r_[np.zeros(WINDOW), wearing(5, [0.2]).value[:WINDOW, 0]])
    # R of a sensor that never changes cannot be identified.
    first, second = list(walk("kf", believed(), log, wanted=["R.float"], window=WINDOW))
    assert first.fitted is None and "readings never change" in first.reason and not first.proposed
    assert second.fitted is not None and second.reason == ""


def test_cancelled_and_refused():
    log = wearing(6, [0.2, 0.2])
    with pytest.raises(Cancelled):
        walked(log, go=lambda folds: False)
    for options in ({"window": 0.0}, {"every": -1.0}):
        with pytest.raises(EstimatorError, match="must be positive"):
            walked(log, **options)


def test_two_fits_agree_while_the_data_say_the_same():
    readings = wearing(7, [0.3]).value[:WINDOW, 0]
    # The same window a while later, and one of another asset.
    one, later, worn = (
        fit("kf", believed(), [Recording(log)], wanted=["p.rate"])
        for log in (log_of(readings), log_of(readings[150:]), wearing(9, [0.6]))
    )
    assert agrees(one, one) and agrees(later, one) and not agrees(worn, one) and not agrees(one, worn)
    (line,) = worn.lines
    assert shift(line) == pytest.approx(np.log(line.after / 0.2) / line.deviation)
    # Other entries are another statement.
    both = fit("kf", believed(), [Recording(log_of(readings))], wanted=["p.rate", "R.float"])
    assert not agrees(both, one)


def test_a_value_that_lies_in_its_interval_has_nothing_against_it():
    won = fit("kf", believed(), [Recording(wearing(9, [0.6]))], wanted=["p.rate", "R.float"])
    assert won.proposed and against(won) == ()
    inside = tuple(line if line.alone else line._replace(before=line.after) for line in won.lines)
    assert against(replace(won, lines=inside)) == ("every current value lies in its 95 % interval",)
    # One that has left it is enough.
    assert against(replace(won, lines=(won.lines[0], inside[1]))) == ()
    lost = fit("kf", believed(), [Recording(wearing(10, [0.2]))], wanted=["p.rate"])
    assert not lost.proposed and against(lost) == lost.verdict.reasons
