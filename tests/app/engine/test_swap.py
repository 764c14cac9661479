"""Any filter that applies to a twin can be swapped for any other while it runs, and the charts are complete after it.

The covering: on the twin to which every filter applies, every ordered pair, as a walk that goes each way between any
two filters once (an Eulerian circuit, in stages); on each other twin that ships, a walk through all filters that apply
to it, at another stride on each. Events come before, during and after each swap. The oracle is a cold fold of the whole
log with that filter: a row looks only at rows before it, so the live track must be its beginning, bit by bit.
"""

import json

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from app.engine.commands import SetEstimator
from app.explore.feed import RerunFeed
from app.scene.view import ViserView
from app.twin.twin import load_twin
from config.loader import shipped
from estimators.diagnostics.considered_shares import considered_pairs
from estimators.diagnostics.references import shown_track
from estimators.log import INPUT, READING, TICK, TRUTH, Events, sorted_order
from estimators.registry import ESTIMATORS, unfit
from tests.app.scripted import Stepped, notice_texts, pull_all
from tests.support import as_log, folded

EVERY_FILTER = "motor_winding"
HUGE = ("thermal_field_large",)
"""A million cells, of which thermal_field is a piece: a walk through its filters takes minutes."""

BEGUN = 40
"""Events before the first swap."""
PACE = 3
"""Events that come with each swap: before it, at once after it, and when it is done."""
STAGE = 60
"""Swaps before an engine with a short history takes over."""
SMALL = {
    **{name: {"particles": 20.0} for name, entry in ESTIMATORS.items() if entry.family == "particle"},
    **{name: {"members": 12.0} for name in ("enkf", "etkf", "ensrf", "letkf", "filterpy-enkf")},
    "ukf": {"alpha": 0.5},
    "ekf": {"adapt": 1.0},
}
"""Options of the twin's `filters:`; with them the states differ in size as much as in kind."""


def small_twin(name, first=None):
    """A twin that ships, whose filters have the options above, and that starts with one of them (or its own)."""
    given = {f"filters.{filter_}": json.dumps(options) for filter_, options in SMALL.items()}
    return load_twin(name, overrides=given | {"estimator": first or load_twin(name).estimator})


def applicable(model):
    return [name for name, entry in ESTIMATORS.items() if unfit(entry, model) is None]


def every_pair(names):
    """A closed walk that takes each ordered pair of names once: Hierholzer's algorithm on the complete digraph."""
    left = {name: [other for other in names if other != name] for name in names}
    stack, walk = [names[0]], []
    while stack:
        if left[stack[-1]]:
            stack.append(left[stack[-1]].pop())
        else:
            walk.append(stack.pop())
    return walk[::-1]


def stages(walk):
    """A closed walk in pieces, each of which begins where the one before ended."""
    return [walk[k : k + STAGE + 1] for k in range(0, len(walk) - 1, STAGE)]


def round_trip(names, stride):
    """A closed walk through all names, `stride` apart (or the next number that reaches all of them)."""
    while np.gcd(stride, len(names)) != 1:
        stride += 1
    return [names[k * stride % len(names)] for k in range(len(names) + 1)]


def asset(model, count, seed=0):
    """What an asset of this model could say: readings of all sensors in turn, inputs, true states, ticks."""
    rng = np.random.default_rng(seed)
    from estimators.compiled.model import compile_model

    compiled = compile_model(model)
    x = model.prior_mean + 0.1 * model.prior_std * rng.standard_normal(model.nx)
    u = model.default_inputs
    p = model.default_parameters
    dt = min(0.5, model.max_step)
    batches, t = [], 0.0
    while sum(map(len, batches)) < count:
        k = len(batches)
        if k % 7 == 3:
            kind, channel, values = TICK, 0, []
        elif k % 7 == 5:
            kind, channel, values = TRUTH, 0, x[: min(32, model.width)]
        elif k % 7 == 6 and model.nu:
            kind, channel, values = INPUT, 0, u
        else:
            t += dt
            ahead = np.empty(model.nx)
            compiled.f(x, u, p, dt, ahead)
            x = ahead
            kind, channel = READING, k % len(model.sensors)
            rows = model.sensors[channel].rows
            values = np.empty(len(rows))
            compiled.h[channel](x, u, p, values)
            values += np.sqrt([row.variance for row in rows]) * rng.standard_normal(len(rows))
        now = round(t * 1e9)
        batches.append(Events.one(now, now, kind, channel, values, model.width))
    events = Events.concat(batches, model.width)
    return events.select(sorted_order(events))


class Running(Stepped):
    """An engine on a bundled twin, with the views of a page and a log that a test feeds it."""

    def __init__(self, twin, count):
        super().__init__(of=twin)
        self.twin = twin
        self.events = asset(twin.model, count)
        self.given = 0
        self.view = ViserView(self.engine, secret="s3cret")
        self.feed = RerunFeed(self.engine)
        self.cold = {}

    def stop(self):
        self.feed.close()
        self.view.stop()

    def give(self, count):
        self.put(self.events.select(slice(self.given, self.given + count)))
        self.given += count

    def swap(self, name):
        """Swap as a browser does it, with measurements before and after."""
        revision = self.status().revision
        self.give(1)
        self.engine.submit(SetEstimator(name))
        self.give(1)
        status = self.status()
        assert (status.revision, status.refolding) == (revision + 1, False)
        self.give(PACE - 2)

    def fold(self, name):
        """The whole log, folded from its start with nothing before."""
        if name not in self.cold:
            log = as_log(self.events)
            tuning = self.twin.tuning.with_options(self.twin.options_of(name))
            pairs = np.concatenate((self.twin.pairs, considered_pairs(self.twin.model)))
            fold = folded(name, self.twin.model, log, tuning, pairs=pairs, policy=self.engine.policy)
            self.cold[name] = fold.track
        return self.cold[name]

    def check(self, name):
        """Engine, status and the left side of the page show this filter over the whole history."""
        pull, status = pull_all(self.engine), self.status()
        assert pull.first == 0
        for column, given in zip(pull.events, self.events.select(slice(0, self.given)), strict=True):
            np.testing.assert_array_equal(column, given)
        for column, a, b in zip(pull.track._fields, pull.track, self.fold(name), strict=True):
            np.testing.assert_array_equal(a, b[: self.given], err_msg=f"{name}: {column}")
        options = ESTIMATORS[name].complete(dict(self.twin.options_of(name)))
        assert options.items() >= SMALL.get(name, {}).items()
        assert (status.estimator, status.options, self.engine.folded_with()[1]) == (name, options, name)
        self.view.frame()
        history = self.view.history
        # What the scene and the chart are drawn from is the end of the track.
        assert history.n and history.base + history.n == self.given
        drawn = shown_track(self.twin.model, pull.track)
        np.testing.assert_array_equal(history.column("mean"), drawn.mean[history.base :])
        assert "engine error" not in status.counts, notice_texts(self.engine)

    def check_rerun(self, tmp_path):
        """The right side has, under the newest recording, each row once."""
        if self.twin.model.grid is not None:
            return  # pictures and a few cells: test_field_views.py
        pieces, revision = [], None
        while messages := self.feed.next():
            for message in messages:
                if isinstance(message, bytes):
                    pieces.append(message)
                else:
                    pieces, revision = [], json.loads(message)["revision"]
        pull, file = pull_all(self.engine), tmp_path / "piece.rrd"
        state = rr.escape_entity_path_part(self.twin.model.shown_states[0].name)
        times, means = [], []
        for piece in pieces:
            file.write_bytes(piece)
            for chunk in RrdReader(str(file)).stream():
                if chunk.entity_path == f"/state/{state}" and not chunk.is_static:
                    batch = chunk.to_record_batch()
                    names = batch.schema.names
                    times += batch.column(names.index("time")).cast(pa.int64()).to_pylist()
                    means += [row[0] for row in batch.column(names.index("Scalars:scalars")).to_pylist()[:]]
        order = np.argsort(times, kind="stable")
        # Of several events at one time, the chart shows the last.
        t = pull.events.t
        shown = np.append(t[1:] != t[:-1], True)
        assert revision == pull.revision
        assert set(np.asarray(times)[order]) == set(t[shown] - (0 if times[0] >= t[0] else t[0]))
        assert means[order[-1]] == pytest.approx(pull.track.mean[-1, 0], rel=1e-6)


@pytest.fixture
def run():
    running = []

    def start(twin, swaps):
        running.append(Running(twin, BEGUN + PACE * (swaps + 1)))
        running[-1].give(BEGUN)
        return running[-1]

    yield start
    for item in running:
        item.stop()


def walk_along(one, walk, tmp_path):
    assert walk[0] == one.twin.estimator
    for name in walk[1:]:
        one.swap(name)
        one.check(name)
    one.check_rerun(tmp_path)


PAIRS = stages(every_pair(list(ESTIMATORS)))


def test_the_pairs_are_all_pairs():
    taken = [pair for stage in PAIRS for pair in zip(stage, stage[1:], strict=False)]
    assert sorted(taken) == sorted((a, b) for a in ESTIMATORS for b in ESTIMATORS if a != b)
    assert applicable(load_twin(EVERY_FILTER).model) == list(ESTIMATORS)


@pytest.mark.parametrize("stage", range(len(PAIRS)))
def test_every_filter_gives_way_to_every_other(stage, run, tmp_path):
    walk = PAIRS[stage]
    walk_along(run(small_twin(EVERY_FILTER, walk[0]), len(walk)), walk, tmp_path)


@pytest.mark.parametrize(("stride", "name"), list(enumerate(sorted(set(shipped()) - {EVERY_FILTER, *HUGE}), start=1)))
def test_every_filter_of_every_twin(stride, name, run, tmp_path):
    twin = small_twin(name)
    names = applicable(twin.model)
    walk = round_trip(names, stride)
    start = walk.index(twin.estimator)
    walk = walk[start:-1] + walk[: start + 1]
    assert set(walk) == set(names)
    walk_along(run(twin, len(walk)), walk, tmp_path)
