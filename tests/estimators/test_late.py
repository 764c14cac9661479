"""Late readings that are used when they come: R and times against what the model gives by hand."""

import numpy as np
import pytest

from estimators.fold import Fold, fold
from estimators.late import inflated, moved_variance, rewind_seconds
from estimators.log import READING, TICK, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.tuning import Tuning
from tests.models import constant_speed
from tests.support import SECOND, as_log, assert_same
from tests.support import folded as advanced


def place(x, u, p, out):
    out[0] = 2.0 * x[0]


def bearing(x, u, p, out):
    out[0] = (x[0] + np.pi) % (2.0 * np.pi) - np.pi


MODEL = StateSpaceModel(
    name="mover",
    title="constant speed",
    states=(State("place", "m", 3.0, 1.0), State("speed", "m/s", 0.5, 0.1)),
    noises=(Noise("place", "m²/s", 0.04), Noise("speed", "(m/s)²/s", 0.01)),
    sensors=(
        Sensor("twice", (Row("twice", "m", 0.3),), h=place),
        Sensor("angle", (Row("angle", "rad", 0.3, circular=True),), h=bearing),
    ),
    f=constant_speed,
)
HORIZON = 5 * SECOND


def reading(seconds, value, sensor=0, own=()):
    t = round(seconds * SECOND)
    values = np.full(MODEL.width + len(own), np.nan)
    values[0], values[MODEL.width :] = value, own
    return Events.one(t, t, READING, sensor, values, values.size)


def folded(*events):
    log = as_log(Events.concat(list(events), MODEL.width))
    return log, advanced("ekf", MODEL, log)


@pytest.mark.parametrize("delay", [0.1, 1.0, 4.0])
def test_what_a_reading_moves_by_is_speed_and_noise(delay):
    """h = 2 x moves by 2 v delay, and H Q Hᵀ = 4 q delay."""
    _, made = folded(reading(1.0, 6.0), reading(2.0, 7.1))
    speed = made.moments()[0][1]
    expected = (2.0 * speed * delay) ** 2 + 4.0 * 0.04 * delay
    np.testing.assert_allclose(moved_variance(made, 0, delay), [expected], rtol=1e-6)


def test_an_angle_moves_the_shorter_way_round():
    """At 3 + 0.5 delay the angle has gone past π: not by 2 π."""
    _, made = folded(reading(1.0, 6.2))
    mean = made.moments()[0]
    expected = mean[1] ** 2 + 0.04
    assert mean[0] < np.pi < mean[0] + mean[1]
    np.testing.assert_allclose(moved_variance(made, 1, 1.0), [expected], rtol=1e-5)


def test_a_late_reading_is_the_newest_with_its_own_variance():
    log, made = folded(reading(1.0, 6.0), reading(2.0, 7.1))
    batch = Events.concat([reading(2.5, 7.5), reading(1.5, 6.5), reading(3.0, 8.0, sensor=1)], MODEL.width)
    extra = moved_variance(made, 0, 1.0)
    out, count = inflated(batch, made, log.newest, HORIZON)
    assert count == 1
    assert out.t.tolist() == [2_500_000_000, 2_500_000_001, 3_000_000_000]
    np.testing.assert_allclose(out.value[1, MODEL.width], 0.3 + extra[0])
    assert np.isnan(out.value[[0, 2], MODEL.width :]).all()
    # Nothing that was folded is folded again.
    index, stale = log.extend(out, HORIZON)
    assert (index, stale) == (2, 0)


def test_it_adds_to_the_variance_that_a_reading_brings():
    log, made = folded(reading(1.0, 6.0), reading(2.0, 7.1))
    out, _ = inflated(reading(1.5, 6.5, own=(1.7,)), made, log.newest, HORIZON)
    np.testing.assert_allclose(out.value[0, MODEL.width], 1.7 + moved_variance(made, 0, 0.5)[0])


def test_what_is_in_time_or_stale_is_left_alone():
    log, made = folded(reading(1.0, 6.0), reading(20.0, 7.1))
    for batch in (
        reading(20.0, 7.0),
        reading(21.0, 7.0),
        reading(14.9, 7.0),
        Events.one(19 * SECOND, 0, TICK, 0, [], MODEL.width),
    ):
        out, count = inflated(batch, made, log.newest, HORIZON)
        assert out is batch and count == 0


def test_the_log_folds_again_to_the_same():
    log, made = folded(reading(1.0, 6.0), reading(2.0, 7.1))
    out, _ = inflated(reading(1.5, 6.5), made, log.newest, HORIZON)
    index, _ = log.extend(out)
    made.rewind(index)
    made.advance()
    assert_same(made.track, fold("ekf", MODEL, Tuning.of(MODEL), log))


def test_late_readings_now_and_then_leave_the_bands_true():
    """One in five comes a second late. The share in the 95 % band is that of the filter that goes back, within three
    deviations of independent trials (runs of 60 are correlated over some seconds: a tenth of the rows count)."""
    rng = np.random.default_rng(11)
    hits = {True: 0, False: 0}
    total = 0
    for _ in range(40):
        x = np.array([rng.normal(3.0, 1.0), rng.normal(0.5, 0.1)])
        logs = {how: Log.of(MODEL) for how in hits}
        folds = {how: Fold("ekf", MODEL, Tuning.of(MODEL), log) for how, log in logs.items()}
        waiting = []
        for k in range(1, 60):
            x = np.array([x[0] + x[1] + rng.normal(0, 0.2), x[1] + rng.normal(0, 0.1)])
            new = [reading(float(k), 2 * x[0] + rng.normal(0, np.sqrt(0.3)))]
            tick = Events.one(k * SECOND, k * SECOND, TICK, 0, [], MODEL.width)
            late = rng.random() < 0.2
            batch = Events.concat([*([] if late else new), *waiting, tick], MODEL.width)
            waiting = new if late else []
            total += 1
            for inflate, log in logs.items():
                made = folds[inflate]
                index, _ = log.extend(inflated(batch, made, log.newest, HORIZON)[0] if inflate else batch)
                made.rewind(index)
                made.advance()
                row = made.n - 1
                hits[inflate] += abs(made.track.mean[row, 0] - x[0]) <= 1.96 * made.track.std[row, 0]
    deviation = np.sqrt(0.95 * 0.05 / (total / 10))
    assert abs(hits[False] / total - 0.95) < 3 * deviation
    assert abs(hits[True] / total - 0.95) < 3 * deviation


def test_the_arithmetic_is_events_times_numbers():
    assert rewind_seconds(50_000_000, 1) == pytest.approx(2.5)
