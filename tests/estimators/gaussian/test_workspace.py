"""Every Gaussian filter works within the scratch that it asks for, and the older ones ask for no more than they did."""

from typing import Any, NamedTuple

import numpy as np
import pytest

from estimators.fold import Fold
from estimators.log import READING, Events, Log
from estimators.model.state_space import Noise, Row, Sensor, State, StateSpaceModel
from estimators.numerics.jit import inlined, jit
from estimators.numerics.workspace import layout, size_of, start_of, take_matrix, take_vector
from estimators.registry import ESTIMATORS
from estimators.tuning import Tuning
from tests.support import SECOND

NAMES = [name for name, entry in ESTIMATORS.items() if entry.family == "Gaussian"]
SIZES = [(1, 4), (2, 1), (5, 9), (9, 3), (17, 5)]
OPTIONS = [{}, {"joseph": 0}, {"robust": 1}, {"robust": 2, "adapt": 1}, {"adapt": 2, "inflation": 1.1}]


def f(x, u, p, dt, out):
    n = x.size
    for i in range(n):
        out[i] = x[i] + 0.1 * dt * (x[(i + 1) % n] - x[i])


def h(x, u, p, out):
    for i in range(out.size):
        out[i] = x[i % x.size] + 0.1 * i * x[0]


def last(x, u, p, out):
    out[0] = x[x.size - 1]


def f_by_abs(x, u, p, dt, out):
    """Not analytic: its Jacobian is found by central differences."""
    n = x.size
    for i in range(n):
        out[i] = x[i] + 0.1 * dt * (abs(x[(i + 1) % n]) - x[i])


def h_by_abs(x, u, p, out):
    for i in range(out.size):
        out[i] = abs(x[i % x.size]) + 0.1 * i * x[0]


def ring(n, m, *, linear, sensors):
    correlation = 0.3 + 0.7 * np.eye(m) if m > 2 else None
    rows = tuple(Row(f"y{i}", "m", variance=0.5 + i) for i in range(m))
    many = Sensor("many", rows, h=h if linear else h_by_abs, correlation=correlation)
    one = Sensor("one", (Row("y", "m", variance=0.3),), h=last)
    return StateSpaceModel(
        name="ring",
        title="states in a ring",
        states=tuple(State(f"x{i}", "m", mean=1.0 + i, std=1.0) for i in range(n)),
        noises=tuple(Noise(f"x{i}", "m²/s", variance=0.1) for i in range(n)),
        sensors=(many, one)[:sensors],
        f=f if linear else f_by_abs,
        linear=linear,
    )


def readings(model, rng):
    """Twelve readings, all rows, some, or none of them there."""
    log, batch = Log(model.width), []
    for k in range(12):
        sensor = k % len(model.sensors)
        y = rng.normal(2.0, 1.0, len(model.sensors[sensor].rows))
        y[rng.random(y.size) < 0.3 * (k % 3)] = np.nan
        batch.append(Events.one(k * SECOND, k * SECOND, READING, sensor, y, model.width))
    log.extend(Events.concat(batch, model.width))
    return log


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_nothing_is_written_beyond_the_scratch(name, n, m):
    entry = ESTIMATORS[name]
    model = ring(n, m, linear=name in ("kf", "kf-steady", "sr-kf"), sensors=1 if name == "kf-steady" else 2)
    known = {option.name for option in entry.options}
    for options in OPTIONS:
        if not set(options) <= known:
            continue
        log = readings(model, np.random.default_rng([n, m]))
        fold = Fold(name, model, Tuning.of(model).with_options(options), log)
        size = entry.work_size(fold.options, n, model.width)
        # The width of the log may be that of the state; the update takes what its own rows need.
        own = entry.work_size(fold.options, n, model.ny)
        for room in {size, own}:
            guarded = np.frombuffer(np.full(room + 128, 0x7FF8_DEAD_BEEF_CAFE, np.uint64).tobytes()).copy()
            plain = Fold(name, model, Tuning.of(model).with_options(options), log)
            fold = Fold(name, model, Tuning.of(model).with_options(options), log)
            fold.machine.work = guarded[64 : 64 + room]
            fold.advance()
            plain.advance()
            guards = np.concatenate((guarded[:64], guarded[64 + room :])).view(np.uint64)
            assert np.all(guards == 0x7FF8_DEAD_BEEF_CAFE), f"{options}: {np.flatnonzero(guards != guards[0])}"
            assert np.all(np.isfinite(fold.track.mean)), options
            # What is in the scratch at first is of no matter.
            np.testing.assert_array_equal(fold.track.mean, plain.track.mean)


class Views(NamedTuple):
    a: Any
    b: Any
    end: int


@layout
def views(at, n):
    a, at = take_vector(at, n)
    b, at = take_matrix(at, n, 2)
    return Views(a, b, at)


class Nested(NamedTuple):
    views: Views
    c: Any
    end: int


@layout
def nested(at, n):
    inner = views(at, n)
    c, at = take_vector(inner.end, 1)
    return Nested(inner, c, at)


@inlined
def put(own, value):
    own.c[0] = value


@jit
def write(work, n):
    """Writes through fields that nothing reads again: taken for dead code where Numba inlines an overload."""
    own = nested(start_of(work), n)
    put(own, 3.0)
    own.views.a[0] = 1.0
    own.views.b[n - 1, 1] = 2.0


@pytest.mark.parametrize("n", [1, 4])
def test_a_write_through_a_field_is_kept(n):
    work = np.zeros(3 * n + 2)
    write(work, n)
    assert size_of(nested, n) == 3 * n + 1
    assert work[0] == 1.0 and work[3 * n - 1] == 2.0 and work[3 * n] == 3.0 and np.count_nonzero(work) == 3
