"""The screen at the edge: what it refuses, why, and that it depends on the readings and their times alone."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimators.diagnostics.detectors import OUTSIDE, REFUSED, STUCK
from estimators.diagnostics.episodes import episodes
from estimators.errors import ModelError
from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.parts import RATE_NOISE_STDS, Limits, Stuck
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.models import MODELS
from estimators.track import DUPLICATE, MISSING, RANGE, RATE, REPEATED, SATURATED, SCREENED, SUSPECT, USED
from estimators.tuning import Tuning
from tests.models import first_state, first_states, unchanged
from tests.support import SECOND, as_log, folded, measured

BEAT = SECOND // 4
"""Times are multiples of a quarter of a second and values of a quarter of a unit: sums of these are exact."""


def model(a=None, b=None):
    """Two states that walk at random, a sensor of one row and one of two, with a standard deviation of 1/4 each."""
    return StateSpaceModel(
        name="walk",
        title="Walk",
        states=(State("x", "m", std=10.0), State("y", "m", std=10.0)),
        noises=(Noise("x", "m²/s", 0.01), Noise("y", "m²/s", 0.01)),
        sensors=(
            Sensor("a", (Row("a", "m", 1 / 16),), h=first_state, limits=a),
            Sensor("b", (Row("x", "m", 1 / 16), Row("y", "m", 1 / 16)), h=first_states, limits=b),
        ),
        f=unchanged,
        linear=True,
    )


def events(rows, width):
    """Readings from (time in beats, sensor, values)."""
    return Events.concat([Events.one(t * BEAT, t * BEAT, READING, s, y, width) for t, s, y in rows], width)


def entry(values, k):
    return values[k] if len(values) > 1 else values[0]


def plain_screen(limits, rows):
    """The rules as they are written in Limits and Stuck, over whole lists: what came before is looked up each time."""
    verdicts: list[list[int]] = []
    for n, (t, s, y) in enumerate(rows):
        own = limits[s] or Limits()
        before = [k for k in range(n) if rows[k][1] == s and not any(bit & DUPLICATE for bit in verdicts[k])]
        if before:
            then, _, said = rows[before[-1]]
            near = (t - then) * BEAT * 1e-9 <= own.duplicates
            if near and all(a == b or (a != a and b != b) for a, b in zip(y, said, strict=True)):
                verdicts.append([0 if value != value else DUPLICATE for value in y])
                continue
        found = []
        for k, value in enumerate(y):
            bits = 0
            if value == value:
                if own.range and not entry(own.range, k)[0] <= value <= entry(own.range, k)[1]:
                    bits |= RANGE
                if own.saturation and not entry(own.saturation, k)[0] < value < entry(own.saturation, k)[1]:
                    bits |= SATURATED
                if own.rate:
                    kept = [m for m in before if rows[m][2][k] == rows[m][2][k] and verdicts[m][k] == 0]
                    if kept:
                        seconds = (t - rows[kept[-1]][0]) * BEAT * 1e-9
                        most = entry(own.rate, k) * seconds + RATE_NOISE_STDS * 0.25
                        bits |= RATE if abs(value - rows[kept[-1]][2][k]) > most else 0
                if own.stuck and repeats(own.stuck, k, t, value, [rows[m] for m in before]):
                    bits |= REPEATED
            found.append(bits)
        verdicts.append(found)
    return verdicts


def repeats(stuck, k, t, value, before):
    """Whether the run of equal values that ends with this one is too long."""
    told = [(then, y[k]) for then, _, y in before if y[k] == y[k]]
    half = 0.5 * entry(stuck.quantum, k) if stuck.quantum else 0.0
    # A run begins with the first value that is further than half a quantum from the beginning of the one before.
    begin = None
    length = 0
    for then, y in [*told, (t, value)]:
        if begin is None or abs(y - begin[1]) > half:
            begin, length = (then, y), 1
        else:
            length += 1
    if length == 1:
        return False
    if stuck.readings is not None:
        return length >= stuck.readings
    if stuck.seconds is not None:
        return (t - begin[0]) * BEAT * 1e-9 >= stuck.seconds
    sigma = entry(stuck.std, k) if stuck.std else 0.25
    p = math.erf(entry(stuck.quantum, k) / (2 * math.sqrt(2) * sigma))
    elapsed = (t - before[0][0]) * BEAT * 1e-9
    return elapsed > 0.0 and p ** (length - 1) * 86400 * len(before) / elapsed <= 1.0


quarter = st.integers(-12, 12).map(lambda k: k / 4)
value = st.one_of(quarter, quarter, st.just(math.nan), st.sampled_from([-100.0, 100.0]))
pairs = st.lists(st.sampled_from([(-2.0, 2.5), (-1.0, math.inf), (-math.inf, 0.0)]), max_size=2).map(tuple)
# No multiple of these by quarters of a second is a multiple of a quarter, and no power of p is a ratio of days.
rates = st.lists(st.sampled_from([1.03, 0.17]), max_size=2).map(tuple)
stuck = st.one_of(
    st.none(),
    st.builds(Stuck, readings=st.integers(2, 5), quantum=st.sampled_from([(), (0.6,)])),
    st.builds(Stuck, seconds=st.sampled_from([0.6, 2.3]), quantum=st.sampled_from([(), (0.6,), (0.1, 1.1)])),
    st.builds(Stuck, quantum=st.sampled_from([(0.01,), (0.6, 0.02)]), std=st.sampled_from([(), (1.7,)])),
)
limits = st.builds(
    Limits, range=pairs, saturation=pairs, rate=rates, stuck=stuck, duplicates=st.sampled_from([0.0, 0.3, 1.1])
)
single = limits.filter(lambda item: item.flaw(1) is None)
reading = st.one_of(
    st.tuples(st.integers(0, 40), st.just(0), st.tuples(value)),
    st.tuples(st.integers(0, 40), st.just(1), st.tuples(value, value)),
)


@settings(max_examples=300, deadline=None)
@given(
    st.one_of(st.none(), single), st.one_of(st.none(), limits), st.lists(reading, min_size=1, max_size=60), st.data()
)
def test_the_kernel_finds_what_the_rules_say_however_it_is_cut(a, b, rows, data):
    walk = model(a, b)
    log = as_log(events(rows, walk.width))
    ordered = [(int(t) // BEAT, int(s), tuple(y[: s + 1])) for t, s, y in zip(log.t, log.channel, log.events.value)]
    growing = Fold("kf", walk, Tuning.of(walk), log)
    cuts = sorted(data.draw(st.lists(st.integers(0, log.n), max_size=3)))
    for start, stop in zip([0, *cuts], [*cuts, log.n]):
        growing.advance(stop - start)
    expected = plain_screen([a, b], ordered)
    for i, (row, told) in enumerate(zip(expected, growing.track.screened.tolist(), strict=True)):
        assert told == row + [0] * (walk.ny - len(row)), (i, ordered[: i + 1])


STRICT = Limits(
    range=((-30.0, 30.0),), rate=(6.0,), stuck=Stuck(readings=4), duplicates=0.02, saturation=((-25.0, 25.0),)
)


def stream(rng, walk, n):
    """Two sensors of a walk, with spikes, runs of one value, copies, and rows that are missing."""
    t = np.cumsum(rng.integers(1, SECOND // 2, n))
    channel = rng.integers(0, 2, n)
    y = np.round(np.cumsum(rng.normal(0, 0.1, (n, 2)), 0) + rng.normal(0, 0.25, (n, 2)), 1)
    y[rng.random((n, 2)) < 0.05] = 27.0
    y[rng.random((n, 2)) < 0.05] = -90.0
    for begin in rng.integers(0, n - 20, 4):
        y[begin : begin + 20] = y[begin]
    y[rng.random((n, 2)) < 0.05] = np.nan
    y[channel == 0, 1] = np.nan
    value = np.full((n, walk.width), np.nan)
    value[:, :2] = y
    first = Events.alike(READING, t, value, channel)
    again = first.select(rng.permutation(n)[: n // 4])
    later = again._replace(t=again.t + rng.integers(0, SECOND // 50, len(again)))
    return Events.concat([first, later], walk.width)


FILTERS = ["kf", "ukf", "pf", "enkf", "filterpy-kf"]


@pytest.mark.parametrize("name", FILTERS)
def test_a_screened_row_is_to_the_filter_a_row_that_is_missing(name):
    strict, free = model(STRICT, STRICT), model()
    log = as_log(stream(np.random.default_rng(3), strict, 300))
    found = folded(name, strict, log).track
    assert {RANGE, RATE, REPEATED, SATURATED, DUPLICATE} <= {
        1 << k for k in range(5) if np.any(found.screened & (1 << k))
    }
    bare = log.copy()
    bare.value[: log.n, : free.ny][found.screened != 0] = np.nan
    expected = folded(name, free, bare).track
    for column in ("mean", "std", "innovation", "innovation_std", "nis", "log_likelihood"):
        np.testing.assert_array_equal(getattr(found, column), getattr(expected, column), err_msg=column)
    rows = np.isfinite(log.events.value[:, :2]).sum(axis=1)
    lost = (found.screened != 0).sum(axis=1)
    assert np.array_equal(found.verdict == SCREENED, (lost > 0) & (lost == rows))
    assert np.array_equal(expected.verdict == MISSING, (found.verdict == SCREENED) | (found.verdict == MISSING))
    assert np.any((lost > 0) & (found.verdict == USED))


def test_a_fold_from_a_base_knows_what_came_before_it():
    walk = model(STRICT, STRICT)
    log = as_log(stream(np.random.default_rng(5), walk, 3000))
    whole = folded("kf", walk, log)
    at, base = whole.base_at(2500)
    rest = Log.of(walk)
    rest.first, rest.floor = log.first + at, base.clock
    rest.extend(log.events.select(slice(at, log.n)))
    again = folded("kf", walk, rest, base=base)
    assert at > 0
    np.testing.assert_array_equal(again.track.screened, whole.track.screened[at:])
    np.testing.assert_array_equal(again.track.mean, whole.track.mean[at:])


def repeated(times, seconds):
    """Readings of sensor a, once a second, each of them `times` times within `seconds`."""
    rng = np.random.default_rng(11)
    t = np.arange(400) * SECOND
    y = rng.normal(0, 0.25, 400)
    step = round(seconds / times * SECOND)
    rows = [Events.one(int(at) + k * step, 0, READING, 0, [v], 2) for at, v in zip(t, y) for k in range(times)]
    return Events.concat(rows, 2)


@pytest.mark.parametrize(("seconds", "limit"), [(0.0, None), (0.05, Limits(duplicates=0.05))])
def test_a_gateway_that_repeats_everything_makes_the_band_no_narrower(seconds, limit):
    walk = model(limit)
    ends = {}
    for times in (1, 5):
        log = as_log(repeated(times, seconds))
        track = folded("kf", walk, log).track
        ends[times] = track
        assert np.sum(track.screened & DUPLICATE != 0) == 400 * (times - 1)
    first = ends[5].screened[:, 0] == 0
    # The random walk's P + q dt is the same sum in one step or in five, up to rounding.
    np.testing.assert_allclose(ends[5].std[first], ends[1].std, rtol=1e-9)
    np.testing.assert_allclose(ends[5].mean[first], ends[1].mean, rtol=1e-9, atol=1e-12)
    # The copies say nothing for or against the sensor either.
    np.testing.assert_array_equal(ends[5].alarms[first], ends[1].alarms)
    if seconds:
        free = model()
        log = as_log(repeated(5, seconds))
        believed = folded("kf", free, log).track.std[-1, 0] / ends[1].std[-1, 0]
        # A walk's steady P = (√(q² + 4qR) - q) / 2, here with R/5; the copies' 0.04 s add 6 % to P.
        q, r = 0.01, 1 / 16
        of_five, of_one = (math.sqrt(q * q + 4 * q * share) - q for share in (r / 5, r))
        assert believed == pytest.approx(math.sqrt(of_five / of_one), rel=0.03)


def test_a_quantum_alone_speaks_less_than_once_a_day_and_soon_when_stuck():
    sigma, quantum, days = 0.25, 0.25, 8
    walk = model(Limits(stuck=Stuck(quantum=(quantum,))))
    n = days * 86400
    rng = np.random.default_rng(2)
    log = Log.of(walk)
    t = np.arange(n) * SECOND
    # The worst place for what is measured: the middle of a code.
    y = np.round(rng.normal(0, sigma, n) / quantum) * quantum
    y[-60:] = y[-60]
    log.add("a", t * 1e-9, y)
    found = np.flatnonzero(folded("kf", walk, log).track.screened[:, 0])
    begins = found[np.diff(found, prepend=-9) > 1]
    p = math.erf(quantum / (2 * math.sqrt(2) * sigma))
    # A Poisson count of mean `days` at most passes its mean by five standard deviations once in 10⁵.
    assert np.sum(begins < n - 60) <= days + 5 * math.sqrt(days)
    needed = math.ceil(math.log(86400) / -math.log(p))
    assert begins[-1] <= n - 60 + needed and found[-1] == n - 1 and needed < 40


def test_a_sensor_that_is_always_refused_is_lost_and_said_to_be():
    walk = model(Limits(range=((-5.0, 5.0),)))
    log = Log.of(walk)
    t = np.arange(200) * 0.5
    rng = np.random.default_rng(4)
    log.add("a", t, 40 + rng.normal(0, 0.25, 200))
    log.add("b", t, rng.normal(0, 0.25, (200, 2)))
    track = folded("kf", walk, log).track
    of_a = log.events.channel == 0
    assert np.all(track.verdict[of_a] == SCREENED) and np.all(track.verdict[~of_a] == USED)
    assert track.alarms[of_a][-1, 0] & REFUSED and not np.any(track.alarms[~of_a] & REFUSED)


def test_copies_are_no_stuck_sensor():
    walk = model(Limits(duplicates=0.05))
    log = as_log(repeated(5, 0.05))
    assert not np.any(folded("kf", walk, log).track.alarms & STUCK)


@pytest.mark.parametrize("celsius", [0.0, 25.0])
def test_a_battery_outside_the_range_of_its_fit_says_so(celsius):
    cell = MODELS["battery_cell"]
    log = Log.of(cell)
    t = np.arange(600.0)
    log.add_inputs(t, current=np.ones(600), air=np.full(600, celsius))
    log.add("temperature", t, np.full(600, celsius))
    track = folded("ekf", cell, log).track
    outside = track.flags & OUTSIDE != 0
    # The estimate begins at 25 °C and believes the thermometer within seconds.
    assert outside[20:].all() if celsius == 0.0 else not outside.any()
    assert np.all(track.health[outside] >= SUSPECT)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Limits(range=((5.0, 1.0),)), "range is 5 to 1; the first must be below the second"),
        (lambda: Limits(rate=(-1.0,)), "rate is -1; it must be positive"),
        (lambda: Limits(duplicates=-1.0), "duplicates is -1 s; it must be zero or positive"),
        (lambda: Stuck(quantum=(0.0,)), "stuck.quantum is 0; it must be positive"),
        (lambda: Stuck(readings=1), "stuck.readings is 1; it must be 2 or more"),
        (lambda: Stuck(), "stuck gives neither readings nor seconds nor quantum; add one"),
        (lambda: model(Limits(rate=(1.0, 2.0))), "sensor a: rate has 2 entries; give one, or 1, one a row"),
        (lambda: State("x", "m", fitted=(1.0, 1.0)), "state x: fitted is 1 to 1; the first must be below the second"),
        (
            lambda: replace(MODELS["battery_cell"].inputs[0], fitted=(2.0, 1.0)),
            "input current: fitted is 2 to 1; the first must be below the second",
        ),
    ],
)
def test_limits_that_mean_nothing_are_refused(make, said):
    with pytest.raises(ModelError, match=said):
        make()


def test_a_sensor_whose_readings_all_break_their_limits_is_an_episode_of_its_own():
    """Named with the limit and the share, from the first reading that broke it; not as one of a wrong R."""
    walk = model(Limits(range=((-30.0, 30.0),)))
    # As the model has it: of an asset that stands still Q would be too large, which is an episode, too.
    rng, q, r = np.random.default_rng(5), walk.noises[0].variance, walk.sensors[0].rows[0].variance
    y = np.cumsum(rng.normal(0.0, np.sqrt(q), 600)) + rng.normal(0.0, np.sqrt(r), 600)
    y[400:] += 100.0
    log = measured(walk, "a", np.arange(600.0), y)
    found = folded("kf", walk, log)
    each = next(episode for episode in episodes(found) if episode.cause == "screened")
    assert (each.start, each.end, each.size) == (400.0, None, 1.0)
    assert "(range)" in each.text and "100 % of its measurements are not used" in each.text
