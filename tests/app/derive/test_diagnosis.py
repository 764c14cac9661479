"""The figures of a running twin against NumPy's over the same rows, and what is said of them."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import norm

from app.derive import diagnosis
from app.derive.diagnosis import Diagnosis, _agreed
from app.derive.row_figures import LAGS, rows_json, verdict
from app.engine.commands import SetEstimator
from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.innovations import autocorrelation
from estimators.log import READING, Events
from estimators.track import USED, Track
from estimators.tuning import Tuning
from tests.app.scripted import MODEL, Stepped, pull_all, readings


def consistent(n=4000, seed=3):
    """Readings of an asset that is as the model says: temperature and rate as random walks, noise of 2 °C."""
    rng = np.random.default_rng(seed)
    rate = np.cumsum(rng.normal(0, np.sqrt(0.0005), n))
    temperature = 35.0 + np.cumsum(0.5 * rate + rng.normal(0, np.sqrt(0.005), n))
    return readings(0.5 * np.arange(1, n + 1), temperature + rng.normal(0, 2.0, n))


def slow_error(n=4000):
    """A temperature that swings faster than the model thinks it can: its innovations are correlated."""
    rng = np.random.default_rng(4)
    t = 0.5 * np.arange(1, n + 1)
    return readings(t, 35.0 + 12.0 * np.sin(2 * np.pi * t / 40.0) + rng.normal(0, 2.0, n))


def looked(events, **options):
    stepped = Stepped(**options)
    engine = stepped.engine
    stepped.put(events)
    return engine, json.loads(json.dumps(Diagnosis(engine)._look(), allow_nan=False))


def innovations(engine):
    pull = pull_all(engine)
    rows = pull.events.kind == READING
    return pull.track.innovation[rows, 0] / pull.track.innovation_std[rows, 0]


def test_the_figures_are_those_of_the_rows():
    engine, said = looked(consistent())
    (row,) = said["rows"]
    e = innovations(engine)
    z = e - e.mean()
    expected = np.correlate(z, z, mode="full")[e.size :][:LAGS] / (z @ z)
    np.testing.assert_allclose(row["autocorrelation"]["r"], expected, rtol=6e-3, atol=1e-9)
    assert row["autocorrelation"]["bound"] == pytest.approx(1.96 / np.sqrt(e.size), rel=6e-3)
    counts, _ = np.histogram(e, 32, (-4, 4))
    beyond = np.array(row["histogram"]["counts"]) - counts
    assert beyond[1:-1].tolist() == [0] * 30 and sum(row["histogram"]["counts"]) == row["n"] == e.size
    ranks, _ = np.histogram(norm.cdf(e), 10, (0, 1))
    assert row["ranks"]["counts"] == ranks.tolist()
    cov = engine.belief().cov
    np.testing.assert_allclose(said["correlation"]["matrix"], _corr(cov), atol=1e-2)
    assert row["tone"] == "good" and row["verdict"].startswith("winding: consistent")


def _corr(cov):
    std = np.sqrt(np.diag(cov))
    return cov / np.outer(std, std)


def test_a_slow_error_is_said_in_words():
    _, said = looked(slow_error())
    (row,) = said["rows"]
    assert row["tone"] == "bad" and "innovations are correlated (+" in row["verdict"]
    assert "what is missing lasts" in row["verdict"] and row["correlation"][1] > 0.2


def test_a_small_error_that_stays_is_said_though_no_two_neighbours_tell_it():
    rng = np.random.default_rng(8)
    e = rng.normal(size=1000)
    nothing = autocorrelation(e, LAGS)
    stays = autocorrelation(e + 0.4 * np.sign(np.sin(2 * np.pi * np.arange(1000) / 250)), LAGS)
    calm = SimpleNamespace(words=(), role="used")
    assert verdict("y", calm, nothing, 1000, 0.5) == ("y: consistent (1,000 measurements)", "good")
    words, tone = verdict("y", calm, stays, 1000, 0.5)
    # A square wave of ± 0.4 in readings of deviation √(1 + 0.16), of which 25 lags of 125 keep four fifths and more.
    size = float(words.split("about ")[1].split(" ")[0])
    assert tone == "bad" and 0.28 < size < 0.40


def test_a_row_of_a_commissioned_twin_is_measured_by_what_was_normal():
    """Innovations of bias 0.5, scale 0.4 and correlation 0.7: to be mended, unless they were accepted as they are."""
    rng = np.random.default_rng(7)
    z = lfilter([np.sqrt(1 - 0.49)], [1.0, -0.7], rng.standard_normal(20_000))
    track, t = Track.allocate(z.size, 2, 0, 1), np.arange(z.size, dtype=np.int64) * 10**9
    track.verdict[:], track.dof[:] = USED, 1
    track.innovation[:, 0], track.innovation_std[:, 0] = 0.5 + 0.4 * z, 1.0
    events = Events.alike(READING, t, np.zeros((z.size, 1)))

    def said(*normal):
        tuning = Tuning.of(MODEL).set("gate", None)
        if normal:
            baseline = no_baseline(MODEL)
            baseline[:, :3] = normal
            tuning = replace(tuning, baseline=baseline)
        (row,) = rows_json(MODEL, events, track, tuning, marginal=False)
        return row["verdict"], row["tone"]

    words, tone = said()
    assert tone == "bad" and "too wide" in words and "above the prediction" in words and "correlated" in words
    words, tone = said(0.5, 0.4, 0.7)
    assert tone == "good" and words.startswith("winding: as commissioned (20,000 measurements) (bands")
    words, tone = said(0.25, 0.2, 0.7)
    assert tone == "bad" and words.startswith("winding: not as commissioned: bands too narrow by a factor of 2 (")
    words, tone = said(0.5, 0.4, 0.0)
    assert tone == "bad" and words.startswith("winding: not as commissioned: innovations are correlated")


def test_a_sensor_in_doubt_is_not_called_consistent():
    rows = [{"name": "y", "sensor": "y", "tone": "good", "verdict": "y: consistent"}]
    calm, doubt = (SimpleNamespace(sensors={"y": told}) for told in (("tracking", ""), ("suspect", "y spikes")))
    assert _agreed([dict(rows[0])], calm) == rows
    assert _agreed(rows, doubt)[0]["verdict"] == "y: y spikes" and rows[0]["tone"] == "bad"


def test_only_the_last_rows_are_looked_at(monkeypatch):
    monkeypatch.setattr(diagnosis, "DIAGNOSED_ROWS", 5000)
    _, said = looked(events := consistent(9000))
    assert (said["events"], said["span"]) == (5000, float(events.t[-1] - events.t[-5000]) * 1e-9)


def test_nothing_is_said_before_the_first_reading():
    stepped = Stepped()
    engine = stepped.engine
    said = json.loads(json.dumps(Diagnosis(engine).figures(), allow_nan=False))
    assert said["events"] == 0 and said["rows"][0]["verdict"] == "winding: no reading among the last rows"


def test_particles_over_time():
    engine, said = looked(consistent(600), estimator="pf")
    pull = pull_all(engine)
    assert said["marginal"] and said["particles"]["count"] == 2000
    known = pull.track.effective[np.isfinite(pull.track.effective)]
    assert min(said["particles"]["effective"]) == pytest.approx(known.min(), rel=1e-3)
    assert len(said["particles"]["t"]) == 200 and said["particles"]["t"][0] < -290


def test_observability_and_cost_come_from_a_background_job():
    stepped = Stepped().put(consistent(600))
    diagnosis = Diagnosis(stepped.engine)
    assert diagnosis._look()["observability"]["reason"] == "being computed"
    stepped.engine.settle()
    said = diagnosis._look()
    assert said["cost"] > 0.0
    told = said["observability"]
    # A thermometer read over minutes determines both temperature and its rate.
    assert (told["rank"], told["of"]) == (2, 2) and set(told["states"]) == {"temperature", "rate"}
    assert all(0.0 < left < 1.0 for left in told["states"].values())
    # Of another revision nothing is known at first.
    stepped.submit(SetEstimator("ekf"))
    assert diagnosis._look()["observability"]["reason"] == "being computed"
    stepped.engine.settle()
    assert diagnosis._look()["observability"]["rank"] == 2
