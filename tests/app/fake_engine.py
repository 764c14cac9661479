"""An engine without threads, for the views' tests: readings are put in by hand, commands are carried out at once."""

from __future__ import annotations

import threading
from functools import wraps
from types import SimpleNamespace

import numpy as np

from app.live.commands import Pause, Record, Restore, SetEstimator, SetOption, SetTuning, Speed, UseSensor
from app.live.jobs import Jobs
from app.live.notices import Notices
from app.live.revisions import Revisions
from config.schema import ViewSection
from estimators.diagnostics.episodes import episodes
from estimators.fold import Fold
from estimators.log import Events, Log
from estimators.registry import ESTIMATORS
from estimators.track import TRACKING
from estimators.tuning import Tuning


def atomic(method):
    """The method, of which no other thread sees half: views read while a test puts rows in."""

    @wraps(method)
    def call(self, *arguments, **options):
        with self.lock:
            return method(self, *arguments, **options)

    return call


class FakeEngine:
    def __init__(self, model, estimator="ekf", view=None, carry_out=True):
        self.lock = threading.RLock()
        self.model = model
        tuning = Tuning.of(model)
        config = SimpleNamespace(view=view or ViewSection())
        self.twin = SimpleNamespace(
            model=model,
            name=model.name,
            title=model.title,
            tuning=tuning,
            config=config,
            estimator=estimator,
            recorded=False,
        )
        self.commands = []
        self.carry_out = carry_out
        self.log = Log(model.width)
        self.state = SimpleNamespace(
            estimator=estimator, tuning=tuning, revision=0, refolding=False, speed=1.0, paused=False, recording=None,
            counts={"readings": 0, "gated": 0, "missing": 0, "stale": 0}, t=None, health=TRACKING, since=None,
            cause="", sensors={name: ("tracking", "") for name in model.sensor_names}, episodes_open=0,
            lost=None, model_version=1, clock=None, nis=np.nan, nis_low=np.nan, nis_high=np.nan, latency_ms=0.4,
            seekable=True, span=None, finished=False, options={}, faults=(), integrity=None, awaited=None, compiling={},
        )  # fmt: skip
        self.fold = Fold(estimator, model, tuning, self.log)
        self.before = None
        self.revisions = Revisions(estimator, tuning)
        self.tuning = tuning
        self.notices = []
        self.jobs = Jobs(Notices(lambda: 0))

    @atomic
    def put(self, readings):
        index, _ = self.log.extend(readings)
        self.fold.rewind(index)
        self.fold.advance()
        self.state.t = int(self.log.t[self.log.n - 1])
        self.state.counts["readings"] = self.log.n
        self.changed = min(index, getattr(self, "changed", index))

    @atomic
    def submit(self, command):
        self.commands.append(command)
        if not self.carry_out:
            return
        state = self.state
        if isinstance(command, Restore):
            state.estimator, state.tuning = self.twin.estimator, self.twin.tuning
        elif isinstance(command, SetEstimator):
            state.estimator = command.name
            state.tuning = state.tuning.with_options({})
        elif isinstance(command, SetTuning):
            state.tuning = state.tuning.set(command.key, command.value)
        elif isinstance(command, UseSensor):
            state.tuning = state.tuning.set(f"use.{command.name}", command.used)
        elif isinstance(command, SetOption):
            state.tuning = state.tuning.with_options({**state.tuning.options, command.name: command.value})
        elif isinstance(command, Pause):
            state.paused = command.paused
        elif isinstance(command, Speed):
            state.speed = command.factor
        elif isinstance(command, Record):
            state.recording = command.path
        if isinstance(command, (Restore, SetEstimator, SetTuning, UseSensor, SetOption)):
            self.before = self._pull(0, True)
            self.fold = Fold(state.estimator, self.model, state.tuning, self.log)
            self.fold.advance()
            state.revision += 1

    def release(self, cursor):
        pass

    def status(self):
        self.state.options = ESTIMATORS[self.state.estimator].complete(dict(self.state.tuning.options))
        return self.state

    def cursor(self, *, span=None):
        return SimpleNamespace(n=0, revision=None, told=0)

    @atomic
    def span(self):
        return (int(self.log.t[0]), int(self.log.t[self.log.n - 1])) if self.log.n else (0, 0)

    @atomic
    def index_at(self, t):
        return int(np.searchsorted(self.log.t[: self.log.n], t))

    @atomic
    def rows(self, start, stop):
        return self._pull(start, False, stop)

    @atomic
    def pull(self, cursor, limit=None, *, align=1):
        fresh = cursor.revision != self.state.revision
        changed = 0 if fresh else min(cursor.n, getattr(self, "changed", cursor.n))
        self.changed = self.log.n
        pull = self._pull(changed // align * align, fresh)
        pull.changed = changed
        pull.notices = self.notices[cursor.told :]
        cursor.n, cursor.revision, cursor.told = self.log.n, self.state.revision, len(self.notices)
        return pull

    @atomic
    def episodes(self):
        return episodes(self.fold)

    def previous(self):
        return self.before

    peaks = ()

    @atomic
    def belief(self, t=None):
        """The present one; of an earlier time, which is a row, mean and variances of that row."""
        mean, cov = self.fold.moments()
        if t is not None:
            row = self.fold.track.select(self.index_at(t + 1) - 1)
            mean, cov = row.mean, np.diag(row.std**2)
        return SimpleNamespace(t=self.state.t, mean=mean, cov=cov, points=self.fold.points(), peaks=self.peaks)

    def _pull(self, first, fresh, stop=None):
        rows = slice(first, self.log.n if stop is None else min(stop, self.log.n))
        return SimpleNamespace(
            revision=self.state.revision, fresh=fresh, first=first, events=self.log.events.select(rows),
            track=self.fold.track.select(rows).copy(), notices=[],
            oldest=0, changed=first,
        )  # fmt: skip


def events(model, kind, channel, times, values):
    """Events of one channel at times in seconds; `values` (n,) or (n, k)."""
    times = np.asarray(times, float)
    values = np.asarray(values, float).reshape(times.size, -1)
    padded = np.full((times.size, model.width), np.nan)
    padded[:, : values.shape[1]] = values
    t = np.round(times * 1e9).astype(np.int64)
    return Events(t, t, np.full(t.size, kind, np.int8), np.full(t.size, channel, np.int32), padded)
