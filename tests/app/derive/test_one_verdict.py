"""A NIS is judged alike wherever it is shown: on the strip, of a run, in the diagnosis, in the report."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from app.derive.diagnosis import Diagnosis
from app.derive.run_scores import RunScores
from app.engine.engine import Engine
from app.render.report import Reported, _scores
from app.render.runs_json import runs_json
from app.web.twin_json import status_json
from estimators.diagnostics.detector_state import no_baseline
from estimators.diagnostics.intervals import scale_interval
from estimators.diagnostics.score import score
from tests.app.scripted import MODEL, Scripted, pull_all, readings, twin

READINGS = 40  # fewer than the window of the strip holds, so that all judge the same ones
BIAS, SCALE, CORRELATION = 0.2, 0.5, 0.6


@pytest.fixture(params=[False, True], ids=["not commissioned", "commissioned"])
def engine(request):
    made = twin()
    if request.param:
        baseline = no_baseline(MODEL)
        baseline[:, :3] = BIAS, SCALE, CORRELATION
        made.tuning = dataclasses.replace(made.tuning, baseline=baseline)
    engine = Engine(made, lambda report: Scripted())
    rng = np.random.default_rng(5)
    engine._accept([readings(0.5 * np.arange(1, READINGS + 1), 40.0 + rng.normal(0, 2.0, READINGS))])
    return engine


def by_hand(engine):
    """Mean NIS and bounds: chi-square, or as wide as a sum of squares of such an AR(1) series is on average.

    Wider where the NIS vary by more: E / f to E f for an interval of the mean by the factor f, at most 1.25².
    """
    nis = pull_all(engine).track.nis
    mean = 1.0 if engine.twin.tuning.baseline is None else BIAS**2 + SCALE**2
    factor = min(scale_interval(nis).high / nis.mean(), 1.25**2)
    nis, low, high = white_by_hand(engine)
    return nis, min(low, mean / factor), max(high, mean * factor)


def white_by_hand(engine):
    nis = pull_all(engine).track.nis.mean()
    if engine.twin.tuning.baseline is None:
        return nis, *chi2.ppf([0.025, 0.975], READINGS) / READINGS
    mean = BIAS**2 + SCALE**2
    # Σ over all lags of the covariances of e², from those of z² (2 φ^2k) and z (φ^k), k from -∞ to ∞.
    lags = np.abs(np.arange(-200, 201))
    variance = np.sum(2 * SCALE**4 * CORRELATION ** (2 * lags) + 4 * BIAS**2 * SCALE**2 * CORRELATION**lags)
    free = 2 * READINGS * mean**2 / variance
    return nis, *(mean / free * chi2.ppf([0.025, 0.975], free))


def test_one_verdict_in_one_wording(engine):
    status = status_json(engine)
    run = runs_json(RunScores(engine), engine)[0]["score"]
    nis, low, high = by_hand(engine)
    assert (status["nis"], status["nis_low"], status["nis_high"]) == pytest.approx((nis, low, high), rel=1e-6)
    assert (run["nis"], run["nis_low"], run["nis_high"]) == pytest.approx((nis, low, high), rel=1e-6)
    assert status["nis_judged"] == pytest.approx(run["nis_judged"], rel=1e-9) == pytest.approx(nis, rel=1e-9)
    place = "below" if nis < low else "above" if nis > high else "inside"
    commissioned = engine.twin.tuning.baseline is not None
    which, of = ("the", " of the commissioned baseline") if commissioned else ("its", "")
    expected = f"mean NIS {nis:.2f} per degree of freedom, {place} {which} 95 % bounds {low:.2f} to {high:.2f}{of}"
    said = [status["nis_words"], run["nis_words"], Diagnosis(engine)._look()["nis"]]
    assert said == [expected] * 3
    assert status["nis_place"] == run["nis_place"] == place == ("above" if commissioned else "inside")


def test_the_report_says_the_same(engine):
    pull, run = pull_all(engine), runs_json(RunScores(engine), engine)[0]["score"]
    twin = engine.twin
    found = score(pull.track, pull.events, MODEL, gate=twin.tuning.gate, baseline=twin.tuning.baseline)
    reported = Reported(twin, "kf", twin.tuning, pull.events, pull.track, (), (), False)
    (row,) = [row for row in _scores(reported, found).rows if row[0] == "mean NIS"]
    assert f"mean NIS {row[1]} {row[2]}" == run["nis_words"]
