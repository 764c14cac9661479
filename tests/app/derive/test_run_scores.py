"""Scores of revisions, recomputed by hand from folds of the same readings."""

import numpy as np
import pytest

from app.derive.run_scores import RunScores
from app.engine import commands
from app.engine.copies import MAX_PULL_ROWS
from estimators.fold import fold
from estimators.track import HELD_OUT, USED
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Stepped, random_walk, readings
from tests.support import as_log
from tests.waiting import wait_for

FIRST = Tuning.of(MODEL)


def by_hand(estimator, tuning, n):
    log = as_log(readings(*random_walk(n)))
    return fold(estimator, MODEL, tuning, log), log.events


def test_scores_are_those_of_a_refold():
    twin = Stepped(800)
    twin.submit(commands.SetTuning("Q.rate", 0.05))
    twin.submit(commands.SetEstimator("ukf"))
    scores = RunScores(twin.engine)
    (gone, nothing), (left, of_left), (running, of_running) = scores.all()
    assert gone.track is None and nothing is None
    assert (left.estimator, running.estimator) == ("kf", "ukf")
    for run, known in ((left, of_left), (running, of_running)):
        track, _ = by_hand(run.estimator, FIRST.set("Q.rate", 0.05), 800)
        used = track.verdict == USED
        assert known.score.nis == pytest.approx(track.nis[used].mean(), rel=1e-9)
        assert known.score.log_likelihood == pytest.approx(track.log_likelihood[used].sum(), rel=1e-9)
        assert known.score.log_likelihood_reading == pytest.approx(track.log_likelihood[used].mean(), rel=1e-9)
        assert known.rows == 800 and known.seconds == pytest.approx(79.9)
        assert known.step_us > 0.0


def test_every_run_is_scored_though_nobody_asked_before_its_track_was_dropped():
    twin = Stepped(300)
    scores = RunScores(twin.engine)
    for value in (0.05, 0.1, 0.2):
        twin.submit(commands.SetTuning("Q.rate", value))
    found = scores.all()
    assert [run.track is None for run, _ in found] == [True, True, False, True]
    for (run, known), value in zip(found, (FIRST.get("Q.rate"), 0.05, 0.1, 0.2), strict=True):
        track, _ = by_hand("kf", FIRST.set("Q.rate", value), 300)
        assert run.first is (value == FIRST.get("Q.rate"))
        assert known.score.nis == pytest.approx(track.nis[track.verdict == USED].mean(), rel=1e-9)


def test_a_sensor_held_out_is_scored_by_its_predictions():
    twin = Stepped(300)
    twin.submit(commands.UseSensor("winding", False))
    (_, (_, known)) = RunScores(twin.engine).all()
    track, events = by_hand("kf", FIRST.set("use.winding", False), 300)
    held = track.verdict == HELD_OUT
    error, std = track.innovation[held, 0], track.innovation_std[held, 0]
    fit = known.score.held_out["winding"]
    assert fit.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)
    assert fit.coverage == pytest.approx(np.mean(np.abs(error) <= 1.959964 * std))


def test_what_was_scored_stays_known_when_its_track_goes():
    twin = Stepped(300)
    twin.submit(commands.SetTuning("Q.rate", 0.05))
    scores = RunScores(twin.engine)
    first = scores.all()[0][1]
    assert first is not None and scores.all()[0][1] is first
    twin.submit(commands.SetTuning("R.winding", 2.0))
    (run, known), *_ = scores.all()
    assert run.track is None and known is first


def test_scores_of_runs_that_are_forgotten_go_though_nobody_asks(monkeypatch):
    monkeypatch.setattr("app.engine.revisions.MAX_REVISIONS", 5)
    twin = Stepped(50)
    scores = RunScores(twin.engine)
    for k in range(12):
        twin.submit(commands.SetTuning("Q.rate", 0.05 + 0.01 * k))
    kept = {run.number for run in twin.engine.revisions.runs}
    assert len(kept) == 5
    wait_for(lambda: not scores._ended and scores._known.keys() | scores._final <= kept)


def test_a_history_of_several_pieces_is_scored_whole():
    n = 2 * MAX_PULL_ROWS + 100
    twin = Stepped(n)
    ((_, known),) = RunScores(twin.engine).all()
    assert known.rows == n and known.score.readings == n


def test_before_anything_has_come_there_is_nothing_to_score():
    ((run, known),) = RunScores(Stepped().engine).all()
    assert run.number == 0 and known is None
