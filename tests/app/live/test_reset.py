"""A filter that is lost says so and since when, and a reset, which is an event of the log, brings it back."""

import numpy as np
import pytest

from app.live import commands
from app.live.counts import last_run
from app.live.engine import Engine
from app.twin.twin import load_twin
from app.views.recording.format import tuning_from_json
from app.views.recording.reader import read_recording
from app.views.recording.writer import Recorder
from app.views.viser.panel import status_html
from app.web.commands_json import command_from_json
from app.web.twin_json import status_json
from estimators.errors import EstimatorError
from estimators.fold import Fold
from estimators.log import READING, RESET, Events, Log
from estimators.registry import ESTIMATORS
from estimators.track import DIVERGED, GATED, TRACKING, USED
from tests.app.scripted import MODEL, Scripted, fresh_status, pull_all, readings, row_count, twin, wait_for
from tests.support import SECOND

JUMP = 60
"""Events before the asset jumps, by more than the gate lets through."""
RESET_AT = 100
FAMILIES = ["kf", "sr-kf", "ekf", "ukf", "sr-ukf", "pf", "pf-reg", "apf", "enkf", "etkf", "ensrf", "filterpy-enkf"]
OPTIONS = {"particles": 300.0, "members": 8.0}
"""Few, so that a cloud collapses on one particle, and an ensemble without inflation on its mean."""


def asset(n):
    """Seconds and readings: 40 °C until the jump, then 26 °C, which the prior (35 ± 5 °C) can explain."""
    t = np.arange(1.0, n + 1)
    noise = np.random.default_rng(4).normal(0.0, 1.0, n)
    return t, np.where(t <= JUMP, 40.0, 26.0) + noise


def stubborn(name):
    """A twin that hardly distrusts its model, and refuses what does not fit it."""
    made = twin()
    made.estimator = name
    options = {option.name: OPTIONS[option.name] for option in ESTIMATORS[name].options if option.name in OPTIONS}
    tuning = made.tuning.set("gate", 0.9973).set("gate.reopen", None).set("Q.temperature", 1e-4).set("Q.rate", 1e-8)
    made.tuning = tuning.with_options(options)
    return made


@pytest.fixture
def start():
    engines = []

    def start(made):
        source = Scripted()
        engine = Engine(made, lambda report: source)
        engine.recorder = Recorder(engine, lambda stream: lambda pull: None)
        engine.recorder.start()
        engine.start()
        engines.append(engine)
        return source, engine

    yield start
    for engine in engines:
        engine.stop()
        engine.recorder.stop()


@pytest.mark.parametrize("name", FAMILIES)
def test_what_diverges_says_since_when_and_is_reset(name, start, tmp_path):
    source, engine = start(stubborn(name))
    path = tmp_path / "run.rrd"
    engine.submit(commands.Record(path))
    wait_for(lambda: engine.recorder.path == path)
    t, y = asset(RESET_AT + 20)
    source.put(readings(t[:RESET_AT], y[:RESET_AT]))
    wait_for(lambda: row_count(engine) == RESET_AT)
    track, status = pull_all(engine).track, fresh_status(engine)
    assert np.all(track.verdict[JUMP + 1 : RESET_AT] == GATED)
    # More than half of the 50 readings of the window are refused from the 26th on that are.
    first = int(np.searchsorted(np.cumsum(track.verdict == GATED), 26))
    assert status.health == DIVERGED and status.since == (first + 1) * SECOND
    assert f"diverged since {first:.1f} s" in status_html(status, SECOND)
    # What to do depends on what else is wrong: the episode says it, which follows within a second.
    remedy = "winding contradicts it still: look at the sensor, and Reset where that is right"
    wait_for(lambda: fresh_status(engine).cause.endswith(remedy))
    assert remedy in status_html(fresh_status(engine), SECOND)
    wait_for(lambda: any("diverged" in line.text for line in engine.notices.since(0)))
    (line,) = [line for line in engine.notices.since(0) if "diverged" in line.text]
    assert line.level == "error" and "Reset" in line.text and line.t == status.since
    engine.submit(command_from_json({"command": "Reset"}, engine))
    wait_for(lambda: row_count(engine) == RESET_AT + 1)
    source.put(readings(t[RESET_AT:], y[RESET_AT:]))
    wait_for(lambda: row_count(engine) == RESET_AT + 21)
    track, status = pull_all(engine).track, fresh_status(engine)
    assert np.all(track.verdict[RESET_AT + 1 :] == USED) and np.all(track.health[RESET_AT:] == TRACKING)
    assert status.since == RESET_AT * SECOND and "diverged" not in status_html(status, SECOND)
    assert status_json(engine)["since"] == RESET_AT * SECOND
    # The prior's weight is down to a few readings' after 20 of variance 1 (or as tuned): within 4 deviations.
    assert abs(track.mean[-1, 0] - 26.0) < 4.0 * max(track.std[-1, 0], np.sqrt(MODEL.sensors[0].rows[0].variance / 20))
    engine.submit(commands.Record(None))
    wait_for(lambda: path in engine.recorder.finished)
    recorded = read_recording(path)
    assert np.flatnonzero(recorded.events.kind == RESET).tolist() == [RESET_AT]
    tuning, estimator = tuning_from_json(recorded.tuning, MODEL)
    log = Log(MODEL.width)
    log.extend(recorded.events)
    again = Fold(estimator, MODEL, tuning, log, pairs=np.array([[0, 1]]), base=recorded.base)
    again.advance(37)
    again.advance()
    for column, a, b in zip(track._fields, track, again.track, strict=True):
        np.testing.assert_array_equal(a, b, err_msg=column)


def test_a_reset_stays_where_it_was_when_the_history_is_folded_again(start):
    source, engine = start(stubborn("kf"))
    t, y = asset(RESET_AT + 10)
    source.put(readings(t[:RESET_AT], y[:RESET_AT]))
    wait_for(lambda: row_count(engine) == RESET_AT)
    engine.submit(commands.Reset())
    engine.submit(commands.SetEstimator("pf"))
    source.put(readings(t[RESET_AT:], y[RESET_AT:]))
    wait_for(lambda: row_count(engine) == RESET_AT + 11 and engine.status().revision == 1)
    pull = pull_all(engine)
    assert np.flatnonzero(pull.events.kind == RESET).tolist() == [RESET_AT]
    # The particles of a reset are drawn from the prior, as they are at the start.
    np.testing.assert_allclose(pull.track.mean[RESET_AT], [35.0, 0.0], atol=4.0 * 5.0 / np.sqrt(2000.0))


def test_nothing_to_reset_is_one_line(start):
    _, engine = start(twin())
    engine.submit(commands.Reset())
    wait_for(lambda: any("nothing to reset" in line.text for line in engine.notices.since(0)))
    assert row_count(engine) == 0


def test_last_run_is_the_first_of_the_equal_ones():
    rng = np.random.default_rng(0)
    for n, run in [(1, 1), (5, 2), (20_000, 1), (20_000, 9000), (20_000, 20_000), (8192, 8192), (8193, 8192)]:
        codes = rng.integers(0, 3, n).astype(np.int8)
        codes[n - run :] = 3
        assert last_run(codes) == n - run


def test_options_are_kept_for_each_filter(start):
    made = twin()
    made.options_of = lambda name: {"alpha": 0.5} if name == "ukf" else {}
    source, engine = start(made)
    source.put(readings([1.0, 2.0], [40, 41]))
    wait_for(lambda: row_count(engine) == 2)

    def done(command):
        revision = engine.status().revision
        engine.submit(command)
        wait_for(lambda: engine.status().revision > revision and not engine.status().refolding)
        return fresh_status(engine).options

    assert done(commands.SetEstimator("ukf"))["alpha"] == 0.5
    assert done(commands.SetOption("beta", 1.0))["beta"] == 1.0
    assert "alpha" not in done(commands.SetEstimator("kf"))
    options = done(commands.SetEstimator("ukf"))
    assert (options["alpha"], options["beta"]) == (0.5, 1.0)


def test_a_filter_that_does_not_apply_changes_nothing(start):
    made = load_twin("lorenz63", overrides={"estimator": "ekf"})
    source, engine = start(made)
    source.put(Events.one(SECOND, SECOND, READING, 0, [1.0, -1.0, 25.0], made.model.width))
    wait_for(lambda: row_count(engine) == 1)
    before = pull_all(engine)
    with pytest.raises(EstimatorError, match="kf does not apply: lorenz63 is not linear"):
        command_from_json({"command": "SetEstimator", "name": "kf"}, engine)
    engine.submit(commands.SetEstimator("kf"))
    wait_for(lambda: engine.notices.counts().get("engine error") == 1)
    (line,) = [line.text for line in engine.notices.since(0) if line.level == "error"]
    assert line.startswith("estimator kf does not apply: lorenz63 is not linear") and "\n" not in line
    status, after = fresh_status(engine), pull_all(engine)
    assert (status.estimator, status.revision, status.refolding) == ("ekf", 0, False)
    np.testing.assert_array_equal(after.track.mean, before.track.mean)
