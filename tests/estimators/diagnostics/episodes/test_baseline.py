"""What was normal when a tuning was accepted: a wrong model is silent on more of the same, and speaks of a change."""

from dataclasses import replace

import numpy as np
import pytest

from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.detectors import ALARM_NAMES, BITS, NARROW
from estimators.diagnostics.episodes import episodes
from estimators.diagnostics.episodes.baseline import (
    BASELINE_MARGIN,
    MIN_MEASUREMENTS,
    Normal,
    baseline_of,
    commission,
    lost_from,
)
from estimators.diagnostics.health import JUDGED_MEAN, MAX_ROWS_PER_READING, MIN_WINDOW_EVENTS, HealthPolicy, normal_nis
from estimators.log import READING, RESET, Events
from estimators.track import DIVERGED
from estimators.tuning import Tuning
from tests.models import level_model
from tests.support import SECOND, as_log
from tests.support import folded as advanced

MODEL = level_model({"gauge": 0.04, "floats": {"left": 0.09, "right": 0.09}}, 0.01, linear=True)


def asset(seed, n=3000, *, change=None):
    """An asset that the model does not describe: it swings, the gauge is 0.1 m off and half as noisy as believed.

    `change` (n,): what is added to the gauge besides.
    """
    rng = np.random.default_rng(seed)
    k = np.arange(n)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    x = 0.5 * np.sin(k / 12.0 + phase) + np.cumsum(rng.normal(0.0, 0.03, n))
    gauge = x + 0.1 + rng.normal(0.0, 0.1, n) + (0.0 if change is None else change)
    floats = x[:, None] + rng.normal(0.0, 0.4, (n, 2))
    value = np.full((2 * n, MODEL.width), np.nan)
    value[::2, 0], value[1::2] = gauge, floats
    t = np.repeat((k + 1) * SECOND, 2)
    channel = np.tile([0, 1], n).astype(np.int32)
    return as_log(Events(t, t.copy(), np.full(2 * n, READING, np.int8), channel, value))


def folded(log, baseline=None, policy=None):
    return advanced("kf", MODEL, log, replace(Tuning.of(MODEL), baseline=baseline), policy=policy)


@pytest.fixture(scope="module")
def normals():
    fold = folded(asset(0))
    assert fold.track.alarms.any(axis=1).mean() > 0.5
    return commission(fold)


def test_the_normal_is_that_of_the_innovations(normals):
    """Bias, scale and correlation by numpy, of e cut at 6 σ, to the three digits that are kept."""
    track = folded(asset(0)).track
    assert list(normals) == ["gauge", "floats.left", "floats.right"]
    for name, first, k in (("gauge", 0, 0), ("floats.left", 1, 0), ("floats.right", 1, 1)):
        e = np.clip(track.innovation[first::2, k] / track.innovation_std[first::2, k], -6.0, 6.0)
        lag = np.corrcoef(e[1:], e[:-1])[0, 1]
        normal = normals[name]
        assert (normal.bias, normal.scale) == pytest.approx((e.mean(), e.std()), abs=5.1e-4)
        # That of corrcoef takes the means and deviations of either end apart: 1/n more or less.
        assert normal.correlation == pytest.approx(lag, abs=2e-3)
        assert set(normal.reached) <= set(ALARM_NAMES) and all(peak > 1.0 for peak in normal.reached.values())


@pytest.mark.parametrize("seed", range(1, 7))
def test_more_of_the_same_is_silent(normals, seed):
    baseline = baseline_of(MODEL, normals)
    assert not folded(asset(seed), baseline).track.alarms.any()
    assert folded(asset(seed)).track.alarms.any()


@pytest.mark.parametrize(
    ("change", "cause", "within"),
    [
        (lambda rng, n: np.full(n, 0.5), "shifted up", 60),
        (lambda rng, n: np.full(n, -0.5), "shifted down", 60),
        (lambda rng, n: rng.normal(0.0, 0.5, n), "narrow", 60),
    ],
    ids=["above", "below", "noisy"],
)
def test_a_change_is_heard(normals, change, cause, within):
    """Against what was normal, in the gauge, soon after it began at reading 1500, and not before."""
    rng = np.random.default_rng(9)
    added = np.append(np.zeros(1500), change(rng, 1500))
    track = folded(asset(1, change=added), baseline_of(MODEL, normals)).track
    gauge = track.alarms[::2, 0]
    assert not gauge[:1500].any()
    assert np.bitwise_or.reduce(gauge[1500 : 1500 + within]) >> ALARM_NAMES.index(cause) & 1


def test_outliers_side_by_side_are_another_effect(normals):
    """Only the test for outliers is in alarm; two side by side are none, and nothing was said of their size."""
    added = np.zeros(1530)
    added[1500:1502] = 2.0
    fold = folded(asset(1, n=1530, change=added), baseline_of(MODEL, normals))
    (found,) = (item for item in episodes(fold) if item.subject == "gauge")
    assert (found.cause, found.start) == ("narrow", 1501.0)
    assert 1.0 < found.low < found.size < found.high and "nan" not in found.text


def test_the_baseline_is_what_was_normal(normals):
    """Margin times what was reached, for every test of that cause; white innovations for a row without a normal."""
    part = {"gauge": normals["gauge"]}
    baseline = baseline_of(MODEL, part)
    np.testing.assert_array_equal(baseline[1:], no_baseline(MODEL)[1:])
    assert tuple(baseline[0, :3]) == part["gauge"][:3]
    assert np.all(baseline[0, 3:][BITS == NARROW] == BASELINE_MARGIN * part["gauge"].reached.get("narrow", 0.0))


def lurching(n=600, at=200, until=212):
    """The asset, of which the gauge jumps to and fro for a while, and a reset in the middle of that."""
    rng = np.random.default_rng(3)
    change = np.where((np.arange(n) >= at) & (np.arange(n) < until), rng.choice([-4.0, 4.0], n), 0.0)
    events = asset(1, n, change=change).events
    middle = Events.one((at + until) * SECOND // 2, 0, RESET, 0, (), MODEL.width)
    return as_log(Events.concat([events, middle], MODEL.width))


def test_the_highest_nis_over_a_window_is_by_definition():
    """Over every reading and those before it, with a reset that begins anew: a loop over rows, as its words say."""
    fold = folded(lurching())
    normals = commission(fold)
    normal = normal_nis(MODEL, baseline_of(MODEL, normals))[:, JUDGED_MEAN]
    log, track, most = fold.log, fold.track, [0.0, 0.0]
    for i in np.flatnonzero(log.kind[: log.n] == READING):
        rows = []
        for k in range(i, max(-1, i - MAX_ROWS_PER_READING * fold.policy.window), -1):
            if log.kind[k] == RESET or len(rows) == fold.policy.window:
                break
            rows.append(k)
        if len(rows) >= MIN_WINDOW_EVENTS:
            ratio = track.nis[rows].sum() / (track.dof[rows] * normal[log.channel[rows]]).sum()
            most[log.channel[i]] = max(most[log.channel[i]], ratio)
    assert min(most) > HealthPolicy().diverged_nis
    assert [normals[name].nis for name in normals] == pytest.approx([most[0], most[1], most[1]], abs=5.1e-4)


def test_what_was_accepted_is_not_called_lost_and_what_is_half_as_bad_again_is():
    log = lurching()
    before = folded(log)
    assert np.any(before.track.health == DIVERGED)
    normals = commission(before)
    policy = HealthPolicy(diverged_nis=lost_from(normals))
    baseline = baseline_of(MODEL, normals)
    again = folded(log, baseline, policy)
    assert not np.any(again.track.health == DIVERGED)
    # Three times as far is nine times the NIS.
    log.value[: log.n][399:425:2, 0] *= 3.0
    assert np.any(folded(log, baseline, policy).track.health == DIVERGED)


def test_what_is_far_from_lost_changes_nothing(normals):
    assert {normal.nis for normal in normals.values()} == {0.0}
    usual = HealthPolicy().diverged_nis
    assert lost_from({}) == lost_from(normals) == usual
    assert lost_from({"gauge": Normal(0.0, 1.0, 0.0, {}, usual)}) == BASELINE_MARGIN * usual


def test_too_few_readings_have_no_normal():
    fold = folded(asset(0, n=MIN_MEASUREMENTS))
    assert len(commission(fold)) == 3
    fold = folded(asset(0, n=MIN_MEASUREMENTS - 1))
    assert commission(fold) == {}
