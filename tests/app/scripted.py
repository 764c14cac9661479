"""Twins, sources and engines for tests of the running twin.

A `Stepped` twin has no threads: what a test puts in is folded, and what it submits is carried out, before the call
returns. A test that needs threads starts an `Engine` and polls with `wait_for`.
"""

import json
import queue
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from app.engine.engine import Engine
from app.twin.defaults import DegradedAfter, Late
from config.schema import ViewSection
from estimators.diagnostics.health import HealthPolicy
from estimators.log import READING, Events
from estimators.models import MODELS
from estimators.tuning import Tuning
from tests.support import SECOND

MODEL = MODELS["motor_winding"]


def solved_by(called):
    """The motor's winding behind a solver, a black box; `called` is given dt whenever it is asked."""

    def f(X, u, p, dt):
        called(dt)
        return X @ np.array([[1.0, dt], [0.0, 1.0]]).T

    sensors = tuple(replace(sensor, h=lambda X, u, p: X[:, :1], H=None) for sensor in MODEL.sensors)
    return replace(MODEL, f=f, F=None, linear=False, sensors=sensors, black_box=True)


def readings(times_s, values):
    """Events of the winding sensor."""
    t = np.round(np.asarray(times_s, float) * SECOND).astype(np.int64)
    return Events.alike(READING, t, np.asarray(values, float))


def events(model, kind, channel, times, values):
    """Events of one channel at times in seconds; `values` (n,) or (n, k)."""
    times = np.asarray(times, float)
    values = np.asarray(values, float).reshape(times.size, -1)
    padded = np.full((times.size, model.width), np.nan)
    padded[:, : values.shape[1]] = values
    t = np.round(times * SECOND).astype(np.int64)
    return Events.alike(kind, t, padded, channel)


def random_walk(n, seed=1, step=0.1):
    """Times (s) and values of n measurements of a random walk at 10 Hz with noise of variance 1."""
    rng = np.random.default_rng(seed)
    return np.arange(1, n + 1) * 0.1, 40 + np.cumsum(rng.normal(size=n)) * step + rng.normal(size=n)


def twin(history=200_000, horizon=2.0, tick=1000.0, model=MODEL, estimator="kf"):
    time = SimpleNamespace(max_delay=horizon, degraded_after=5.0, stale_after=30.0, predict_every=tick)
    parts = {
        "parameters": {},
        "noise": {},
        "sensors": {},
        "inputs": {},
        "source": None,
        "refit": None,
        "view": ViewSection(),
    }
    config = SimpleNamespace(time=time, history=history, **parts)
    return SimpleNamespace(
        options_of=lambda estimator: {},
        name="scripted",
        title="scripted",
        text="model: motor_winding\n",
        forced_baseline="",
        overrides={},
        version=None,
        path=Path("scripted.yaml"),
        model=model,
        tuning=Tuning.of(model),
        estimator=estimator,
        recorded=False,
        maintenance=(),
        unknown_inputs=None,
        late=Late(False, "scripted"),
        degraded=DegradedAfter(time.degraded_after, "scripted"),
        pairs=np.array([[0, 1]]),
        expected=None,
        plan=SimpleNamespace(brings_variances=False, recorded=False),
        config=config,
        policy=HealthPolicy(degraded_after=time.degraded_after, stale_after=time.stale_after),
    )


class Scripted:
    """Hands on the batches that were put into it; None ends it."""

    def __init__(self, live=False):
        self.live = live
        self.batches = queue.Queue()

    def put(self, batch):
        self.batches.put(batch)

    def read(self, timeout):
        try:
            item = self.batches.get(timeout=timeout)
        except queue.Empty:
            return Events.empty(MODEL.width)
        if isinstance(item, Exception):
            raise item
        return item

    def now(self):
        return None

    def close(self):
        pass


class Replayed(Scripted):
    """As a replay, whose time can be held and sought; a test says when it begins again, by `restart`."""

    speed, paused, restarts, span = 1.0, False, 0, None
    beginning = False

    def restart(self):
        self.beginning = True

    def read(self, timeout):
        self.restarts, self.beginning = self.restarts + self.beginning, False
        return super().read(timeout)

    def pause(self):
        pass

    def resume(self):
        pass

    def step(self):
        pass

    def set_speed(self, speed):
        pass

    def seek(self, t):
        pass


class Stepped:
    """An engine without threads, on a scripted source."""

    def __init__(self, n=0, *, source=None, of=None, seed=1, step=0.1, **options):
        """`n` measurements of a random walk are folded at once; `options` are those of `twin`."""
        self.source = source or Scripted()
        self.engine = Engine(of or twin(**options), lambda report: self.source)
        if n:
            self.put(readings(*random_walk(n, seed, step)))

    def put(self, *batches):
        """Fold measurements."""
        for batch in batches:
            self.source.put(batch)
        self.engine.settle()
        return self

    def submit(self, *commands):
        """Carry out commands, and the refolds and jobs that follow from them."""
        for command in commands:
            self.engine.submit(command)
        self.engine.settle()
        return self

    def status(self):
        """A status that is not the cached one."""
        return fresh_status(self.engine)

    def notices(self):
        """Texts of all notices."""
        return notice_texts(self.engine)


def viewed(model, estimator="kf", view=None):
    """An engine without threads for views: `put` folds, and what is submitted is kept in `commands` and carried out."""
    made = twin(model=model, estimator=estimator, horizon=np.inf)
    made.config.view = view or made.config.view
    stepped = Stepped(of=made)
    engine, submit = stepped.engine, stepped.engine.submit
    engine.commands = []

    def put(*batches):
        stepped.put(*batches)
        fresh_status(engine)  # A view takes the kept one

    def carry_out(command):
        engine.commands.append(command)
        submit(command)
        engine.settle()

    engine.put, engine.submit = put, carry_out
    return engine


def notice_texts(engine):
    return [line.text for line in engine.notices.since(0)]


def pull_all(engine):
    """All rows of a running twin, as a consumer that has just come gets them."""
    cursor = engine.cursor()
    pull = engine.pull(cursor)
    engine.release(cursor)
    return pull


def row_count(engine):
    return len(pull_all(engine).events)


def fresh_status(engine):
    """A status that is not the kept one."""
    engine._status = (-np.inf, engine._status[1])
    return engine.status()


def decoded(frame):
    """Header of a frame of a chart stream, its times, s, and columns less their offsets; see `unpack` of stream.js."""
    length = struct.unpack_from("<I", frame)[0]
    head, at = json.loads(frame[4 : 4 + length]), 4 + length
    n, each = head["points"], head["each"]
    seconds, at = np.frombuffer(frame, "<f8", n, at), at + 8 * n
    kept, lines = n // each * head["ends"], head["dots"].count(0)
    edges = iter(np.frombuffer(frame, "<f4", kept * lines, at).reshape(lines, kept))
    at, counts, block = at + 4 * kept * lines, iter(head["counts"]), np.full((len(head["dots"]), n), np.nan)
    for column, dots in zip(block, head["dots"], strict=True):
        if dots:
            count = next(counts)
            column[np.frombuffer(frame, "<u4", count, at)] = np.frombuffer(frame, "<f4", count, at + 4 * count)
            at += 8 * count
        elif each == 1:
            column[:] = next(edges)
        else:
            column[::each], column[each - 1 :: each] = next(edges).reshape(-1, 2).T
    assert at == len(frame)
    return head, seconds, block
