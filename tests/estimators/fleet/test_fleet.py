"""Fleets against single folds: every asset has the bits of a `Fold` over its own log."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from estimators import MODELS, HealthPolicy, Log, Tuning
from estimators.diagnostics.detector_state import no_baseline
from estimators.errors import EstimatorError, EventError
from estimators.fleet.fleet import Fleet
from estimators.fold import Fold
from estimators.log import READING, TRUTH, Events
from estimators.model.state_space import Parameter
from estimators.track import GATED, HEALTH_NAMES
from tests.cases import cases
from tests.models import level_model
from tests.support import error_of, folded, measured

POLICY = HealthPolicy(window=12, degraded_after=40.0, stale_after=90.0, corrections=0)
"""A window short enough that it is full, and slides, in the logs of these tests."""


def gated(model, **fields):
    return replace(Tuning.of(model), gate=0.99, reopen=None, **fields)


def assert_same(fleet: Fleet, position: int, fold: Fold) -> None:
    """Assert that an asset has the state, verdict, window, detectors and health of a fold, to the last bit."""
    table, base, wanted = fleet.table(), fleet.base(position), fold.base_here()
    assert table.events[position] == fold.n == base.first
    for name in ("state", "evidence", "edge", "doubt", "u", "mean", "cov"):
        assert getattr(base, name).tobytes() == getattr(wanted, name).tobytes(), (position, name)
    assert base.clock == wanted.clock
    last = fold.track.select(fold.n - 1)
    for name in ("mean", "std", "verdict", "health", "age", "nis_mean", "nis_low", "nis_high"):
        got = np.asarray(getattr(table, name)[position])
        assert got.tobytes() == np.asarray(getattr(last, name)).tobytes(), (position, name, got, getattr(last, name))
    others = np.flatnonzero(fold.track.health != last.health)
    assert table.since[position] == fold.log.t[others[-1] + 1 if others.size else 0] * 1e-9


def random_events(model, rng, count):
    """Return (seconds, sensor or None for inputs or "tick", values) of one asset, in the order of time."""
    names, t, found = model.sensor_names, 0.0, []
    silent = rng.choice([*names, "none"])
    bias = rng.choice([0.0, 0.0, 6.0])
    for k in range(count):
        t += float(rng.choice([0.0, 0.1, 0.1, 0.1, 0.1, 7.0], p=[0.1, 0.25, 0.25, 0.25, 0.1, 0.05]))
        kind = rng.random()
        if kind < 0.08:
            found.append((t, "tick", None))
        elif kind < 0.25 and model.nu:
            found.append((t, None, rng.normal(size=model.nu)))
        else:
            name = str(rng.choice(names))
            if name == silent and k > count // 2 and len(names) > 1:
                continue
            sensor = model.sensors[names.index(name)]
            std = np.sqrt([row.variance for row in sensor.rows])
            y = 20.0 + std * (rng.normal(size=len(std)) + (bias if k > count // 2 else 0.0))
            y[rng.random(len(std)) < 0.05] = np.nan
            y += std * 30.0 * (rng.random(len(std)) < 0.05)
            found.append((t, name, y))
    return found


def shuffled(events, rng, most):
    """Return the events in an order of arrival in which at most `most` come before one that belongs earlier."""
    keys = np.arange(len(events)) + rng.integers(0, most + 1, len(events)) * (rng.random(len(events)) < 0.3)
    return [events[k] for k in np.lexsort((np.arange(len(events)), keys))]


def add(target, event, *asset):
    t, what, values = event
    if what == "tick":
        target.add_ticks(t, *asset)
    elif what is None:
        names = [item.name for item in target.model.inputs]
        target.add_inputs(*asset, t, **dict(zip(names, values, strict=True)))
    else:
        target.add(what, *asset, t, values)


def take(fleet, logs, arriving, a, count):
    """Hand an asset's next events to the fleet and to its own log."""
    for event in arriving[a][:count]:
        add(fleet, event, a)
        add(logs[a], event)
    del arriving[a][:count]


@cases(__file__, "gated_fleets.csv")
@pytest.mark.parametrize("threads", [1, 3])
def test_fleet_of_random_assets_has_the_bits_of_single_folds(estimator, name, gate, threads):
    model = MODELS[name]
    rng = np.random.default_rng(7 + threads)
    tunings = [gated(model, gate_kind=gate) if gate else Tuning.of(model)] * 12
    tunings[5] = replace(tunings[0], r=tunings[0].r * 2.0)
    baseline = no_baseline(model)
    baseline[:, :3] = 0.3, 1.2, 0.2  # bias, scale and correlation: sums of the expected NIS have rounding
    tunings[7] = replace(tunings[0], baseline=baseline)
    fleet = Fleet(estimator, model, tunings, assets=12, policy=POLICY, recent=4, threads=threads)
    logs = [Log.of(model) for _ in tunings]
    arriving = [shuffled(random_events(model, rng, int(rng.integers(1, 150))), rng, 4) for _ in tunings]
    verdicts: set[int] = set()
    while any(arriving):
        for a in rng.permutation(12):
            take(fleet, logs, arriving, a, int(rng.choice([0, 1, 1, 2, 9])))
        fleet.advance()
        if rng.random() < 0.2 or not any(arriving):
            for a, log in enumerate(logs):
                if log.n:
                    fold = folded(estimator, model, log, tunings[a], policy=POLICY)
                    assert_same(fleet, a, fold)
                    verdicts |= set(fold.track.verdict.tolist())
    assert fleet.table().stale.sum() == 0
    assert (GATED in verdicts) == (gate == "hard")


def faulty_events(model, rng, count):
    """Return random events with runs of rejections: one sensor is off for a time, and all of them for another."""
    events = random_events(model, rng, count)
    begin, length = int(rng.integers(5, count // 2)), int(rng.integers(5, count))
    off, all_off = str(rng.choice(model.sensor_names)), rng.random() < 0.4
    shift = float(rng.choice([50.0, 400.0]))
    return [
        (t, what, values + shift)
        if what in model.sensor_names and begin <= k < begin + length and (all_off or what == off)
        else (t, what, values)
        for k, (t, what, values) in enumerate(events)
    ]


@pytest.mark.parametrize(
    ("estimator", "name", "kind", "recent"),
    [("kf", "motor_winding", "hard", 4), ("ekf", "motor_drive", "hard", 1), ("ekf", "motor_drive", "soft", 4)],
)
@pytest.mark.parametrize("threads", [1, 3])
def test_decisions_on_rejected_sensors_are_those_of_single_folds(estimator, name, kind, recent, threads):
    model, rng, count = MODELS[name], np.random.default_rng(17 + threads), 7
    tunings = [replace(Tuning.of(model), gate=0.99, gate_kind=kind, reopen=4.0)] * count
    tunings[3] = replace(tunings[0], gate=0.999, reopen=30.0)
    tunings[4] = replace(tunings[0], gate=None)
    fleet = Fleet(estimator, model, tunings, assets=count, policy=POLICY, recent=recent, threads=threads)
    logs = [Log.of(model) for _ in tunings]
    # The longest is longer than a record.
    lengths = [*rng.integers(60, 400, count - 1), 1600 if estimator == "ekf" else 200]
    arriving = [shuffled(faulty_events(model, rng, int(length)), rng, recent) for length in lengths]
    outcomes: set[str] = set()
    while any(arriving):
        for a in range(count):
            take(fleet, logs, arriving, a, int(rng.choice([0, 1, 2, 9, 60])))
        fleet.advance()
        if rng.random() < 0.1 and threads > 1:
            former, fleet = fleet, Fleet(estimator, model, tunings, assets=count, policy=POLICY, recent=recent)
            for part in (slice(0, 3), slice(3, count)):
                fleet.restore(part.start, former.state(part))
    for a, log in enumerate(logs):
        fold = folded(estimator, model, log, tunings[a], policy=POLICY)
        assert_same(fleet, a, fold)
        # The state of a fleet has what the next decisions need, not those that were taken.
        assert threads > 1 or str(fleet.decisions(a)) == str(fold.decisions[-64:])
        outcomes |= {each.outcome for each in fold.decisions}
    assert fleet.table().stale.sum() == 0
    assert {"isolated", "doubted"} <= outcomes and {"believed", "reopened"} & outcomes


def test_records_of_rejections_that_are_over_are_given_back():
    """Those of all assets at once, which are more than a thread keeps for the next ones."""
    model, count = MODELS["motor_winding"], 300
    tuning = replace(Tuning.of(model), gate=0.99, gate_kind="hard", reopen=4.0)
    fleet = Fleet("kf", model, tuning, assets=count, policy=POLICY, recent=4, threads=1)
    sizes = [len(fleet.state(slice(None)))]
    for k in range(80):
        values = np.full(count, 1e4 if 20 <= k < 23 else 30.0)
        fleet.add("winding", np.arange(count), np.full(count, 0.5 * k), values)
        fleet.advance()
        sizes.append(len(fleet.state(slice(None))))
    assert max(sizes) > sizes[0]
    assert sizes[-1] == sizes[0]


def decay(x, u, p, dt, out):
    out[0] = x[0] * (1.0 - p[0] * dt)


def test_assets_of_other_parameters_share_nothing():
    # kf keeps F of the last dt in its scratch, which the next asset of the same thread uses.
    model = level_model(
        {"gauge": 1.0}, 0.1, mean=5.0, f=decay, linear=True, parameters=(Parameter("rate", "1/s", 0.1, 0.0, 1.0),)
    )
    tunings = [Tuning.of(model).set("p.rate", rate) for rate in (0.1, 0.5, 0.9)]
    fleet = Fleet("kf", model, tunings, assets=3, threads=1)
    t, y = np.arange(20.0), np.sin(np.arange(20.0))
    fleet.add("gauge", np.repeat(np.arange(3), 20), np.tile(t, 3), np.tile(y, 3))
    fleet.advance()
    for a, tuning in enumerate(tunings):
        log = measured(model, "gauge", t, y)
        fold = folded("kf", model, log, tuning, policy=fleet.policy)
        assert_same(fleet, a, fold)


@pytest.mark.parametrize("recent", [0, 4])
@pytest.mark.parametrize(("estimator", "name"), [("kf", "decay"), ("ekf", "motor_drive")])
def test_values_of_each_asset_are_those_of_a_tuning_of_its_own(estimator, name, recent):
    rng, count = np.random.default_rng(3), 9
    model = MODELS.get(name) or level_model(
        {"gauge": 1.0}, 0.1, mean=5.0, f=decay, linear=True, parameters=(Parameter("rate", "1/s", 0.1, 0.0, 1.0),)
    )
    base = replace(Tuning.of(model), gate=0.99, reopen=4.0 if recent else None)
    items = [item for item in base.items() if item.value > 0.0]
    values = {item.key: item.value * (1.0 + 0.5 * rng.random(count)) for item in items}
    for column in values.values():
        column[2] = np.nan  # the shared value
    tunings = [base] * count
    for item in items:
        values[item.key] = np.minimum(values[item.key], item.high)
        for a, value in enumerate(values[item.key]):
            tunings[a] = tunings[a] if np.isnan(value) else tunings[a].set(item.key, value)
    early = {key: column[:6] for key, column in values.items()}
    fleet = Fleet(estimator, model, base, assets=6, values=early, policy=POLICY, recent=recent, threads=2)
    fleet.extend(2, {key: column[6:8] for key, column in values.items()})
    fleet.extend(1)
    tunings[8] = base
    logs = [Log.of(model) for _ in tunings]
    for a, log in enumerate(logs):
        for event in faulty_events(model, rng, 150):
            add(fleet, event, a)
            add(log, event)
        fleet.advance()
    for a, log in enumerate(logs):
        fold = folded(estimator, model, log, tunings[a], policy=POLICY)
        assert_same(fleet, a, fold)
        assert bool(fleet.decisions(a)) == bool(fold.decisions)


def test_without_recent_events_late_ones_are_dropped_and_an_asset_is_half_as_large():
    model = MODELS["motor_drive"]
    small, large = (Fleet("ekf", model, assets=2, recent=recent) for recent in (0, 8))
    for target in (small, large):
        target.add(model.sensor_names[0], 1, [1.0, 2.0, 4.0], [1.0, 2.0, 3.0])
        target.advance()
        target.add(model.sensor_names[0], 1, [3.0, 5.0], [1.0, 2.0])
        target.advance()
    assert small.table().stale.tolist() == [0, 1] and large.table().stale.tolist() == [0, 0]
    assert small.table().events[1] == 4 and small.nbytes < 0.5 * large.nbytes


def test_a_new_asset_begins_from_the_spread_of_its_siblings():
    model, rng = MODELS["motor_winding"], np.random.default_rng(2)
    fleet, levels = Fleet("kf", model, assets=40), 40.0 + 3.0 * rng.normal(size=40)
    t, state = np.tile(np.arange(60.0), 40), model.shown_states[0].name
    fleet.add("winding", np.repeat(np.arange(40), 60), t, np.repeat(levels, 60) + 0.1 * rng.normal(size=2400))
    fleet.advance()
    mean, cov = fleet.sibling_prior(state)
    # Standard errors of a median and of a median deviation of 40 values.
    assert abs(mean[0] - 40.0) < 4 * 1.25 * 3.0 / 40**0.5 and abs(cov[0, 0] ** 0.5 - 3.0) < 4 * 1.17 * 3.0 / 40**0.5
    with pytest.raises(EstimatorError, match="asset 3 has events"):
        fleet.set_prior([3], (mean, cov))
    with pytest.raises(EstimatorError, match="no state 'windng'"):
        fleet.sibling_prior("windng")
    fleet.extend(2)
    fleet.set_prior([41], (mean, cov))
    log = Log.of(model)
    for target, asset in ((fleet, [41]), (log, [])):
        target.add("winding", *asset, [1.0, 2.0, 3.0], [38.0, 39.0, 38.5])
    fleet.add("winding", 40, 1.0, 38.0)
    fleet.advance()
    fold = folded("kf", model, log, prior=(mean, cov), policy=fleet.policy)
    assert_same(fleet, 41, fold)
    alone = Fold("kf", model, Tuning.of(model), Log.of(model))
    assert fold.track.mean[0].tobytes() != alone.prior[0].tobytes() and fleet.table().events[40] == 1


def test_measurements_too_old_to_count_leave_the_window():
    model, policy = MODELS["motor_winding"], POLICY._replace(window=2)
    fleet, log = Fleet("kf", model, assets=1, policy=policy), Log.of(model)
    # The window spans 40 events, and the last measurement of the first batch is 40 before that of the second.
    for seconds in (np.arange(10.0), np.array([20.0])):
        for target, asset in ((fleet, [0]), (log, [])):
            target.add("winding", *asset, seconds, 40.0 + np.sin(seconds))
            target.add_ticks(np.linspace(seconds[-1] + 0.1, seconds[-1] + 1.0, 39))
        fleet.advance()
        fold = folded("kf", model, log, policy=policy)
        assert_same(fleet, 0, fold)
    assert fold.track.nis_mean[-1] == fold.track.nis[-40]


def test_a_fleet_that_is_extended_has_the_bits_of_one_that_was_as_large_from_the_start():
    model, rng = MODELS["motor_winding"], np.random.default_rng(5)
    grown, whole = Fleet("kf", model, assets=2, recent=3), Fleet("kf", model, assets=7, recent=3)
    for round_ in range(3):
        at, t = rng.integers(0, len(grown.assets), 40), 1.7e9 + np.sort(rng.random(40)) * 20.0 + 20.0 * round_
        ns = np.rint(t * 1e9).astype(np.int64)
        y = 40.0 + rng.normal(size=(40, 1))
        events = Events.alike(READING, ns, y)
        whole.add("winding", at, t, y)
        grown.add_events(at, events)
        whole.advance()
        grown.advance()
        if round_ < 2:
            grown.extend([1, 4][round_])
    assert grown.assets == whole.assets == range(7)
    for mine, its in zip(grown.table()[1:], whole.table()[1:], strict=True):
        assert mine.tobytes() == its.tobytes()
    named = Fleet("kf", model, assets=["a"])
    named.extend(["b"])
    named.add("winding", "b", 1.0, 40.0)
    assert named.advance() == 1 and named.table().events.tolist() == [0, 1]


def test_true_states_are_not_added():
    model = MODELS["motor_winding"]
    fleet, t = Fleet("kf", model, assets=1), np.array([1, 2], np.int64)
    events = Events(t, t, np.array([TRUTH, READING], np.int8), np.zeros(2, np.int32), np.full((2, model.width), 40.0))
    fleet.add_events([0, 0], events)
    assert fleet.advance() == 1


def test_an_event_before_the_oldest_snapshot_is_stale_and_changes_nothing():
    model = MODELS["motor_winding"]
    fleet = Fleet("kf", model, assets=["a", "b"], recent=3)
    fleet.add("winding", "a", np.arange(1.0, 11.0), np.full(10, 40.0))
    fleet.advance()
    before = fleet.base("a").state.tobytes()
    fleet.add("winding", "a", 5.5, 90.0)  # 10 events: snapshots before the 7th (7 s) and the 10th; the 6th is kept
    fleet.advance()
    table = fleet.table()
    assert table.stale.tolist() == [1, 0] and table.events.tolist() == [10, 0]
    assert fleet.base("a").state.tobytes() == before
    fleet.add("winding", "a", 6.5, 40.0)
    fleet.advance()
    assert fleet.table().stale.tolist() == [1, 0] and fleet.table().events.tolist() == [11, 0]


def test_table_names_the_cause_and_the_worst_come_first():
    model = MODELS["motor_winding"]
    fleet = Fleet("kf", model, assets=3, start=0.0)
    rng = np.random.default_rng(3)
    fleet.add("winding", 1, np.arange(1.0, 41.0), 35.0 + rng.normal(size=40))
    fleet.add("winding", 2, np.arange(1.0, 41.0), 35.0 + rng.normal(size=40))
    fleet.add_ticks(41.0, [2])
    fleet.add_ticks(400.0, [1])
    fleet.advance()
    table = fleet.table()
    assert table.cause[1] in ("silent", "stale") and table.worst(1).tolist() == [1]
    assert table.age[1] == 360.0 and table.age[2] == 1.0 and np.isnan(table.seconds[0])


def test_a_degraded_asset_whose_sensors_need_not_report_is_silent():
    model, policy = MODELS["motor_winding"], HealthPolicy()
    fleet = Fleet("kf", model, assets=2, start=0.0, expected=np.zeros(1, np.bool_))
    fleet.add("winding", 0, [1.0, 2.0], [35.0, 35.0])  # too few for a period
    fleet.add("winding", 1, np.arange(1.0, 301.0), np.full(300, 35.0))  # suspect for another reason before
    fleet.add_ticks(2.0 + policy.degraded_after + 1.0, [0])
    fleet.add_ticks(300.0 + policy.degraded_after + 1.0, [1])
    fleet.advance()
    table = fleet.table()
    assert [HEALTH_NAMES[k] for k in table.health] == ["degraded", "degraded"]
    assert table.cause.tolist() == ["silent", "stuck"]


@cases(__file__, "refused_fleets.csv")
def test_a_fleet_that_cannot_be_is_one_line(estimator, options, words):
    assert words in error_of(EstimatorError, Fleet, estimator, MODELS["motor_winding"], **json.loads(options))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda m: Fleet("kf", m, replace(Tuning.of(m), gate=0.99), assets=2, recent=0), "gate.reopen is 30 s"),
        (lambda m: Fleet("kf", m, [Tuning.of(m)] * 3, assets=2), "3 tunings for 2 assets"),
        (lambda m: Fleet("kf", m, [Tuning.of(m)] * 2, assets=2, values={"R.winding": [1.0, 2.0]}), "values and a"),
        (lambda m: Fleet("kf", m, assets=["a", "b"]).add("winding", "c", 1.0, 2.0), 'no asset'),
        (lambda m: Fleet("kf", m, assets=2).add("winding", 2, 1.0, 2.0), "asset is 2"),
        (lambda m: Fleet("kf", m, assets=2).add("winding", [0, 1, 1], [1.0, 2.0], [3.0, 4.0]), "3 assets for 2 times"),
    ],
)  # fmt: skip
def test_bad_arguments_are_one_line(call, words):
    assert re.search(words, error_of((EstimatorError, EventError), call, MODELS["motor_winding"]))
