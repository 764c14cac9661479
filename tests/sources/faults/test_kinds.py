"""Each kind of fault against its own definition, worked out by hand from the events that went in."""

import numpy as np
import pytest

from estimators.log import INPUT, MARK, READING, Events
from estimators.models import MODELS
from sources.faults.kinds import KINDS, Fault
from sources.faults.layer import Faults, FaultySource
from sources.merged import MemorySource
from tests.support import SECOND, read_all

MODEL = MODELS["motor_drive"]
FIRST, SECOND_ONE = MODEL.sensor_names[:2]
DRIVE = MODEL.input_names[0]
N = 60
START = 1_000


def stream(n=N, step=1.0):
    """Two sensors and all inputs at each of n times from START s on; the values tell which and when."""
    rows = []
    for k in range(n):
        t = round((START + k * step) * SECOND)
        rows.append(Events.one(t, t, INPUT, 0, [100.0 * (i + 1) + k for i in range(len(MODEL.inputs))], MODEL.width))
        rows += [Events.one(t, t, READING, channel, [10.0 * channel + 0.1 * k], MODEL.width) for channel in (0, 1)]
    return Events.concat(rows, MODEL.width)


def through(*faults, events=None, seed=0, batch=7):
    return read_all(FaultySource(MemorySource(stream() if events is None else events, batch=batch),
                                 Faults(MODEL, faults, seed=seed)))  # fmt: skip


def said(events, channel=0, kind=READING, column=0):
    """Times after START in s, arrivals likewise, and values of one channel, in the order in which they came."""
    mine = events.select((events.kind == kind) & (events.channel == channel))
    return (mine.t - START * SECOND) / 1e9, (mine.arrival - START * SECOND) / 1e9, mine.value[:, column]


K = np.arange(N)
Y = 0.1 * K
DURING = (K >= 20) & (K < 40)


def lasting(kind, sensor=FIRST, **more):
    return Fault(kind, sensor, start=20, end=40, **more)


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (lasting("bias", size=2.5), np.where(DURING, Y + 2.5, Y)),
        (lasting("drift", size=0.5), np.where(DURING, Y + 0.5 * (K - 20), Y)),
        (lasting("scale", size=1.1), np.where(DURING, 1.1 * Y, Y)),
        (lasting("stuck"), np.where(DURING, Y[19], Y)),
        (lasting("quantisation", size=0.25), np.where(DURING, np.array([0.25 * round(y / 0.25) for y in Y]), Y)),
        (lasting("dropout"), np.where(DURING, np.nan, Y)),
        (Fault("stuck", None, start=20, end=40), np.where(DURING, Y[19], Y)),
    ],
    ids=lambda item: item.kind if isinstance(item, Fault) else "",
)
def test_a_value_becomes_what_the_kind_says(fault, expected):
    out = through(fault)
    t, arrival, y = said(out)
    np.testing.assert_array_equal(t, K)
    np.testing.assert_array_equal(arrival, K)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-12)
    if fault.sensor is not None:
        np.testing.assert_array_equal(said(out, 1)[2], said(stream(), 1)[2])


def test_noise_and_spikes_have_the_size_and_rate_that_was_asked_for():
    """Standard deviations of n draws lie within 4 standard errors, σ/√(2n); counts within 4 of the binomial's."""
    many = stream(4000)
    y = said(many)[2]
    added = said(through(Fault("noise", FIRST, size=3.0), events=many, batch=500))[2] - y
    assert abs(added.std() / 3.0 - 1.0) < 4 / np.sqrt(2 * y.size)
    assert abs(added.mean()) < 4 * 3.0 / np.sqrt(y.size)
    spikes = said(through(Fault("spike", FIRST, size=30.0, rate=0.1), events=many, batch=500))[2] - y
    hits = spikes[spikes != 0]
    assert abs(hits.size - 400) < 4 * np.sqrt(4000 * 0.1 * 0.9)
    assert abs(hits.std() / 30.0 - 1.0) < 4 / np.sqrt(2 * hits.size)


def test_silence_swallows_and_counts():
    layer = Faults(MODEL, [lasting("silence")])
    out = read_all(FaultySource(MemorySource(stream()), layer))
    t, _, _ = said(out)
    np.testing.assert_array_equal(t, K[~DURING])
    assert layer.lost == 20 and len(said(out, 1)[0]) == N
    whole = through(Fault("silence", start=20, end=40))
    assert not np.any((whole.t >= (START + 20) * SECOND) & (whole.t < (START + 40) * SECOND) & (whole.kind != MARK))


def test_an_input_that_is_lost_stays_as_it_was_told_and_is_told_again_at_the_end():
    out = through(Fault("silence", input=DRIVE, start=20, end=40))
    t, _, u = said(out, 0, INPUT)
    known = ~np.isnan(u)
    np.testing.assert_array_equal(np.unique(t[known]), K[~DURING])
    # At the end the last value that was swallowed comes first, and what is new then takes its place.
    assert set(u[known & (t == 40)]) == {139.0, 140.0}
    if len(MODEL.inputs) > 1:
        np.testing.assert_array_equal(said(out, 0, INPUT, 1)[2][~np.isnan(said(out, 0, INPUT, 1)[2])], 200.0 + K)


def test_an_input_that_is_told_once_is_wrong_from_the_start_of_the_fault_to_its_end():
    told = stream().select(slice(0, None))
    once = told.select((told.kind == READING) | (told.t == START * SECOND))
    t, _, u = said(through(Fault("bias", input=DRIVE, start=20, end=40, size=7.0), events=once), 0, INPUT)
    assert [(a, b) for a, b in zip(t, u)] == [(0.0, 100.0), (20.0, 107.0), (40.0, 100.0)]


def test_a_delayed_reading_comes_when_its_time_has_come_with_its_true_stamp():
    out = through(lasting("delay", size=2.5))
    t, arrival, y = said(out)
    np.testing.assert_array_equal(y, 0.1 * t)
    np.testing.assert_array_equal(arrival, np.where((t >= 20) & (t < 40), t + 2.5, t))
    assert np.all(np.diff(out.arrival[out.kind != MARK]) >= 0)
    assert sorted(t) == list(K) and not np.all(np.diff(t) > 0)


def test_jitter_is_exponential_and_loses_nothing():
    """Mean of n exponential draws within 4 standard errors, mean/√n."""
    t, arrival, _ = said(through(Fault("jitter", FIRST, size=3.0), events=stream(2000), batch=100))
    assert sorted(t) == list(range(2000)) and np.all(np.diff(arrival) >= 0)
    assert abs((arrival - t).mean() - 3.0) < 4 * 3.0 / np.sqrt(2000)
    assert (arrival - t).min() >= 0


def test_bursts_arrive_together():
    t, arrival, _ = said(through(lasting("bursts", every=8.0)))
    during = (t >= 20) & (t < 40)
    # Counted from the start: what is measured at 20 arrives with that of 28, what comes after with that of 36.
    expected = [20 + 8 * max(1, -(-(k - 20) // 8)) for k in t[during].astype(int)]
    np.testing.assert_array_equal(arrival[during], expected)
    np.testing.assert_array_equal(arrival[~during], t[~during])


def test_reorder_swaps_neighbours():
    t, _, y = said(through(lasting("reorder")))
    expected = list(range(20)) + [k for pair in range(20, 40, 2) for k in (pair + 1, pair)] + list(range(40, N))
    np.testing.assert_array_equal(t, expected)
    np.testing.assert_array_equal(y, 0.1 * t)
    last = through(Fault("reorder", FIRST, start=N - 1))
    assert said(last)[0][-1] == N - 1 and len(said(last)[0]) == N


def test_a_duplicate_repeats_the_reading_and_may_move_its_stamp():
    t, arrival, y = said(through(lasting("duplicate", count=4, every=0.1)))
    np.testing.assert_array_equal(np.sort(arrival), arrival)
    expected = sorted([*map(float, K), *(k + 0.1 * copy for k in range(20, 40) for copy in range(1, 5))])
    np.testing.assert_allclose(np.sort(t), expected, atol=1e-9)
    np.testing.assert_allclose(y, 0.1 * np.floor(t + 1e-6), atol=1e-12)
    exact = said(through(lasting("duplicate", count=1)))[0]
    np.testing.assert_array_equal(exact, np.repeat(K, np.where(DURING, 2, 1)))


def test_clocks_jump_and_drift_and_the_arrival_stays():
    t, arrival, y = said(through(lasting("clock_jump", size=-0.25)))
    np.testing.assert_array_equal(arrival, K)
    np.testing.assert_allclose(t, np.where(DURING, K - 0.25, K), atol=1e-9)
    t, arrival, _ = said(through(lasting("clock_drift", size=0.01)))
    np.testing.assert_array_equal(arrival, K)
    np.testing.assert_allclose(t, np.where(DURING, K + 0.01 * (K - 20), K), atol=1e-9)
    # Of one input only that input is stamped wrongly.
    whole = through(Fault("clock_jump", start=20, end=40, size=0.25))
    np.testing.assert_allclose(said(whole, 0, INPUT)[0], np.where(DURING, K + 0.25, K), atol=1e-9)


def test_two_sensors_swap():
    out = through(lasting("swap", other=SECOND_ONE))
    for channel, other in ((0, 1), (1, 0)):
        mine, theirs = said(stream(), channel)[2], said(stream(), other)[2]
        np.testing.assert_array_equal(said(out, channel)[2], np.where(DURING, theirs, mine))


def test_begin_and_end_are_stamped_where_they_hold():
    fault = Fault("bias", SECOND_ONE, start=19.5, end=39.5, size=1.0)
    out = through(fault, Fault("stuck", start=30))
    marks = out.select(out.kind == MARK)
    whole = len(MODEL.sensors) + len(MODEL.inputs)
    code, stuck = KINDS["bias"].code, KINDS["stuck"].code
    assert [
        (t / 1e9 - START, channel, value) for t, channel, value in zip(marks.t, marks.channel, marks.value[:, 0])
    ] == [(20.0, 1, code), (30.0, whole, stuck), (40.0, 1, -code)]
    sent = out.select(out.kind != MARK)
    assert len(sent) == len(stream())


def test_codes_stay():
    """They are in recordings."""
    names = "bias drift scale stuck spike noise quantisation dropout silence delay jitter bursts reorder duplicate "
    assert {name: kind.code for name, kind in KINDS.items()} == {
        name: 1 + k for k, name in enumerate((names + "clock_jump clock_drift swap model").split())
    }


def test_faults_act_one_after_the_other():
    y = said(through(lasting("bias", size=1.0), lasting("scale", size=2.0)))[2]
    np.testing.assert_allclose(y, np.where(DURING, 2.0 * (Y + 1.0), Y), atol=1e-12)
