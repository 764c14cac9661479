"""A filter that is lost says so and since when, and a reset, which is an event of the log, brings it back."""

import numpy as np
import pytest

from app.engine import commands
from app.engine.counts import last_run
from app.record.reader import read_recording
from app.record.writer import RecordingPart
from app.twin.twin import load_twin
from app.web.commands_json import command_from_json
from app.web.twin_json import status_json
from estimators.errors import NisusError
from estimators.events.maintenance import model_versions
from estimators.log import RESET
from estimators.registry import ESTIMATORS
from estimators.track import DIVERGED, GATED, TRACKING, USED
from tests.app.record.test_parts import refold
from tests.app.scripted import MODEL, Stepped, pull_all, readings, row_count, twin
from tests.support import SECOND, assert_same

JUMP = 60
"""Events before the asset jumps, by more than the gate lets through."""
RESET_AT = 100
FAMILIES = ["kf", "sr-kf", "ekf", "ukf", "sr-ukf", "pf", "pf-reg", "apf", "enkf", "etkf", "ensrf", "filterpy-enkf"]
OPTIONS = {"particles": 300.0, "members": 8.0}
"""Few, so that a cloud collapses on one particle, and an ensemble without inflation on its mean."""

T = np.arange(1.0, RESET_AT + 21.0)
Y = np.where(T <= JUMP, 40.0, 26.0) + np.random.default_rng(4).normal(0.0, 1.0, T.size)
"""40 °C until the jump, then 26 °C, which the prior (35 ± 5 °C) can explain."""


def stubborn_twin(name):
    """A twin that hardly distrusts its model, and refuses what does not fit it."""
    made = twin(estimator=name)
    options = {option.name: OPTIONS[option.name] for option in ESTIMATORS[name].options if option.name in OPTIONS}
    tuning = made.tuning.set("gate", 0.9973).set("gate.reopen", None).set("Q.temperature", 1e-4).set("Q.rate", 1e-8)
    made.tuning = tuning.with_options(options)
    return made


def stubborn(name):
    """Such a twin just before its reset."""
    stepped = Stepped(of=stubborn_twin(name)).put(readings(T[:RESET_AT], Y[:RESET_AT]))
    return stepped


@pytest.mark.parametrize("name", FAMILIES)
def test_what_diverges_says_since_when_and_is_reset(name):
    stepped = stubborn(name)
    engine = stepped.engine
    track = pull_all(engine).track
    assert np.all(track.verdict[JUMP + 1 : RESET_AT] == GATED)
    engine._watchers.episode_log.update()
    status = stepped.status()
    # More than half of the 50 readings of the window are refused from the 26th on that are.
    first = int(np.searchsorted(np.cumsum(track.verdict == GATED), 26))
    assert status.health == DIVERGED and status.since == (first + 1) * SECOND
    # What to do depends on what else is wrong, which the episode says.
    remedy = "winding still contradicts it: check the sensor; if it is right, reset the twin"
    assert status.cause.endswith(remedy)
    (line,) = [line for line in engine.notices.since(0) if "diverged" in line.text]
    assert line.level == "error" and "reset the twin" in line.text and line.t == status.since
    stepped.submit(command_from_json({"command": "Reset"}, engine))
    stepped.put(readings(T[RESET_AT:], Y[RESET_AT:]))
    track, status = pull_all(engine).track, stepped.status()
    assert np.all(track.verdict[RESET_AT + 1 :] == USED) and np.all(track.health[RESET_AT:] == TRACKING)
    assert status.since == RESET_AT * SECOND and status.health != DIVERGED
    assert status_json(engine)["since"] == RESET_AT * SECOND
    # The prior's weight is down to a few readings' after 20 of variance 1 (or as tuned): within 4 deviations.
    assert abs(track.mean[-1, 0] - 26.0) < 4.0 * max(track.std[-1, 0], np.sqrt(MODEL.sensors[0].rows[0].variance / 20))


@pytest.mark.parametrize("name", ["kf", "pf", "enkf", "filterpy-enkf"])
def test_reset_and_maintenance_are_in_the_recording(name, tmp_path):
    stepped = stubborn(name)
    stepped.submit(commands.Reset(), commands.Maintenance("bearing replaced", ("rate",)))
    stepped.put(readings(T[RESET_AT:], Y[RESET_AT:]))
    pull = pull_all(stepped.engine)
    part = RecordingPart(stepped.engine, tmp_path / "run.rrd", lambda stream: lambda pull: None)
    part.end()
    part.release()
    recorded = read_recording(tmp_path / "run.rrd")
    # Of one time, an event of the asset comes before one of the estimate.
    assert np.flatnonzero(recorded.events.kind == RESET).tolist() == [RESET_AT + 1]
    np.testing.assert_array_equal(model_versions(recorded.events), model_versions(pull.events))
    assert_same(refold(recorded), pull.track)


def test_a_reset_stays_where_it_was_when_the_history_is_folded_again():
    stepped = stubborn("kf")
    stepped.submit(commands.Reset(), commands.SetEstimator("pf"))
    stepped.put(readings(T[RESET_AT:], Y[RESET_AT:]))
    pull = pull_all(stepped.engine)
    assert pull.revision == 1 and np.flatnonzero(pull.events.kind == RESET).tolist() == [RESET_AT]
    # The particles of a reset are drawn from the prior, as they are at the start.
    np.testing.assert_allclose(pull.track.mean[RESET_AT], [35.0, 0.0], atol=4.0 * 5.0 / np.sqrt(2000.0))


def test_last_run_is_the_first_of_the_equal_ones():
    rng = np.random.default_rng(0)
    for n, run in [(1, 1), (5, 2), (20_000, 1), (20_000, 9000), (20_000, 20_000), (8192, 8192), (8193, 8192)]:
        codes = rng.integers(0, 3, n).astype(np.int8)
        codes[n - run :] = 3
        assert last_run(codes) == n - run


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (commands.Reset(), "nothing to reset"),
        (commands.SetEstimator("kf"), "estimator kf does not apply: lorenz63 is not linear"),
    ],
)
def test_a_command_that_cannot_be_carried_out_changes_nothing(command, reason):
    stepped = Stepped(of=load_twin("lorenz63", overrides={"estimator": "ekf"}))
    with pytest.raises(NisusError, match=reason):
        stepped.submit(command)
    status = stepped.status()
    assert (status.estimator, status.revision, status.refolding) == ("ekf", 0, False) and not row_count(stepped.engine)
    with pytest.raises(NisusError, match="kf does not apply: lorenz63 is not linear"):
        command_from_json({"command": "SetEstimator", "name": "kf"}, stepped.engine)
