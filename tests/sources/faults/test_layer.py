"""The layer of faults: the same bits in whatever batches, live and replayed alike; injected, ended, begun again."""

import threading

import numpy as np
import pytest

from estimators.errors import SourceError
from estimators.log import MARK, READING, TRUTH, Events
from estimators.models import MODELS
from estimators.numerics.jit import plain
from sources.faults.kinds import KINDS, Fault
from sources.faults.layer import LINGER_NS, Faults, FaultySource
from sources.merged import MemorySource
from sources.pacer import Pacer
from sources.simulator import Simulator
from sources.source import controls_of
from tests.sources.faults.test_kinds import DRIVE, FIRST, MODEL, SECOND_ONE, START, N, said, stream, through
from tests.sources.test_pacer import Clock
from tests.support import SECOND, assert_same, read_all

NUMBERS = {"size": 0.3, "rate": 0.4, "every": 3.0, "count": 2}  # What any kind takes


def some(name, **more):
    """A fault of a kind, on its sensor, its input or its parameter."""
    kind = KINDS[name]
    given = {item.name: NUMBERS[item.name] for item in kind.parameters}
    return Fault(name, FIRST, other=SECOND_ONE if kind.other else None, **given, **more)


OF_EVENTS = [name for name in KINDS if name != "model"]
MIX = [
    *(some(name, start=3.0 * k, end=40.0 + k) for k, name in enumerate(OF_EVENTS)),
    Fault("drift", input=DRIVE, size=0.1, start=5, end=50),
    Fault("jitter", rate=None, size=2.0, start=10, end=30),
    Fault("silence", input=DRIVE, start=33, end=37),
]


class Cut(MemorySource):
    """Gives its events in batches of the given sizes, with empty ones between."""

    def __init__(self, events, ends):
        super().__init__(events)
        bounds = [0, *ends, len(events)]
        self.batches = [events.select(slice(a, b)) for a, b in zip(bounds, bounds[1:])]

    def read(self, timeout):
        return self.batches.pop(0) if self.batches else None


@pytest.mark.parametrize(
    "faults", [[some(name, start=20, end=40)] for name in OF_EVENTS] + [MIX], ids=lambda f: f[0].kind
)
def test_the_batches_do_not_matter(faults):
    events = stream()
    whole = read_all(FaultySource(MemorySource(events, batch=10**6), Faults(MODEL, faults, seed=5)))
    rng = np.random.default_rng(1)
    for size in (1, len(events) // 2, 5, 50):
        ends = np.sort(rng.choice(np.arange(len(events) + 1), size, replace=size > 20)).tolist()
        assert_same(whole, read_all(FaultySource(Cut(events, ends), Faults(MODEL, faults, seed=5))))


@pytest.mark.parametrize("kind", ["spike", "noise", "dropout", "jitter", "reorder", "duplicate"])
def test_a_seed_is_a_draw_of_its_own(kind):
    first, again, other = (through(some(kind), seed=seed) for seed in (1, 1, 2))
    assert_same(first, again)
    assert not all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, other, strict=True))
    own = [through(Fault(**{**vars(some(kind)), "seed": 9}), seed=seed) for seed in (1, 2)]
    assert_same(*own)


def test_nothing_is_lost_that_is_not_counted():
    """Events in, plus repetitions and stamps, are events out, plus those that were swallowed."""
    layer = Faults(MODEL, MIX, seed=3)
    out = read_all(FaultySource(MemorySource(stream(), batch=4), layer))
    bare = Faults(MODEL, [fault for fault in MIX if fault.kind not in ("silence", "duplicate")], seed=3)
    kept = read_all(FaultySource(MemorySource(stream(), batch=4), bare))
    readings = stream().kind == READING
    assert np.sum(kept.kind == READING) == readings.sum()
    assert layer.lost > 0 and np.sum(out.kind == MARK) == 2 * len(MIX)
    assert bare.lost == 0


def test_what_no_fault_is_of_passes_untouched():
    events = stream()
    layer = Faults(MODEL)
    assert_same(events, read_all(FaultySource(MemorySource(events), layer)))
    assert layer.status() == () and layer.lost == 0


class Live:
    """A bus whose clock and events the test moves."""

    live = True

    def __init__(self):
        self.time, self.batches = 0, []

    def put(self, events):
        self.batches.append(events)

    def read(self, timeout):
        return self.batches.pop(0) if self.batches else Events.empty(MODEL.width)

    def now(self):
        return self.time

    def close(self):
        pass


def one(seconds, value=1.0, channel=0):
    return Events.one(round(seconds * SECOND), round(seconds * SECOND), READING, channel, [value], MODEL.width)


def test_a_live_delay_is_let_go_by_the_clock():
    bus = Live()
    source = FaultySource(bus, Faults(MODEL, [Fault("delay", FIRST, size=2.0)]))
    bus.put(one(10.0))
    assert source.read(0.0).kind.tolist() == [MARK]
    bus.time = 12 * SECOND - 1
    assert not len(source.read(0.0))
    bus.time += 1
    late = source.read(0.0)
    assert late.t.tolist() == [10 * SECOND] and late.arrival.tolist() == [12 * SECOND]


def test_an_injected_fault_holds_for_the_next_event_until_it_is_cleared():
    bus = Live()
    layer = Faults(MODEL)
    source = FaultySource(bus, layer)
    assert source.live

    def say(seconds):
        bus.put(one(seconds))
        batch = source.read(0.0)
        return [(t / SECOND, kind, value) for t, kind, value in zip(batch.t, batch.kind, batch.value[:, 0])]

    bias, stuck = KINDS["bias"].code, KINDS["stuck"].code
    assert say(1.0) == [(1.0, READING, 1.0)]
    number = layer.inject(Fault("bias", FIRST, size=2.0))
    assert [item.since for item in layer.status()] == [None]
    assert say(2.0) == [(2.0, MARK, bias), (2.0, READING, 3.0)]
    assert [(item.number, item.touched) for item in layer.status()] == [(number, 1)]
    # A late reading of before the fault is as it was.
    assert say(0.5) == [(0.5, READING, 1.0)]
    short = layer.inject(Fault("stuck", FIRST, end=1.0))
    assert say(2.5) == [(2.5, MARK, stuck), (2.5, READING, 3.0)]
    assert say(3.5) == [(3.5, MARK, -stuck), (3.5, READING, 3.0)]
    assert [item.number for item in layer.status()] == [number] and short == number + 1
    assert layer.clear(number) == 1 and layer.status() == ()
    assert say(4.0) == [(4.0, MARK, -bias), (4.0, READING, 1.0)]
    assert layer.clear() == 0
    with pytest.raises(SourceError, match="there is no fault 7"):
        layer.clear(7)


def test_faults_that_ended_long_ago_cost_nothing_and_what_they_lost_stays_counted():
    events = stream(100)
    layer = Faults(
        MODEL, [Fault("silence", FIRST, start=10, end=20), Fault("reorder", FIRST, start=12, end=20, rate=1.0)]
    )
    source = FaultySource(MemorySource(events, batch=4), layer)
    out = read_all(source)
    assert events.t[-1] - events.t[0] > 20 * SECOND + LINGER_NS
    assert not layer._active and layer.lost == 10
    assert len(out) == len(events) - layer.lost + 4


def test_what_is_kept_back_by_a_fault_that_leaves_comes():
    layer = Faults(MODEL, [Fault("reorder", FIRST, end=5, rate=1.0)])
    source = FaultySource(bus := Live(), layer)
    for seconds, channel in ((1.0, 0), (10.0, 1), (100.0, 1)):
        bus.put(one(seconds, channel=channel))
    out = Events.concat([source.read(0.0) for _ in range(3)], MODEL.width)
    assert sorted(out.t[out.kind == READING].tolist()) == [SECOND, 10 * SECOND, 100 * SECOND] and not layer._active


def test_one_that_was_cleared_before_it_began_leaves_no_trace():
    layer = Faults(MODEL, [Fault("bias", FIRST, size=1.0, start=10)])
    bus = Live()
    source = FaultySource(bus, layer)
    bus.put(one(1.0))
    source.read(0.0)
    assert layer.clear() == 1
    bus.put(one(20.0))
    assert source.read(0.0).value[0, 0] == 1.0


def paced(*faults, **more):
    clock = Clock()
    layer = Faults(MODEL, faults)
    pacer = Pacer(lambda: MemorySource(stream(), batch=10), clock=clock, **more)
    return FaultySource(pacer, layer), layer, clock


def due(source):
    """Times after START of the readings of the first sensor that are due now, with their values."""
    got = []
    while (batch := source.read(0.0)) is not None and len(batch):
        t, _, y = said(batch)
        got += zip(t.tolist(), y.tolist(), strict=True)
    return got


def test_pause_step_and_seek_go_through_to_the_pacer():
    source, _, clock = paced(Fault("bias", FIRST, size=5.0, start=10, end=20))
    assert controls_of(source) is source.inner and not source.live
    assert source.span == (START * SECOND, (START + N - 1) * SECOND) and source.inner.speed == 1.0
    assert due(source) == [(0.0, 0.0)]
    source.inner.pause()
    clock.wait(5)
    assert source.inner.paused and due(source) == []
    source.inner.step()
    assert due(source) == [(1.0, 0.1)]
    source.inner.resume()
    source.inner.seek((START + 12) * SECOND)
    first = due(source)
    np.testing.assert_allclose([y - 0.1 * t for t, y in first], [0.0] * 8 + [5.0] * 3)
    # Back: what was injected and what was scheduled come where they came, with the same bits.
    source.inner.seek((START + 12) * SECOND - 1)
    again = due(source)
    assert source.inner.restarts == 1 and [t for t, _ in again] == [float(k) for k in range(12)]
    assert again[2:] == first[:-1]


def test_an_injected_fault_comes_again_where_it_came_when_the_replay_is_sought_back():
    source, layer, clock = paced()
    source.inner.seek((START + 10) * SECOND)
    due(source)
    layer.inject(Fault("noise", FIRST, size=1.0))
    source.inner.seek((START + 20) * SECOND)
    first = due(source)
    layer.clear()
    source.inner.set_speed(np.inf)
    rest = due(source)
    assert first[0][0] == 11.0 and all(y != 0.1 * t for t, y in first) and all(y == 0.1 * t for t, y in rest)
    source.inner.seek(START * SECOND)
    again = due(source)
    assert again[11:21] == first and again[21:] == rest


def test_a_delay_in_a_replay_comes_late_by_the_replays_own_time():
    source, _, clock = paced(Fault("delay", FIRST, size=0.5, start=1, end=3), speed=2.0)
    due(source)
    clock.wait(0.5)  # one second of the replay
    assert due(source) == []
    clock.wait(0.25)
    assert due(source) == [(1.0, 0.1)]


def test_the_stamps_and_order_of_a_replay_are_those_of_a_fold():
    """As fast as possible, in its own time, and without a pacer: the same events in the same order."""
    whole = read_all(FaultySource(MemorySource(stream(), batch=10), Faults(MODEL, MIX)))
    source, _, clock = paced(*MIX)
    got = []
    while (batch := source.read(0.0)) is not None:
        got.append(batch)
        clock.wait(0.3)
    assert_same(whole, Events.concat(got, MODEL.width))


def test_faults_are_injected_and_cleared_from_other_threads_while_it_is_read():
    layer = Faults(MODEL)
    source = FaultySource(MemorySource(stream(2000), batch=3), layer)
    done = threading.Event()

    def meddle():
        while not done.is_set():
            layer.inject(Fault("bias", FIRST, size=1.0))
            layer.status()
            layer.clear()

    threads = [threading.Thread(target=meddle) for _ in range(2)]
    for thread in threads:
        thread.start()
    out = read_all(source)
    done.set()
    for thread in threads:
        thread.join()
    _, _, y = said(out)
    excess = y - said(stream(2000))[2]
    np.testing.assert_allclose(excess, np.round(excess), atol=1e-9)
    assert y.size == 2000


LORENZ = MODELS["lorenz63"]
PARAMETER = LORENZ.parameters[1].name
STEP = SECOND // 100


def asset(**more):
    return Simulator(LORENZ, seed=2, step=0.01, duration=1.0, **more)


def truth(events):
    return events.value[events.kind == TRUTH]


def test_a_model_change_is_the_asset_with_other_parameters_from_then_on():
    """Until it begins nothing is another; the first step after it differs by what f makes of the other parameter."""
    layer = Faults(LORENZ, [Fault("model", parameter=PARAMETER, size=1.3, start=0.4, end=0.6)])
    changed = asset()
    layer.attach(changed)
    out = read_all(FaultySource(changed, layer))
    x, y = truth(read_all(asset())), truth(out)
    np.testing.assert_array_equal(x[:39], y[:39])
    assert np.all(np.abs(x[39:59] - y[39:59]).max(axis=1) > 0)
    # The noise of the step is the same.
    p = LORENZ.default_parameters
    u = LORENZ.default_inputs
    told = {event: x[38].copy() for event in ("own", "changed")}
    after = {name: np.empty(LORENZ.nx) for name in told}
    for name, factor in (("own", 1.0), ("changed", 1.3)):
        q = p.copy()
        q[1] *= factor
        plain(LORENZ.f)(told[name], u, q, 0.01, after[name])
    np.testing.assert_allclose(y[39] - x[39], after["changed"] - after["own"], rtol=1e-6, atol=1e-12)
    marks = out.select(out.kind == MARK)
    assert marks.t.tolist() == [40 * STEP, 60 * STEP]
    assert marks.channel.tolist() == [len(LORENZ.sensors) + len(LORENZ.inputs)] * 2


def test_a_model_change_that_is_injected_is_stamped_where_it_holds_and_ends_with_a_step():
    layer = Faults(LORENZ)

    def opened():
        changed = asset()
        layer.attach(changed)
        return changed

    clock = Clock()
    source = FaultySource(Pacer(opened, clock=clock), layer)
    assert layer.can_change
    got = []

    def play(seconds):
        clock.wait(seconds)
        while (batch := source.read(0.0)) is not None and len(batch):
            got.append(batch)

    play(0.005)
    layer.inject(Fault("model", parameter=PARAMETER, size=1.3))
    play(0.5)
    # It holds for what the asset had not done yet, and no event is stamped before that.
    (holds,) = layer.status()
    layer.clear()
    play(2.0)
    out = Events.concat(got, LORENZ.width)
    begun, ended = out.t[out.kind == MARK].tolist()
    own = truth(read_all(asset()))
    wrong = np.flatnonzero(np.abs(truth(out) - own).max(axis=1) > 0)
    assert holds.since == begun == (wrong[0] + 1) * STEP and STEP < begun < ended < SECOND
    with pytest.raises(SourceError, match="needs a simulated asset"):
        Faults(LORENZ).inject(Fault("model", parameter=PARAMETER, size=1.3))
